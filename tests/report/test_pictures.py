"""The report's figures as PNG files."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from rangesfm.errors import InputError
from rangesfm.report import pictures, write_report_pictures

MakeResult = Callable[..., Path]


def test_every_figure_has_its_picture_with_something_on_it(make_result: MakeResult) -> None:
    folder = make_result(num_keyframes=60, num_ranges_per_anchor=60, num_points=3000)
    written = write_report_pictures(folder)
    assert len(written) == 11
    assert {path.parent for path in written} == {folder / "figures"}
    for path in written:
        pixels = np.asarray(Image.open(path).convert("RGB"), dtype=np.int64)
        assert pixels.shape[1] > 900
        colorful = np.ptp(pixels, axis=2) > 60
        assert colorful.mean() > 1e-3, path.name


def test_without_matplotlib_the_user_is_told_what_to_install(
    make_result: MakeResult, monkeypatch: pytest.MonkeyPatch
) -> None:
    def found(name: str) -> Any:
        assert name == "matplotlib"

    monkeypatch.setattr(pictures, "find_spec", found)
    folder = make_result(num_keyframes=5, num_ranges_per_anchor=5)
    with pytest.raises(InputError, match=r"rangesfm\[plot\]"):
        write_report_pictures(folder)
    assert not (folder / "figures").exists()

"""Ranges over time as a figure."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from rangesfm.errors import InputError
from rangesfm.ranging.log import RangeLog
from rangesfm.ranging.plot import plot_ranges, write_figure

LOG = RangeLog.from_arrays(["a", "b", "a"], [1.0, 2.0, 3.0], timestamp_s=[1.7e9, 1.7e9 + 1, 1.7e9 + 2])


def test_figure_shows_each_anchors_ranges_over_the_time_since_the_first() -> None:
    (axes,) = plot_ranges(LOG).axes
    drawn = {line.get_label(): np.asarray(line.get_xydata()).tolist() for line in axes.lines}
    assert drawn == {"a": [[0, 1], [2, 3]], "b": [[1, 2]]}


def test_log_by_photos_is_drawn_by_number() -> None:
    (axes,) = plot_ranges(RangeLog.from_arrays(["a", "a"], [1.0, 2.0], image_name=["1.jpg", "2.jpg"])).axes
    assert np.asarray(axes.lines[0].get_xydata()).tolist() == [[0, 1], [1, 2]]


def test_dollars_in_names_are_dollars(tmp_path: Path) -> None:
    log = RangeLog.from_arrays(["$\\foo$", "b"], [1.0, 2.0], timestamp_s=[0.0, 1.0])
    write_figure(plot_ranges(log), tmp_path / "out.png")
    assert (tmp_path / "out.png").is_file()


def test_figure_is_written_as_its_name_says(tmp_path: Path) -> None:
    write_figure(plot_ranges(LOG), tmp_path / "out.png")
    with Image.open(tmp_path / "out.png") as image:
        assert image.size == (1440, 720)
    with pytest.raises(InputError, match="no figure format is named 'doc'"):
        write_figure(plot_ranges(LOG), tmp_path / "out.doc")
    with pytest.raises(InputError, match="cannot be written"):
        write_figure(plot_ranges(LOG), tmp_path / "none" / "out.png")
    assert [path.name for path in tmp_path.iterdir()] == ["out.png"]


def test_missing_package_is_said_with_the_command_that_installs_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(InputError, match=r"pip install 'rangesfm\[plot\]'"):
        plot_ranges(LOG)

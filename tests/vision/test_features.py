"""How photos are handed to COLMAP for their features."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pycolmap
import pytest

from rangesfm.vision import features


@pytest.mark.parametrize(("photo_s", "longest_call_s"), [(0.1, 4.0), (10.0, 20.0)])
def test_each_photo_is_handed_over_once_in_calls_of_some_seconds(
    photo_s: float, longest_call_s: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A Ctrl-C waits for the call at hand; each call costs a start, and an end when some threads have no photo left."""
    clock, calls = SimpleNamespace(now_s=0.0), list[list[str]]()

    def extract(*_: Any, image_names: list[str], **__: Any) -> None:
        calls.append(image_names)
        clock.now_s += photo_s * len(image_names)

    monkeypatch.setattr(features, "time", SimpleNamespace(monotonic=lambda: clock.now_s))
    monkeypatch.setattr(pycolmap, "extract_features", extract)
    names, options = [f"{k}.jpg" for k in range(101)], pycolmap.FeatureExtractionOptions(num_threads=2)
    reader, token = pycolmap.ImageReaderOptions(), pycolmap.CancellationToken()
    features._call_colmap(Path("database.db"), Path(), names, reader, options, token)
    assert [name for call in calls for name in call] == names
    assert max(map(len, calls)) * photo_s == pytest.approx(longest_call_s)
    assert len(calls[0]) == 2

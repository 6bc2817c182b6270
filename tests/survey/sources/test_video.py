"""The frames of a video: when each is shown, which way is up, and what its clock is."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from PIL import Image
from tests.survey.sources.damage import DAMAGES, Damage
from tests.survey.sources.recorded import PORTRAIT, write_video

from rangesfm.errors import InputError
from rangesfm.survey.sources.source import open_source

START_S = 1777888800.0  # 2026-05-04 10:00:00 UTC
TIMES_S = [20.0, 20.04, 20.5, 21.0, 21.002]


def pictures(num: int) -> list[Image.Image]:
    """Pictures that are white on the right, and on the left brighter the later they are."""
    made = []
    for k in range(num):
        pixels = np.full((48, 64), 20 * k, np.uint8)
        pixels[:, 32:] = 255
        made.append(Image.fromarray(pixels))
    return made


def test_frames_have_the_times_at_which_they_are_shown(tmp_path: Path) -> None:
    source = open_source(write_video(tmp_path / "a.mkv", pictures(5), TIMES_S), "")
    frames = list(source.frames())
    assert [frame.number for frame in frames] == [0, 1, 2, 3, 4]
    np.testing.assert_allclose([frame.time_s for frame in frames], np.subtract(TIMES_S, 20.0), atol=1e-3)
    left = [int(np.asarray(frame.grey())[10, 10]) for frame in frames]
    np.testing.assert_allclose(left, [0, 20, 40, 60, 80], atol=6)
    assert source.clock == "seconds from its first frame, because it has no creation time"


@pytest.mark.parametrize("created", ["2026-05-04T10:00:00Z", "2026-05-04T12:00:00+02:00"])
def test_the_creation_time_is_the_first_frames_and_not_for_sure(created: str, tmp_path: Path) -> None:
    source = open_source(write_video(tmp_path / "a.mp4", pictures(5), TIMES_S, created=created), "")
    assert next(source.frames()).time_s == START_S
    assert "2026-05-04 10:00:00+00:00; that time is in whole seconds" in source.clock
    assert source.what.startswith("video, 64 x 48 pixels, 1.0")
    assert (source.num_photos(2.0), source.num_photos(100.0)) == (3, 5)


def test_a_creation_time_that_nobody_set_is_none(tmp_path: Path) -> None:
    path = write_video(tmp_path / "a.mp4", pictures(2), TIMES_S[:2], created="1970-01-01T00:00:00Z")
    assert next(open_source(path, "").frames()).time_s == 0.0


def test_photos_of_a_phone_held_upright_are_upright(tmp_path: Path) -> None:
    source = open_source(write_video(tmp_path / "a.mp4", pictures(2), TIMES_S[:2], matrix=PORTRAIT), "")
    assert source.size_px == (48, 64)
    assert source.notes[0].startswith("the photos are turned as players show the video")
    next(source.frames()).write(tmp_path / "photo.jpg")
    with Image.open(tmp_path / "photo.jpg") as photo:
        assert photo.size == (48, 64)
        grey = np.asarray(photo.convert("L"))
    assert grey[:28].max() < 10
    assert grey[36:].min() > 245


@pytest.mark.parametrize("content", [b"", b"no video at all" * 100])
def test_what_is_no_video_is_refused_in_one_line(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "a.mp4").write_bytes(content)
    with pytest.raises(InputError, match=r"a.mp4: cannot be read as a video \(Invalid data found"):
        open_source(tmp_path / "a.mp4", "")


def test_missing_package_is_said_with_the_command_that_installs_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(InputError, match=r"pip install '\.\[video\]' in a clone"):
        open_source(tmp_path / "a.mp4", "")


@settings(max_examples=30)
@given(damage=DAMAGES)
def test_a_damaged_video_is_read_or_refused(damage: Damage, tmp_path_factory: pytest.TempPathFactory) -> None:
    path = write_video(tmp_path_factory.mktemp("video") / "a.mp4", pictures(5), TIMES_S)
    damage.read_or_refused(path)

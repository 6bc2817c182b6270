"""The sharpest frame of each interval becomes a photo, and a folder of photos is complete or does not exist."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from tests.outputs import names_in

from rangesfm.errors import InputError
from rangesfm.options import CameraOptions
from rangesfm.progress import Progress
from rangesfm.sfm.image_times import read_image_times_csv
from rangesfm.survey.sources import extract
from rangesfm.survey.sources.extract import TakenPhotos, sharpest, take_photos
from rangesfm.survey.sources.source import Frame, PhotoSource

CONTRASTS = {"blurred": 10, "sharp": 200}


def frame(number: int, time_s: float, how: str = "blurred") -> Frame:
    """A frame of stripes whose contrast depends on ``how``."""
    stripes = np.zeros((8, 8), np.uint8)
    stripes[:, ::2] = CONTRASTS[how]
    image = Image.fromarray(stripes)
    return Frame(number, time_s, ".png", lambda: image, image.save)


CAMERA = CameraOptions(model="PINHOLE", params=(9.0, 9.0, 4.0, 4.0))


class Film:
    """A source of frames in place of a video, which counts how often it is read."""

    def __init__(self, path: Path, frames: Sequence[Frame | type[BaseException]]):
        self.path, self.frames, self.num_watched = path, frames, 0
        path.write_text("a film")

    def open(self, path: Path, topic: str) -> PhotoSource:
        return PhotoSource("a film", (8, 8), 2.0, 8, "its own", self.watch, CAMERA, ("in black",))

    def watch(self) -> Iterator[Frame]:
        self.num_watched += 1
        for item in self.frames:
            if not isinstance(item, Frame):
                raise item
            yield item


@pytest.fixture
def film(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Film:
    film = Film(tmp_path / "film.mp4", [frame(k, 100 + 0.25 * k) for k in range(8)])
    monkeypatch.setattr(extract, "open_source", film.open)
    return film


def take(film: Film, *, rate_hz: float = 2.0, topic: str = "", restart: bool = False) -> TakenPhotos:
    folder = film.path.parent / "out" / "photos"
    return take_photos(film.path, [folder], rate_hz=rate_hz, topic=topic, progress=Progress(), restart=restart)[1]


def test_of_each_interval_the_sharpest_is_chosen_and_an_empty_one_has_none() -> None:
    frames = [
        *(frame(0, 7.0), frame(1, 7.3, "sharp"), frame(2, 7.49)),
        *(frame(3, 8.6), frame(4, 8.9, "sharp")),
        *(frame(5, 9.0, "sharp"), frame(6, 9.1)),
    ]
    assert [chosen.number for chosen in sharpest(frames, 2.0)] == [1, 4, 5]


def test_of_frames_as_sharp_as_each_other_the_first_is_chosen_at_steps_that_are_no_round_numbers() -> None:
    frames = [frame(k, 1.7e9 + k / 30) for k in range(90)]
    assert [chosen.number for chosen in sharpest(frames, 3.0)] == [*range(0, 90, 10)]


def test_a_frame_that_is_not_later_than_those_before_it_is_left_out() -> None:
    times_s = (5.0, 5.5, 5.5, 5.2, 6.0)
    assert [chosen.number for chosen in sharpest(map(frame, range(5), times_s), 10.0)] == [0, 1, 4]


def test_photos_come_with_their_times_and_what_is_known_of_them(film: Film) -> None:
    taken = take(film)
    folder = film.path.parent / "out" / "photos"
    names = tuple(f"frame_{number:06d}.png" for number in (0, 2, 4, 6))
    times = read_image_times_csv(folder / "images.csv", names)
    assert times.by_name() == dict(zip(names, (100.0, 100.5, 101.0, 101.5)))
    assert {path.name for path in folder.iterdir()} == {*names, "images.csv", "photos.json"}
    assert taken.camera == CAMERA
    assert taken.notes == ("the photos are the sharpest of each 0.5 s of film.mp4; their times are its own", "in black")


def test_photos_are_taken_once_until_the_source_or_what_is_asked_of_it_changes(film: Film) -> None:
    first = take(film)
    assert take(film) == first
    assert film.num_watched == 1
    film.path.touch()  # the same content at another time
    assert take(film).image_names == first.image_names
    assert film.num_watched == 1
    film.path.write_text("another film")
    take(film)
    take(film, rate_hz=4.0)
    take(film, rate_hz=4.0, topic="/left")
    take(film, rate_hz=4.0, topic="/left", restart=True)
    assert film.num_watched == 5
    (film.path.parent / "out" / "photos" / first.image_names[1]).unlink()
    assert len(take(film, rate_hz=4.0, topic="/left").image_names) == 8
    assert film.num_watched == 6


@pytest.mark.parametrize("error", [KeyboardInterrupt, InputError])
def test_what_ends_halfway_leaves_the_photos_of_before_and_nothing_else(error: type[BaseException], film: Film) -> None:
    before = take(film)
    film.frames = [*film.frames[:5], error("in the middle")]  # type: ignore[list-item]
    film.path.write_text("another film")
    with pytest.raises(error):
        take(film)
    out = film.path.parent / "out"
    assert names_in(out) == ["photos"]
    assert TakenPhotos.read(out / "photos" / "photos.json") == before


def test_a_single_photo_is_refused(film: Film) -> None:
    with pytest.raises(InputError, match=r"film.mp4: fewer than 2 photos at 0.1 Hz"):
        take(film, rate_hz=0.1)
    assert not (film.path.parent / "out" / "photos").exists()

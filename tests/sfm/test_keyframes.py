from __future__ import annotations

import math

import numpy as np
import pytest

from rangesfm.errors import InputError
from rangesfm.options import ImageOptions
from rangesfm.sfm.image_times import ImageTimes
from rangesfm.sfm.keyframes import select_keyframes


def photos_at(*timestamps_s: float) -> ImageTimes:
    names = tuple(f"{index}" for index in range(len(timestamps_s)))
    return ImageTimes(names, np.array(timestamps_s), 0.001, "csv")


def select(image_times: ImageTimes, **options: float | None) -> list[int]:
    return [int(name) for name in select_keyframes(image_times, ImageOptions(**options))]  # type: ignore[arg-type]


def test_all_photos_are_keyframes_by_default() -> None:
    assert select(photos_at(1.0, 2.0, 5.0)) == [0, 1, 2]


def test_every_third_photo() -> None:
    assert select(photos_at(*range(10)), every_nth=3) == [0, 3, 6, 9]


def test_keyframes_are_at_least_the_interval_apart() -> None:
    assert select(photos_at(0.0, 0.4, 1.0, 1.9, 2.1, 5.0, 5.9, 6.0), min_interval_s=1.0) == [0, 2, 4, 5, 7]


def test_the_interval_is_not_missed_by_rounding_of_times_since_1970() -> None:
    times = 1.4e9 + np.arange(10) * 0.1
    assert select(photos_at(*times), min_interval_s=0.2) == [0, 2, 4, 6, 8]


def test_an_interval_of_next_to_nothing_keeps_each_photo_once() -> None:
    assert select(photos_at(0.0, 0.4, 1.0), min_interval_s=1e-300) == [0, 1, 2]


def test_too_many_are_thinned_evenly_with_both_ends_kept() -> None:
    assert select(photos_at(*range(101)), max_num_keyframes=5) == [0, 25, 50, 75, 100]
    assert select(photos_at(*range(4)), max_num_keyframes=5) == [0, 1, 2, 3]


def test_all_conditions_hold_together() -> None:
    assert select(photos_at(*range(100)), every_nth=2, min_interval_s=3.0, max_num_keyframes=4) == [0, 32, 64, 96]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"every_nth": 0}, "every_nth is 0, expected a whole number from 1 to"),
        ({"min_interval_s": -1.0}, "min_interval_s is -1.0, expected a number of seconds from 0 to"),
        ({"min_interval_s": math.nan}, "min_interval_s is nan"),
        ({"max_num_keyframes": 2}, "max_num_keyframes is 2, expected a whole number from 3 to"),
        ({"every_nth": 5}, "2 of 10 photos are chosen as keyframes, expected at least 3"),
    ],
)
def test_refuses_options_that_leave_nothing_to_reconstruct(options: dict[str, float], message: str) -> None:
    with pytest.raises(InputError, match=message):
        select(photos_at(*range(10)), **options)


def test_photos_without_times_keep_the_order_of_their_names() -> None:
    names = [f"{k}.jpg" for k in range(10)]
    assert select_keyframes(names, ImageOptions(every_nth=3)) == ("0.jpg", "3.jpg", "6.jpg", "9.jpg")
    with pytest.raises(InputError, match="min_interval_s is 1, but the photos have no times"):
        select_keyframes(names, ImageOptions(min_interval_s=1.0))

"""Choice of keyframes: enough photos for a model, but not so many that it takes too long."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rangesfm.arrays import Array
from rangesfm.errors import InputError
from rangesfm.options import ImageOptions
from rangesfm.sfm.image_times import ImageTimes
from rangesfm.util.geometry.trajectory import ROUNDING_S

MIN_NUM_KEYFRAMES = 3


def select_keyframes(photos: ImageTimes | Sequence[str], options: ImageOptions) -> tuple[str, ...]:
    """Return the names of the keyframes in time order, or in the given order for photos without times.

    Every n-th photo is taken. Of these, those at least ``min_interval_s`` apart are kept. If these are more than
    ``max_num_keyframes``, so many are taken, evenly spaced. The first photo is always a keyframe.

    Raises:
        InputError: fewer than three keyframes are left, or a least interval is set for photos without times.
    """
    names = photos.image_names if isinstance(photos, ImageTimes) else tuple(photos)
    kept = np.arange(0, len(names), options.every_nth)
    if options.min_interval_s > 0:
        if not isinstance(photos, ImageTimes):
            raise InputError(f"min_interval_s is {options.min_interval_s:g}, but the photos have no times")
        kept = kept[_far_enough_apart(photos.timestamps_s[kept], options.min_interval_s)]
    if options.max_num_keyframes is not None and len(kept) > options.max_num_keyframes:
        kept = kept[np.linspace(0, len(kept) - 1, options.max_num_keyframes).round().astype(int)]
    if len(kept) < MIN_NUM_KEYFRAMES:
        raise InputError(
            f"{len(kept)} of {len(names)} photos are chosen as keyframes, expected at least {MIN_NUM_KEYFRAMES}"
            f" (every_nth {options.every_nth}, min_interval_s {options.min_interval_s:g})"
        )
    return tuple(names[index] for index in kept)


def _far_enough_apart(timestamps_s: Array, min_interval_s: float) -> list[int]:
    kept = [0]
    for index, time in enumerate(timestamps_s[1:].tolist(), 1):
        if time - timestamps_s[kept[-1]] >= min_interval_s - ROUNDING_S:
            kept.append(index)
    return kept

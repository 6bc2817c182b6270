"""The place of a map in the site's frame: how well it is known, in numbers and in words."""

from __future__ import annotations

from typing import Literal

import numpy as np

from rangesfm.arrays import Array
from rangesfm.util.files.records import Number, Record, Text, Vector
from rangesfm.util.geometry.numerics import DOUBTFUL_ABOVE, NORMAL_95
from rangesfm.util.geometry.similarity import similarity_motions


class Place(Record):
    """The map's place in the site's frame, with its uncertainty.

    Attributes:
        reasons: why, in words.
        stddev_m: standard deviations of the map's middle in x, y, z.
        heading_stddev_deg: standard deviation of the map's rotation about z.
        worst_keyframe_stddev_m: of the keyframe with the least certain position: root of its summed variances.
    """

    verdict: Literal["good", "doubtful"]
    reasons: tuple[Text, ...]
    stddev_m: Vector
    heading_stddev_deg: Number
    worst_keyframe_stddev_m: Number


def place_in_words(stddevs: Array, worst_m: float, size_m: float) -> tuple[str, bool]:
    """Return how well a map's place is known, in words, and whether that is too little to call it good.

    Args:
        stddevs: (7,) of the map's similarity about its middle. worst_m: standard deviation of the position of the least
            certain keyframe. size_m: of the site.
    """
    half_widths = NORMAL_95 * np.array([np.linalg.norm(stddevs[4:]), np.rad2deg(stddevs[3]), worst_m])
    place, heading, worst = (
        f"{half_width:.2g} {unit}" if np.isfinite(half_width) else "nothing"
        for half_width, unit in zip(half_widths, ("m", "deg", "m"), strict=True)
    )
    words = f"the map's place is known to {place}, its heading to {heading}, each keyframe to {worst} or better (95 %)"
    # The scale's own limit, applied to the site's size and to a radian: then no length and no place is less certain.
    most_m, most_deg = DOUBTFUL_ABOVE * size_m, np.rad2deg(DOUBTFUL_ABOVE)
    limit = ""
    if half_widths[2] > most_m:
        limit = f"each keyframe has to be known to {most_m:.2g} m, {100 * DOUBTFUL_ABOVE:g} % of the site's size"
    elif half_widths[1] > most_deg:
        limit = f"the heading has to be known to {most_deg:.2g} deg"
    return words + (f"; to be good, {limit}" if limit else ""), bool(limit)


def by_similarity(placement: Array, centers_m: Array) -> tuple[Array, Array]:
    """Return the covariance (7, 7) about the middle of the centres and (n, 3, 3) of each, for a rigid map."""
    from_first = similarity_motions(centers_m - centers_m[0])
    to_middle = np.eye(7)
    to_middle[4:] = from_first.mean(axis=0)
    return to_middle @ placement @ to_middle.T, from_first @ placement @ np.swapaxes(from_first, 1, 2)

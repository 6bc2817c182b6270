"""Distances between anchors: from the ranges that they took among themselves, and from their surveyed places."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np

from rangesfm.arrays import Array
from rangesfm.distances.ends import LocatedDistances
from rangesfm.distances.tape import CONTROL, TapedDistance
from rangesfm.ranging.anchors.anchor import Anchor
from rangesfm.ranging.errors.noise import shared_stddev
from rangesfm.ranging.log import RangeLog

# Stddev of a median over that of a mean.
_MEDIAN_OVER_MEAN = 1.2533


def distances_by_radio(
    log: RangeLog, noise_m: float, bias_m: Array, bias_stddev_m: Array, common_bias_stddev_m: float
) -> LocatedDistances:
    """One distance for each pair of anchors that ranged: the median of their ranges, in either direction.

    A pair's ranges all err by the same delays and reflections: many of them are hardly better than one. A bias is
    an anchor's with the tag; two radios of one kind read by the mean of theirs too long.

    Args:
        noise_m: stddev of a range of which the log says none.
        bias_m, bias_stddev_m: (num_anchors,) what each anchor's ranges read too long, as far as that is known.
        common_bias_stddev_m: of what all ranges between anchors read too long.
    """
    ranges = log.anchor_anchor_ranges()
    pairs, index = np.unique(np.sort(ranges.ends, axis=1), axis=0, return_inverse=True)
    index = index.reshape(-1)
    count = np.bincount(index, minlength=len(pairs))
    noise = np.where(np.isfinite(ranges.range_stddev_m), ranges.range_stddev_m, noise_m)
    medians = np.array([np.median(ranges.range_m[index == k]) for k in range(len(pairs))])
    mean_square = np.bincount(index, noise**2, len(pairs)) / count
    shared = np.bincount(index, shared_stddev(log)[ranges.rows], len(pairs)) / count
    first, second = pairs.reshape(-1, 2).T
    variance = _MEDIAN_OVER_MEAN**2 * mean_square / count + shared**2 + common_bias_stddev_m**2
    variance += bias_stddev_m[first] ** 2 + bias_stddev_m[second] ** 2
    return LocatedDistances(
        model_length=np.full(len(pairs), np.nan),
        anchor_pair=pairs.reshape(-1, 2),
        distance_m=medians - (bias_m[first] + bias_m[second]) / 2,
        stddev_m=np.sqrt(variance),
        is_check=np.zeros(len(pairs), dtype=bool),
    )


# So that it can be divided by.
_MIN_STDDEV_M = 1e-3


def surveyed_distances(anchors: Sequence[Anchor]) -> tuple[TapedDistance, ...]:
    """One for each pair of anchors with given positions, as if it had been taped."""
    return tuple(
        TapedDistance(
            (first.anchor_id, second.anchor_id),
            float(np.linalg.norm(first.position_m - second.position_m)),
            max(float(np.hypot(first.position_stddev_m, second.position_stddev_m)), _MIN_STDDEV_M),
            CONTROL,
            line=0,
        )
        for first, second in itertools.combinations(anchors, 2)
        if first.position_m is not None and second.position_m is not None
    )

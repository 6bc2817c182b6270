"""Distances between anchors whose places somebody surveyed: they hold in any frame."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np

from rangesfm.distances.tape import CONTROL, TapedDistance
from rangesfm.ranging.anchors.anchor import Anchor

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

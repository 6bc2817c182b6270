"""Ranges as a problem of the range equation, from a path and its anchors alone."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from rangesfm.measurements.ranges.scale.range_equation import RangeProblem

Array = npt.NDArray[np.float64]


def range_problem(
    centers: Array, anchors_m: Array, range_m: Array | None = None, *, stddev_m: float | Array = 0.1, **others: Any
) -> RangeProblem:
    """Return ranges to each anchor in turn, without lever arms and biases; an anchor at NaN is unknown.

    Args:
        centers: (n, 3), model units. anchors_m: (m, 3).
        range_m: (n,); None: all are 1 m.
        others: attributes of the problem that are different.
    """
    num, num_anchors = len(centers), len(anchors_m)
    given = {
        "tag_from_center": np.zeros((num, 3)),
        "anchor_index": np.arange(num) % num_anchors,
        "anchor_stddev_m": np.where(np.isnan(anchors_m[:, 0]), np.inf, 0.0),
        "bias_mean_m": np.zeros(num_anchors),
        "bias_stddev_m": np.zeros(num_anchors),
        "common_bias_stddev_m": 0.0,
        "frame_is_free": True,
    }
    return RangeProblem(
        centers=centers,
        range_m=np.ones(num) if range_m is None else range_m,
        stddev_m=np.broadcast_to(stddev_m, num).astype(np.float64),
        share=np.ones(num),
        anchor_mean_m=anchors_m,
        **{**given, **others},
    )

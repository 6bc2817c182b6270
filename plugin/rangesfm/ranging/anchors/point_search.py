"""Where a robust fit of a point to ranges begins: the best of many starts, whatever the outliers.

Starts all around the tag and a linear one follow the minima of a Cauchy loss while it narrows from
metres to centimetres; the likelihood, in which its width counts, chooses among all that they pass.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from rangesfm.geometry.similarity import path_shape
from rangesfm.ranging.anchors.multilateration import multilaterate
from rangesfm.ranging.anchors.point_fit import PointProblem, improve

Array = npt.NDArray[np.float64]

_MAX_NUM_RANGES = 300
_NUM_DIRECTIONS = 20
_NUM_STEPS = 2
_NUM_WIDE = 4
_NUM_KEPT = 8
# Residuals beyond so many stddevs say nothing of the noise; what is left has this share of its variance.
_TRUNCATION = 2.5
_VARIANCE_WITHIN_TRUNCATION = 0.9113
_NUM_TRUNCATIONS = 12
_MIN_NOISE = 1e-9
# In units: from metres down to a fifth of what is usual.
_NOISES = 0.2 * 1.4 ** np.arange(16)[::-1]


def best_start(problem: PointProblem, unit_m: Array) -> tuple[Array, float]:
    """The most likely point.

    Args:
        problem: of its stddevs only the shared ones are looked at.
        unit_m: (n,) how the noise of the ranges compares.

    Returns:
        (4,) unknowns, and the noise there as a multiple of ``unit_m``.
    """
    rows = np.linspace(0, len(unit_m) - 1, min(len(unit_m), _MAX_NUM_RANGES)).astype(np.int64)
    part, unit_m = problem.subset(rows), unit_m[rows]
    x = _starts(part)
    best_x, best_noise, least = x[0], float(_NOISES[0]), np.inf
    for step, noise in enumerate(_NOISES):
        now = replace(part, stddev_m=np.hypot(noise * unit_m, part.shared_stddev_m))
        x, _ = improve(now, x, _NUM_STEPS)
        unlikelihood = now.unlikelihood(x)
        if np.min(unlikelihood) < least:
            best_x, best_noise, least = x[np.argmin(unlikelihood)], float(noise), float(np.min(unlikelihood))
        if step == _NUM_WIDE:
            x = x[np.argsort(unlikelihood)[:_NUM_KEPT]]
    return best_x, best_noise


def inlier_noise(scaled: Array, start: float) -> float:
    """Stddev of (n,) residuals without those that lie outside, from a value that is about right."""
    noise = start
    for _ in range(_NUM_TRUNCATIONS):
        inside = np.abs(scaled) <= _TRUNCATION * noise
        if not inside.any():
            break
        noise = float(np.sqrt(np.mean(scaled[inside] ** 2) / _VARIANCE_WITHIN_TRUNCATION)) + _MIN_NOISE
    return noise


def _starts(problem: PointProblem) -> Array:
    """(k, 4): all around the middle of the tag's positions, and the linear solution on either side."""
    bias = problem.prior_mean[3]
    ranges = problem.range_m - bias
    shape = path_shape(problem.positions_m)
    linear, _ = multilaterate(problem.positions_m, ranges)
    normal = shape.axes[:, 2]
    mirrored = linear - 2 * ((linear - shape.centroid) @ normal) * normal
    points = np.concatenate([shape.centroid + np.median(ranges) * _directions(), linear[None], mirrored[None]])
    return np.column_stack([points, np.full(len(points), bias)])


def _directions() -> Array:
    """(m, 3) unit vectors, evenly spread along a spiral from pole to pole."""
    step = np.arange(_NUM_DIRECTIONS) + 0.5
    height, turn = 1 - 2 * step / _NUM_DIRECTIONS, np.pi * (1 + 5**0.5) * step
    flat = np.sqrt(1 - height**2)
    return np.stack([flat * np.cos(turn), flat * np.sin(turn), height], axis=1)

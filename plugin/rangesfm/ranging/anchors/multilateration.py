"""A point from its distances to known positions, without a first guess."""

from __future__ import annotations

import numpy as np

from rangesfm.arrays import Array
from rangesfm.geometry.similarity import path_shape
from rangesfm.ranging.errors.noise import robust_stddev


def multilaterate(positions: Array, ranges: Array) -> tuple[Array, Array]:
    """A point from its distances to known positions, robustly, without a start.

    rho^2 = |p|^2 - 2 a.p + |a|^2 is linear in (a, |a|^2). Where the positions lie in a plane,
    the height above it follows from |a|^2; its sign is arbitrary.

    Returns:
        the point (3,), and (n,) residuals in metres (of the linear model).
    """
    shape = path_shape(positions)
    local = (positions - shape.centroid) @ shape.axes
    # Noise of about a decimetre decides which directions the ranges see at all.
    seen = shape.stddevs > max(0.02 * shape.stddevs[0], 1e-9)
    design = np.column_stack([-2 * local[:, seen], np.ones(len(local))])
    squared = ranges**2 - np.sum(local**2, axis=1)
    weights = 1 / np.maximum(2 * ranges, 1e-3)
    robust = np.ones(len(local))
    for _ in range(12):
        w = weights * np.sqrt(robust)
        solution = np.linalg.lstsq(design * w[:, None], squared * w, rcond=1e-10)[0]
        residuals = weights * (design @ solution - squared)
        robust = 1 / (1 + (residuals / (2 * robust_stddev(residuals))) ** 2)
    point = np.zeros(3)
    point[seen] = solution[:-1]
    rest = solution[-1] - float(point @ point)
    unseen = np.flatnonzero(~seen)
    if len(unseen):
        point[unseen[-1]] = np.sqrt(max(rest, 0.0))
    anchor: Array = shape.centroid + shape.axes @ point
    return anchor, residuals

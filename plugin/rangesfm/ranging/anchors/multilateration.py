"""A point from its distances to known positions, without a first guess."""

from __future__ import annotations

import numpy as np

from rangesfm.arrays import Array
from rangesfm.geometry.similarity import path_shape
from rangesfm.ranging.errors.noise import robust_stddevs

_NUM_ROUNDS = 12
# On the diagonal of normal equations, whose columns have length 1 before weights: where outliers take all weight.
_RIDGE = 1e-16


def multilaterate(positions: Array, ranges: Array) -> tuple[Array, Array]:
    """A point from its distances to known positions, robustly, without a start.

    rho^2 = |p|^2 - 2 a.p + |a|^2 is linear in (a, |a|^2). Where the positions lie in a plane,
    the height above it follows from |a|^2; its sign is arbitrary.

    Args:
        positions: (..., n, 3), of one point or of many at once.
        ranges: (n,) or (..., n).

    Returns:
        the point (..., 3), and (..., n) residuals in metres (of the linear model).
    """
    shape = path_shape(positions)
    local = (positions - shape.centroid[..., None, :]) @ shape.axes
    # Noise of about a decimetre decides which directions the ranges see at all.
    seen = shape.stddevs > np.maximum(0.02 * shape.stddevs[..., :1], 1e-9)
    squared = ranges**2 - np.sum(local**2, axis=-1)
    design = np.concatenate([-2 * local * seen[..., None, :], np.ones_like(local[..., :1])], axis=-1)
    sizes = np.linalg.norm(design, axis=-2, keepdims=True)
    sizes = np.where(sizes > 0, sizes, 1.0)
    design, nothing = design / sizes, np.concatenate([~seen, np.zeros_like(seen[..., :1])], axis=-1)
    rest = (nothing + _RIDGE)[..., None] * np.eye(4)
    weights = 1 / np.maximum(2 * ranges, 1e-3)
    robust = np.ones_like(squared)
    for _ in range(_NUM_ROUNDS):
        weighted = (design * (weights**2 * robust)[..., None]).swapaxes(-1, -2)
        solution = np.linalg.solve(weighted @ design + rest, weighted @ squared[..., None])
        residuals = weights * ((design @ solution)[..., 0] - squared)
        robust = 1 / (1 + (residuals / (2 * robust_stddevs(residuals))) ** 2)
    point, height = np.split(solution[..., 0] / sizes[..., 0, :], [3], axis=-1)
    above = np.sqrt(np.maximum(height - np.sum(point**2, axis=-1, keepdims=True), 0.0))
    point = np.where(~seen & (np.arange(3) == 2), above, point)
    anchor: Array = shape.centroid + (shape.axes @ point[..., None])[..., 0]
    return anchor, residuals

"""Fit of ranges to antenna positions with unknown anchors and unknown scale.

With the anchor at a, the scale alpha and the antenna at p (model units), the squared range is linear in the unknown
coefficients: rho^2 = alpha^2 |p|^2 - 2 alpha a.p + |a|^2. The relation between the coefficients is not used, so that
there is one solution and no start is needed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rangesfm.arrays import Array, Indices, rows_by_key
from rangesfm.measurements.ranges.errors.noise import MIN_NOISE_M, START_STDDEV_M
from rangesfm.util.geometry.numerics import NUM_REWEIGHTINGS, SIGNIFICANT_STDDEVS
from rangesfm.util.geometry.robust_statistics import CAUCHY, robust_stddev

# Shorter ranges get the weight of a range of this length, because the derivative of their square is near 0. They are no
# longer than their errors may be.
MIN_RANGE_M = SIGNIFICANT_STDDEVS * START_STDDEV_M
# The column |p|^2 must be significant by this many standard deviations for the scale to be used.
_MIN_CURVATURE_STDDEVS = 5.0


@dataclass(frozen=True)
class RobustFit:
    """Robust fit of n numbers by linear unknowns, of which one is the scale of a path.

    Attributes:
        weights: (n,) weights of the Cauchy loss, in [0, 1].
        residuals_m: (n,) measured minus fitted.
        gradient: (n, 3) derivative of each fitted number by its point on the path, metres per model unit.
        scale: metres per model unit; infinite if the path is too small to determine it.
        num_unknowns: their number.
        basis: (n, p) orthonormal weighted columns of all unknowns.
    """

    weights: Array
    residuals_m: Array
    gradient: Array
    scale: float
    num_unknowns: int
    basis: Array

    @property
    def weighted_residuals(self) -> Array:
        """Residuals times the roots of their weights (n,), metres."""
        return np.asarray(np.sqrt(self.weights) * self.residuals_m)

    def unexplained(self, values: Array) -> Array:
        """Return weighted changes of the numbers (n, k) without the parts that the unknowns can explain."""
        weighted = np.sqrt(self.weights)[:, None] * values
        return np.asarray(weighted - self.basis @ (self.basis.T @ weighted))


def fit_squares(points: Array, range_m: Array, anchor: Indices, loss_scale: float = CAUCHY.width) -> RobustFit:
    """Fit ``rho^2 = alpha^2 |p|^2 + b.p + k``, with b and k for each anchor and one scale alpha for all.

    It is solved by iteratively reweighted least squares, starting from equal weights.

    Args:
        points: (n, 3) positions of the antenna, model units.
        range_m: (n,) ranges, metres.
        anchor: (n,) index of each range's anchor.
        loss_scale: width of the loss, in standard deviations of the residuals.
    """
    middle = points.mean(axis=0)
    unit = max(float(np.sqrt(np.mean((points - middle) ** 2))), 1e-300)
    points = (points - middle) / unit
    design, groups = np.column_stack([points, np.ones(len(points))]), rows_by_key(anchor)
    # Division by the derivative of rho^2 converts residuals back to metres.
    metres = 1 / (2 * np.maximum(range_m, MIN_RANGE_M))
    residuals_m = np.zeros(len(points))
    for _ in range(NUM_REWEIGHTINGS + 1):
        weights = 1 / (1 + (residuals_m / (loss_scale * residual_stddev(residuals_m))) ** 2)
        columns = _LinearColumns(design, metres * np.sqrt(weights), groups)
        alpha_squared, coefficients, residuals = columns.solve(range_m**2)
        residuals_m = residuals / np.sqrt(weights)
    is_curved = alpha_squared * np.linalg.norm(columns.curvature) > _MIN_CURVATURE_STDDEVS * np.std(residuals)
    gradient = metres[:, None] * (2 * alpha_squared * points + coefficients) / unit
    scale = float(np.sqrt(alpha_squared)) / unit if is_curved else np.inf
    return RobustFit(weights, residuals_m, gradient, scale, 4 * len(groups) + 1, columns.basis())


class _LinearColumns:
    """Weighted columns of the linear model, with those of each anchor made orthonormal.

    Attributes:
        curvature: (n,) part of the column |p|^2 that the anchors' own unknowns do not explain.
    """

    def __init__(self, design: Array, row_weights: Array, groups: list[Indices]):
        self._row_weights = row_weights
        self._squared_norm = np.sum(design[:, :3] ** 2, axis=1)
        self._factors = []
        weighted = row_weights[:, None] * design
        of_groups = [weighted[rows] for rows in groups]
        decomposed = np.linalg.eigh([own.T @ own for own in of_groups])
        for rows, own, squared_lengths, directions in zip(groups, of_groups, *decomposed, strict=True):
            # On a flat or straight path some columns contain only rounding errors, and are dropped.
            kept = squared_lengths > 1e-10 * squared_lengths[-1]
            solution = directions[:, kept] / np.sqrt(squared_lengths[kept])
            self._factors.append((rows, own @ solution, solution))
        self.curvature = self.without_anchors((row_weights * self._squared_norm)[:, None])[:, 0]

    def without_anchors(self, values: Array) -> Array:
        """Return columns (n, k) without the part that the anchors' own unknowns explain."""
        left_over = values.copy()
        for rows, basis, _ in self._factors:
            left_over[rows] -= basis @ (basis.T @ values[rows])
        return left_over

    def basis(self) -> Array:
        """Return the orthonormal columns of all unknowns; those of an anchor are zero for the ranges of others."""
        padded = []
        for rows, basis, _ in self._factors:
            padded.append(np.zeros((len(self._row_weights), basis.shape[1])))
            padded[-1][rows] = basis
        return np.column_stack([*padded, self.curvature / max(float(np.linalg.norm(self.curvature)), 1e-300)])

    def solve(self, squared_ranges: Array) -> tuple[float, Array, Array]:
        """Return alpha^2 (not negative), the vector b of each range's anchor (n, 3), and weighted residuals (n,)."""
        weighted = self._row_weights * squared_ranges
        left_over = self.without_anchors(weighted[:, None])[:, 0]
        curvature = self.curvature
        alpha_squared = max(float(curvature @ left_over) / max(float(curvature @ curvature), 1e-300), 0.0)
        weighted = weighted - alpha_squared * self._row_weights * self._squared_norm
        coefficients = np.empty((len(weighted), 3))
        for rows, basis, solution in self._factors:
            coefficients[rows] = (solution @ (basis.T @ weighted[rows]))[:3]
        return alpha_squared, coefficients, left_over - alpha_squared * curvature


def residual_stddev(residuals_m: Array) -> float:
    """Return a robust standard deviation of residuals, at least the smallest noise."""
    return max(robust_stddev(residuals_m), MIN_NOISE_M)

"""Ranges at times on the radio's clock, as the offset of that clock is found from them.

With the anchor at a, the scale alpha and the antenna at p (model units), the squared range is linear in the unknown
coefficients: rho^2 = alpha^2 |p|^2 - 2 alpha a.p + |a|^2. The relation between the coefficients is not used, so that
there is one solution and no start is needed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations_with_replacement

import numpy as np
import numpy.typing as npt

from rangesfm.arrays import Array, Indices, rows_by_key
from rangesfm.measurements.clock.fit import Observed, OffsetFit, residual_stddev
from rangesfm.measurements.clock.offset import OffsetCurve
from rangesfm.measurements.clock.path_samples import Cells, centred_columns
from rangesfm.measurements.ranges.errors.noise import START_STDDEV_M
from rangesfm.util.geometry.numerics import NUM_REWEIGHTINGS, SIGNIFICANT_STDDEVS
from rangesfm.util.geometry.robust_statistics import CAUCHY, RobustLoss

# Shorter ranges get the weight of a range of this length, because the derivative of their square is near 0. They are no
# longer than their errors may be.
_MIN_RANGE_M = SIGNIFICANT_STDDEVS * START_STDDEV_M
# The column |p|^2 must be significant by this many standard deviations for the scale to be used.
_MIN_CURVATURE_STDDEVS = 5.0


@dataclass(frozen=True)
class TimedRanges(Observed):
    """n ranges in metres along a path, with the indices of their anchors and tags, and the loss of the fit."""

    range_m: Array
    anchor: Indices
    tag: Indices
    loss: RobustLoss = CAUCHY

    name = "ranges"
    remedy = "give the time offset (--ranges_time_offset)"
    may_drift = True

    @property
    def numbers(self) -> Array:
        return self.range_m

    @property
    def alike(self) -> Indices:
        return self.anchor

    def fit(self, offset_s: float, before: OffsetFit | None = None) -> OffsetFit:
        """Fit ``rho^2 = alpha^2 |p|^2 + b.p + k``, with b and k for each anchor and one scale alpha for all.

        It is solved by iteratively reweighted least squares, starting from equal weights.
        """
        here = self.take(self.on_path(offset_s))
        scale = np.inf if before is None else before.scale
        points, velocities = self.path.antennas(here.times_s + offset_s, here.tag, scale)
        points = points - points.mean(axis=0)
        unit = max(float(np.sqrt(np.mean(points**2))), 1e-300)
        points = points / unit
        num, of_anchors = len(points), rows_by_key(here.anchor)
        design, squared_m2 = np.column_stack([points, np.ones(num)]), here.range_m**2
        squared_norm = np.sum(points**2, axis=1)
        # Division by the derivative of rho^2 converts residuals back to metres.
        metres = 1 / (2 * np.maximum(here.range_m, _MIN_RANGE_M))
        residuals_m = np.zeros(num)
        for _ in range(NUM_REWEIGHTINGS + 1):
            weights = self.loss.weights(residuals_m / residual_stddev(residuals_m))
            of_row = metres * np.sqrt(weights)
            # The anchors' own unknowns are eliminated: what they explain of other columns is subtracted.
            basis, by_basis = _orthonormal(of_row[:, None] * design, of_anchors)
            curvature, left_over = (
                column - basis @ (basis.T @ column) for column in (of_row * squared_norm, of_row * squared_m2)
            )
            length = float(np.linalg.norm(curvature))
            alpha_squared = max(float(curvature @ left_over) / max(length**2, 1e-300), 0.0)
            residuals = left_over - alpha_squared * curvature
            residuals_m = residuals / np.sqrt(weights)
        by_column = basis.T @ (of_row * (squared_m2 - alpha_squared * squared_norm))
        slopes = np.empty((num, 3))
        for rows, unknowns in zip(of_anchors, np.einsum("kij,kj->ki", by_basis, by_column.reshape(-1, 4)), strict=True):
            slopes[rows] = unknowns[:3]
        rates = metres * np.sum((2 * alpha_squared * points + slopes) * velocities, axis=1) / unit
        is_curved = alpha_squared * length > _MIN_CURVATURE_STDDEVS * np.std(residuals)
        basis = basis[:, by_basis.any(axis=1).ravel()]
        return OffsetFit(
            offset_s,
            here,
            weights,
            residuals_m,
            rates,
            np.column_stack([basis, curvature / max(length, 1e-300)]),
            4 * len(by_basis) + 1,
            float(np.sqrt(alpha_squared)) / unit if is_curved else np.inf,
        )

    def scanned(self, weights: Array) -> OffsetCurve:
        """Return the linear fit of the squared ranges at every offset."""
        cells = Cells.from_times(self.times_s, self.path)
        columns = centred_columns(self.path, cells.stride)
        pairs = combinations_with_replacement(range(columns.shape[1]), 2)
        products = {(i, j): cells.of_path(columns[:, i] * columns[:, j]) for i, j in pairs}

        sums = np.zeros((5, len(cells.offsets_s)))
        for rows in rows_by_key(self.anchor):
            of_anchor = replace(cells, cell=cells.cell[rows])
            sums += _sums_of_anchor(self.range_m[rows], weights[rows], of_anchor, products)
        num, variation, without, column, cross = sums
        scale_squared = np.maximum(cross, 0.0) / np.maximum(column, 1e-12)
        residual = without - 2 * scale_squared * cross + scale_squared**2 * column
        return OffsetCurve(cells.offsets_s, num, variation, residual)


def _orthonormal(columns: Array, of_anchors: list[Indices]) -> tuple[Array, Array]:
    """Make the (n, 4) columns of the anchors' own unknowns orthonormal, over the ranges of each of k anchors.

    Returns:
        (n, 4 k) columns, 0 for the ranges of other anchors, and (k, 4, 4) the anchors' unknowns by these.
    """
    own = [columns[rows] for rows in of_anchors]
    squared_lengths, directions = np.linalg.eigh([each.T @ each for each in own])
    # On a flat or straight path some columns contain only rounding errors, and are dropped.
    kept = squared_lengths > 1e-10 * squared_lengths[:, -1:]
    by_basis = directions * np.where(kept, 1 / np.sqrt(np.where(kept, squared_lengths, 1.0)), 0.0)[:, None]
    basis = np.zeros((len(columns), len(own), 4))
    for k, rows in enumerate(of_anchors):
        basis[rows, k] = own[k] @ by_basis[k]
    return basis.reshape(len(columns), -1), by_basis


def _sums_of_anchor(
    range_m: Array,
    weights: Array,
    cells: Cells,
    products: dict[tuple[int, int], npt.NDArray[np.complex128]],
) -> Array:
    """Return five weighted sums over the ranges of one anchor on the path (5, num_offsets).

    They are the sum of weights; the squared deviation from the anchor's mean; its part that c and 1 do not explain; the
    squared part of the column |c|^2 that c and 1 do not explain; and the product of both unexplained parts.
    """
    squared = range_m**2 - np.median(range_m**2)
    # Division by the derivative of rho^2 converts residuals back to metres.
    weight = weights / (2 * np.maximum(range_m, _MIN_RANGE_M)) ** 2

    correlate = cells.correlate
    own_weights, weighted = cells.of_log(weight), cells.of_log(weight * squared)
    ones = max(products)[0]  # the last of the columns, from 0
    normal = np.empty((len(cells.offsets_s), ones + 1, ones + 1))
    for (i, j), product in products.items():
        normal[:, i, j] = normal[:, j, i] = correlate(product, own_weights)
    right = np.stack([correlate(products[i, ones], weighted) for i in range(ones + 1)], axis=1)
    total = correlate(products[ones, ones], cells.of_log(weight * squared**2))
    num = correlate(products[ones, ones], cells.of_log(weights))

    # The anchor's own unknowns are eliminated, and the unexplained parts are summed over the anchors.
    own = normal[:, 1:, 1:] + (1e-6 * normal[:, ones, ones] + 1e-9 * weight.sum())[:, None, None] * np.eye(ones)
    solved = np.linalg.solve(own, np.stack([normal[:, 1:, 0], right[:, 1:]], axis=2))
    return np.stack(
        [
            num,
            np.maximum(total - right[:, ones] ** 2 / own[:, -1, -1], 0.0),
            total - np.einsum("mi,mi->m", right[:, 1:], solved[:, :, 1]),
            normal[:, 0, 0] - np.einsum("mi,mi->m", normal[:, 1:, 0], solved[:, :, 0]),
            right[:, 0] - np.einsum("mi,mi->m", normal[:, 1:, 0], solved[:, :, 1]),
        ]
    )

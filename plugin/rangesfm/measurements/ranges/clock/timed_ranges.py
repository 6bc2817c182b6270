"""Ranges at times on the radio's clock, as the offset of that clock is found from them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations_with_replacement

import numpy as np
import numpy.typing as npt

from rangesfm.arrays import Array, Indices, rows_by_key
from rangesfm.measurements.ranges.clock.fit import Observed
from rangesfm.measurements.ranges.clock.search import Cells, PathSamples, Scanned, centred_columns
from rangesfm.measurements.ranges.clock.squares import MIN_RANGE_M, RobustFit, fit_squares


@dataclass(frozen=True)
class TimedRanges(Observed):
    """n ranges in metres, with the indices of their anchors and tags."""

    range_m: Array
    anchor: Indices
    tag: Indices

    name = "ranges"
    remedy = "give the time offset (--ranges_time_offset)"
    may_drift = True

    @property
    def numbers_m(self) -> Array:
        return self.range_m

    @property
    def alike(self) -> Indices:
        return self.anchor

    @property
    def antenna(self) -> Indices:
        return self.tag

    @property
    def start_weights(self) -> Array:
        return np.ones(len(self.range_m))

    def solved(self, points: Array) -> RobustFit:
        return fit_squares(points, self.range_m, self.anchor)

    def scanned(self, weights: Array, path: PathSamples) -> Scanned:
        """Return the linear fit of the squared ranges (see ``squares``) at every offset."""
        cells = Cells.from_times(self.times_s, path)
        columns = centred_columns(path, cells.stride)
        pairs = combinations_with_replacement(range(columns.shape[1]), 2)
        products = {(i, j): cells.of_path(columns[:, i] * columns[:, j]) for i, j in pairs}

        sums = np.zeros((5, len(cells.offsets_s)))
        for rows in rows_by_key(self.anchor):
            of_anchor = replace(cells, cell=cells.cell[rows])
            sums += _sums_of_anchor(self.range_m[rows], weights[rows], of_anchor, products)
        num, variation, without, column, cross = sums
        scale_squared = np.maximum(cross, 0.0) / np.maximum(column, 1e-12)
        residual = without - 2 * scale_squared * cross + scale_squared**2 * column
        return Scanned(num, cells.offsets_s, variation, residual)


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
    weight = weights / (2 * np.maximum(range_m, MIN_RANGE_M)) ** 2

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

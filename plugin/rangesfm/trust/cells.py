"""Cells: ranges to one anchor that follow each other, as one observation."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.sparse import csr_array

from rangesfm.arrays import Array, Indices
from rangesfm.ranging.errors.noise import MIN_STDDEV_M, robust_stddev

_MAX_NUM = 240
_MIN_NUM_RANGES = 5
# In stddevs from the median of its cell, of which the noise is at least this: what is further off is an outlier among
# its neighbours. A radio may repeat itself to a centimetre and err by ten from one place to the next.
_OUTLYING = 3.0
_LEAST_SCATTER_M = 0.08


@dataclass(frozen=True)
class Cells:
    """c cells of n ranges; of one a cell takes what is not far from the others in it, however far from the map.

    Attributes:
        cell_of_range: (n,) -1: takes no part.
        weights: (n,) by which a cell's mean is formed.
        num: c.
        scatter_m: stddev of a range among its neighbours.
    """

    cell_of_range: Indices
    weights: Array
    num: int
    scatter_m: float

    @classmethod
    def of(cls, residuals_m: Array, anchor_index: Indices, times: Array) -> Cells:
        """All n ranges, by anchor and time."""
        order = np.lexsort((times, anchor_index))
        labels = np.empty(len(order), dtype=np.int64)
        present, counts = np.unique(anchor_index, return_counts=True)
        most = max(_MAX_NUM // len(present), 1)
        num, first = 0, 0
        for count in counts.tolist():
            cells_of_anchor = int(np.clip(count // _MIN_NUM_RANGES, 1, most))
            labels[order[first : first + count]] = num + np.arange(count) * cells_of_anchor // count
            num, first = num + cells_of_anchor, first + count
        steps = np.diff(residuals_m[order])[np.diff(anchor_index[order]) == 0]
        scatter_m = max(robust_stddev(steps) / np.sqrt(2), MIN_STDDEV_M)
        off = np.abs(residuals_m - _medians(residuals_m, labels, num)[labels])
        return cls(labels, (off <= _OUTLYING * max(scatter_m, _LEAST_SCATTER_M)).astype(np.float64), num, scatter_m)

    @cached_property
    def num_ranges(self) -> Array:
        """(c,) that form each mean."""
        return np.asarray(self._of_ranges.sum(axis=1))

    def mean(self, values: Array) -> Array:
        """(c, ...) of (n, ...)."""
        sums = self._of_ranges @ values.reshape(len(values), -1)
        return np.asarray((sums / self.num_ranges[:, None]).reshape(self.num, *values.shape[1:]))

    @cached_property
    def _of_ranges(self) -> csr_array:
        """(c, n) of the weights."""
        rows = np.flatnonzero(self.cell_of_range >= 0)
        return csr_array(
            (self.weights[rows], (self.cell_of_range[rows], rows)), shape=(self.num, len(self.cell_of_range))
        )


def _medians(values: Array, labels: Indices, num: int) -> Array:
    """(num,) the lower one of two in the middle, so that it is one of the values."""
    order = np.lexsort((values, labels))
    counts = np.bincount(labels, minlength=num)
    middle = np.cumsum(counts) - counts + (counts - 1) // 2
    return np.asarray(values[order][middle])

"""Measured lengths between anchors, which hold in any frame (section 2 of ``model.md``)."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from rangesfm.arrays import Array, Indices, Mask
from rangesfm.measurements.ranges.range_gradient import RangeGradient


@dataclass(frozen=True)
class AnchorDistances:
    """k measured lengths between anchors.

    Attributes:
        anchor_pair: (k, 2) indices of the two anchors.
        distance_m, stddev_m: (k,) measured length and its standard deviation.
    """

    anchor_pair: Indices
    distance_m: Array
    stddev_m: Array

    def __len__(self) -> int:
        return len(self.distance_m)

    def subset(self, rows: Mask) -> AnchorDistances:
        """Return the lengths that are true in ``rows`` (k,)."""
        return AnchorDistances(*(getattr(self, field.name)[rows] for field in fields(self)))

    def joined(self, others: AnchorDistances) -> AnchorDistances:
        """Return these lengths followed by others."""
        pairs = ((getattr(self, field.name), getattr(others, field.name)) for field in fields(self))
        return AnchorDistances(*map(np.concatenate, pairs))

    def _gradient(self, anchors_m: Array) -> RangeGradient:
        first, second = self.anchor_pair.T
        return RangeGradient.of(anchors_m[first] - anchors_m[second])

    def residuals(self, anchors_m: Array) -> Array:
        """Return the (k,) residuals for (m, 3) positions, predicted minus measured, in standard deviations."""
        return np.asarray((self._gradient(anchors_m).distance_m - self.distance_m) / self.stddev_m)

    def jacobian(self, anchors_m: Array, anchor_column: Indices, num_columns: int) -> Array:
        """Return the (k, p) Jacobian of the residuals.

        Args:
            anchor_column: (m,) first of the three columns of each anchor; -1 for an anchor that is held fixed.
            num_columns: p.
        """
        jacobian, by = np.zeros((len(self), num_columns)), self._gradient(anchors_m)
        for anchor, slopes in zip(self.anchor_pair.T, (by.by_tag, by.by_anchor), strict=True):
            free = np.flatnonzero(anchor_column[anchor] >= 0)
            columns = anchor_column[anchor[free], None] + np.arange(3)
            jacobian[free[:, None], columns] = slopes[free] / self.stddev_m[free, None]
        return jacobian


NO_DISTANCES = AnchorDistances(np.zeros((0, 2), dtype=np.int64), np.zeros(0), np.zeros(0))

"""Taped distances as residuals: ``(length in the map - distance) / stddev``."""

from __future__ import annotations

import numpy as np

from rangesfm.arrays import Array, Indices
from rangesfm.distances.ends import LocatedDistances
from rangesfm.ranging.range_gradient import RangeGradient


def distance_residuals(distances: LocatedDistances, scale: float, anchors_m: Array) -> Array:
    """(k,) in stddevs."""
    return (distances.lengths_m(scale, anchors_m) - distances.distance_m) / distances.stddev_m


def distance_jacobian(
    distances: LocatedDistances,
    scale: float,
    anchors_m: Array,
    anchor_column: Indices,
    num_columns: int,
) -> Array:
    """(k, p) of the residuals.

    Args:
        anchor_column: (m,) where the three columns of each anchor begin; -1 where it is held.
        num_columns: p; the first column is the logarithm of the scale.
    """
    jacobian = np.zeros((len(distances), num_columns))
    between_points = distances.anchor_pair[:, 0] < 0
    jacobian[between_points, 0] = (scale * distances.model_length / distances.stddev_m)[between_points]
    rows = np.flatnonzero(~between_points)
    first, second = distances.anchor_pair[rows].T
    by = RangeGradient.of(anchors_m[first] - anchors_m[second])
    for anchor, slopes in ((first, by.by_tag), (second, by.by_anchor)):
        free = anchor_column[anchor] >= 0
        columns = anchor_column[anchor[free], None] + np.arange(3)
        jacobian[rows[free, None], columns] = slopes[free] / distances.stddev_m[rows[free], None]
    return jacobian

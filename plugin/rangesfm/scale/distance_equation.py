"""Taped distances as residuals: ``(length in the map - distance) / stddev``."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from rangesfm.distances.ends import LocatedDistances

Array = npt.NDArray[np.float64]

_TINY_DISTANCE_M = 1e-9


def distance_residuals(distances: LocatedDistances, scale: float, anchors_m: Array) -> Array:
    """(k,) in stddevs."""
    residuals: Array = (distances.lengths_m(scale, anchors_m) - distances.distance_m) / distances.stddev_m
    return residuals


def distance_jacobian(
    distances: LocatedDistances,
    scale: float,
    anchors_m: Array,
    anchor_column: npt.NDArray[np.int64],
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
    for row in np.flatnonzero(~between_points):
        first, second = distances.anchor_pair[row]
        along = anchors_m[first] - anchors_m[second]
        along = along / (max(float(np.linalg.norm(along)), _TINY_DISTANCE_M) * distances.stddev_m[row])
        for anchor, direction in ((first, along), (second, -along)):
            column = anchor_column[anchor]
            if column >= 0:
                jacobian[row, column : column + 3] = direction
    return jacobian

"""Correlation of the ranges from one place: walls and antennas make them err alike."""

from __future__ import annotations

import numpy as np

from rangesfm.arrays import Array, Indices
from rangesfm.geometry.robust_statistics import RobustLoss
from rangesfm.geometry.similarity import rounding_of
from rangesfm.ranging.errors.noise import MIN_NUM_OF_SCATTER, NO_ERROR

# Edge of a place, metres: some wavelengths, the scale at which echoes that overlap the direct path change. On real logs
# any value from 0.1 to 0.5 m gives scales within 0.7 % of each other.
_PLACE_SIZE_M = 0.2


def place_labels(tags_m: Array, anchor_index: Indices) -> Indices:
    """Return (n,) labels, equal for ranges to one anchor from one cell of a grid.

    Args:
        tags_m: (n, 3) antenna positions in the metric world. anchor_index: (n,).
    """
    labels, in_cells = anchor_index, tags_m / _PLACE_SIZE_M
    # A path at a height of 1.6 m, or at the first camera's 0, lies on grid planes: rounding would choose the cell.
    for axis in np.floor(in_cells + rounding_of(in_cells)).astype(np.int64).T:
        # The axes are combined one after the other, since a single number for all would overflow at large sites.
        cells, row = np.unique(axis, return_inverse=True)
        labels = np.unique(labels * len(cells) + row, return_inverse=True)[1]
    return np.asarray(labels, dtype=np.int64)


def shares_by_residuals(labels: Indices, scaled_residuals: Array, loss: RobustLoss) -> Array:
    """Return the (n,) weight of each range besides its noise, from the correlation of ranges within a place.

    Args:
        labels: (n,) of places, counted from 0. scaled_residuals: (n,) in standard deviations.
        loss: that of the fit, which reduces outliers.
    """
    toned_down = scaled_residuals * loss.weights(scaled_residuals)
    return shares_of_places(labels, correlation_in_place(toned_down, labels))


def correlation_in_place(errors: Array, labels: Indices) -> float:
    """Return the share, 0 to 1, of the errors' variance about zero that errors of one place have in common.

    This is the intraclass correlation by analysis of variance (Donner, "A review of inference procedures for the
    intraclass correlation coefficient in the one-way random effects model", 1986), with the mean known to be zero.

    Args:
        errors: (n,) without outliers or with outliers reduced. labels: (n,) of places, counted from 0.
    """
    counts = np.bincount(labels)
    num_places = len(counts)
    within_degrees = len(errors) - num_places
    if len(errors) < MIN_NUM_OF_SCATTER or within_degrees < MIN_NUM_OF_SCATTER:
        return 0.0
    means = np.bincount(labels, errors) / counts
    within = float(np.sum((errors - means[labels]) ** 2)) / within_degrees
    between = float(np.sum(counts * means**2)) / num_places
    typical_count = len(errors) / num_places
    total = between + (typical_count - 1) * within
    return float(np.clip((between - within) / total, 0.0, 1.0)) if total > NO_ERROR**2 else 0.0


def shares_of_places(labels: Indices, correlation: float) -> Array:
    """Return the (n,) weight of each range so that a place counts as much as the mean of its ranges.

    The mean of c ranges with this correlation is worth c / (1 + correlation (c - 1)) independent ones. The weights are
    normalised so that a weighted estimate's formal covariance is also right for independent errors.
    """
    counts = np.bincount(labels)[labels]
    worth = 1 / (1 + correlation * (counts - 1))
    return np.asarray(worth * (worth.sum() / np.sum(worth**2)), dtype=np.float64)

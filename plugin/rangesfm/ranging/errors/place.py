"""How much the ranges of one place tell beyond the first: walls and antennas make them err there alike."""

from __future__ import annotations

import numpy as np

from rangesfm.arrays import Array, Indices
from rangesfm.ranging.errors.noise import NO_ERROR
from rangesfm.ranging.errors.robust_loss import RobustLoss

# Some wavelengths: the echoes that meet the direct path change at that scale. On real logs, anything from 0.1 to 0.5 m
# gives scales within 0.7 % of each other.
_PLACE_SIZE_M = 0.2
# In cells: paths at a height of 1.6 m, or of the first camera's 0, do not lie on the grid, where rounding would
# choose the cell.
_OFF_GRID = 1e-9
# Of fewer ranges a correlation is a guess.
_MIN_NUM = 20


def place_labels(tags_m: Array, anchor_index: Indices) -> Indices:
    """(n,) the same number for ranges to one anchor from one cell of a grid.

    Args:
        tags_m: (n, 3) antenna in the metric world. anchor_index: (n,).
    """
    labels = anchor_index
    for axis in np.floor(tags_m / _PLACE_SIZE_M + _OFF_GRID).astype(np.int64).T:
        # One axis after the other, as one number of all of them would not hold a site of great extent.
        cells, row = np.unique(axis, return_inverse=True)
        labels = np.unique(labels * len(cells) + row, return_inverse=True)[1]
    return np.asarray(labels, dtype=np.int64)


def shares_by_residuals(labels: Indices, scaled_residuals: Array, loss: RobustLoss) -> Array:
    """(n,) weight of each range beside its noise, by how much those of one place err alike.

    Args:
        labels: (n,) of places, counted from 0. scaled_residuals: (n,) in stddevs.
        loss: that of the fit, which tones outliers down.
    """
    toned_down = scaled_residuals * loss.weights(scaled_residuals)
    return shares_of_places(labels, correlation_in_place(toned_down, labels))


def correlation_in_place(errors: Array, labels: Indices) -> float:
    """Share of the variance of errors about zero that those of one place have in common, from 0 to 1.

    The intraclass correlation by analysis of variance (Donner, "A review of inference procedures for the intraclass
    correlation coefficient in the one-way random effects model", 1986), its mean known to be zero.

    Args:
        errors: (n,) without outliers or with these toned down. labels: (n,) of places, counted from 0.
    """
    counts = np.bincount(labels)
    num_places = len(counts)
    within_degrees = len(errors) - num_places
    if len(errors) < _MIN_NUM or within_degrees < _MIN_NUM:
        return 0.0
    means = np.bincount(labels, errors) / counts
    within = float(np.sum((errors - means[labels]) ** 2)) / within_degrees
    between = float(np.sum(counts * means**2)) / num_places
    typical_count = len(errors) / num_places
    total = between + (typical_count - 1) * within
    return float(np.clip((between - within) / total, 0.0, 1.0)) if total > NO_ERROR**2 else 0.0


def shares_of_places(labels: Indices, correlation: float) -> Array:
    """(n,) weight of each range so that a place counts by what its mean is worth.

    Of c ranges with this correlation the mean is worth c / (1 + correlation (c - 1)) single ones. The weights are
    such that a weighted estimate's formal covariance is right for independent errors as well.
    """
    counts = np.bincount(labels)[labels]
    worth = 1 / (1 + correlation * (counts - 1))
    return np.asarray(worth * (worth.sum() / np.sum(worth**2)), dtype=np.float64)

"""How the ranges' residuals err in the full problem: as the scale stage has learnt it."""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_matrix

from rangesfm.arrays import Array, Indices
from rangesfm.ceres.covariance import ResidualErrors
from rangesfm.ranging.errors.learned import LearnedErrors
from rangesfm.ranging.errors.range_errors import RangeErrors


def residual_errors(errors: RangeErrors, learned: LearnedErrors, rows: Indices, residuals_m: Array) -> ResidualErrors:
    """Of k ranges that took part; the scale's uncertainty counts the same errors.

    Args:
        errors, residuals_m: (k,) of these ranges. learned: likewise, what they get wrong together.
        rows: (k,) their residuals in the problem.
    """
    in_residuals = np.sqrt(errors.weight) * errors.loss.slopes(residuals_m / errors.stddev_m) / errors.stddev_m
    num, has_cell = len(rows), np.flatnonzero(learned.of_range >= 0)
    places = (has_cell, learned.of_range[has_cell])
    covariance_m2 = learned.covariance_m2
    of_cells = csr_matrix((in_residuals[has_cell], places), shape=(num, len(covariance_m2)))
    return ResidualErrors(rows, of_cells, covariance_m2)

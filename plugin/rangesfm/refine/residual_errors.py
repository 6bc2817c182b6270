"""How the ranges' residuals err: together in time, with distance and with direction, and not quite as weighted."""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_matrix, hstack

from rangesfm.arrays import Array, Indices
from rangesfm.ceres.covariance import ResidualErrors
from rangesfm.ranging.errors.noise import inflation_before_fit
from rangesfm.ranging.errors.range_errors import RangeErrors
from rangesfm.ranging.errors.robust_loss import RobustLoss
from rangesfm.ranging.errors.shared_errors import antenna_modes, curve_modes
from rangesfm.ranging.range_gradient import RangeGradient

# Of the loss, where most ranges are outliers and the mean says nothing.
_MIN_CURVATURE = 0.3
# For expectations under a normal distribution.
_NORMAL_POINTS, _NORMAL_SHARES = np.polynomial.hermite_e.hermegauss(80)


def residual_errors(
    errors: RangeErrors,
    rows: Indices,
    residuals_m: Array,
    from_anchor_m: Array,
    curve_stddev_m: Array,
    num_absorbed: float,
) -> ResidualErrors:
    """Of k ranges that took part; the scale's uncertainty counts the same errors.

    Args:
        errors, residuals_m: (k,) of these ranges. rows: (k,) their residuals in the problem.
        from_anchor_m: (k, 3) from the anchor to the tag.
        curve_stddev_m: (k,) how wrong the radio's error curve may be.
        num_absorbed: degrees of freedom that the map takes from the ranges.
    """
    by = RangeGradient.of(from_anchor_m)
    in_residuals = np.sqrt(errors.weight) * errors.loss.slopes(residuals_m / errors.stddev_m) / errors.stddev_m
    of_radio = csr_matrix(in_residuals[:, None] * curve_modes(by.distance_m, curve_stddev_m))
    of_antennas = _each_anchor_apart(in_residuals[:, None] * antenna_modes(by.by_tag), errors.anchor_index)
    return ResidualErrors(
        rows, _variance(errors, residuals_m, num_absorbed), csr_matrix(hstack([of_radio, of_antennas]))
    )


def _each_anchor_apart(modes: Array, anchor_index: Indices) -> csr_matrix:
    """Columns of its own for each anchor."""
    num, width = modes.shape
    columns = width * anchor_index[:, None] + np.arange(width)
    starts = width * np.arange(num + 1)
    return csr_matrix((modes.ravel(), columns.ravel(), starts), shape=(num, width * (int(anchor_index.max()) + 1)))


def _variance(errors: RangeErrors, residuals_m: Array, num_absorbed: float) -> float:
    """Of the robust residuals in their stddevs as weighted, as far as time and the loss go."""
    num = len(residuals_m)
    if errors.is_estimated.any():
        left = max(num - num_absorbed, 0.1 * num) / num
        shares = errors.share / errors.share.sum()
        variance = _robust_variance(errors.loss, residuals_m / errors.stddev_m, shares) / left
    else:
        variance = _robust_variance(errors.loss, _NORMAL_POINTS, _NORMAL_SHARES / _NORMAL_SHARES.sum())
    before_fit = inflation_before_fit(errors.inflation, len(np.unique(errors.group)), num_absorbed)
    return variance * (before_fit / errors.inflation) ** 2


def _robust_variance(loss: RobustLoss, scaled: Array, shares: Array) -> float:
    """The asymptotic variance of an M-estimate over what the squared slopes of its residuals make of it.

    Huber, "Robust Statistics" (1981), section 6.2: mean of the squared influence over the square of its mean slope.
    """
    influence = shares @ (scaled * loss.weights(scaled)) ** 2
    curvature = max(float(shares @ loss.curvatures(scaled)), _MIN_CURVATURE)
    return float(influence * (shares @ loss.slopes(scaled) ** 2) / curvature**2)

"""Estimation of a radio's error curve from ranges of known length."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag

from rangesfm.arrays import Array, Indices
from rangesfm.errors import GeometryError, InputError
from rangesfm.processes.threads import with_one_blas_thread
from rangesfm.ranging.anchors.anchor import Anchor
from rangesfm.ranging.errors.error_curve import ErrorCurve
from rangesfm.ranging.errors.noise import correlation_inflation, robust_stddev
from rangesfm.ranging.errors.range_errors import fit_with_own_errors
from rangesfm.ranging.errors.robust_loss import CAUCHY
from rangesfm.ranging.range_log import RangeLog

# Knots this far apart, in the logarithm of the distance, follow every curve that antennas and received power produce.
_LOG_SPACING = 1 / 6
# Standard deviations of the change of the slope over one e-fold of distance, and of an anchor's own delay.
_BEND_STDDEV_M = 0.15
_BIAS_STDDEV_M = 0.05
# Prior standard deviation of the curve's level and slope: almost no assumption.
_LEVEL_STDDEV_M = 10.0
# A tag nearer than this is at the anchor, where the logarithm of the distance has no meaning.
_AT_ANCHOR_M = 1e-3
_MIN_RANGES = 100
_MIN_RANGES_OF_KNOT = 20
_EDGE_SHARE = 0.001
_BLOCK_S = 10.0
_NUM_ROUNDS = 20
_MIN_ANCHORS_TO_LEAVE_OUT = 3


@dataclass(frozen=True)
class RadioCalibration:
    """Result of the calibration of a radio.

    Attributes:
        curve: error of the radio by distance.
        num_ranges: number of ranges used for the curve.
        noise_stddev_m: scatter of a range about the curve and its anchor's bias.
        outlier_share: share of ranges that do not fit, such as those without line of sight.
        anchor_bias_m: bias of each anchor beyond the curve.
        distance_m, error_m: (n,) of each range: true distance, and measured minus true.
    """

    curve: ErrorCurve
    num_ranges: int
    noise_stddev_m: float
    outlier_share: float
    anchor_bias_m: dict[str, float]
    distance_m: Array
    error_m: Array


@dataclass(frozen=True)
class _Problem:
    """Linear least squares problem for knot values and anchor biases.

    Attributes:
        design: (n, k + m) derivatives of the errors.
        error_m: (n,) measured minus true distance.
        prior: (p, k + m) derivatives of the priors' residuals, which have standard deviation 1.
        groups: (n,) labels of stretches of one anchor's ranges with correlated errors.
    """

    design: Array
    error_m: Array
    prior: Array
    groups: Indices


@with_one_blas_thread
def calibrate_ranges(log: RangeLog, tags_m: Array, anchors: Sequence[Anchor]) -> RadioCalibration:
    """Learn the mean error of a radio as a smooth function of distance.

    The curve is piecewise linear in the logarithm of distance with a penalty on its bends, and common to all anchors.
    Each anchor has a bias in addition. A Cauchy loss reduces the effect of ranges without line of sight. The standard
    deviation is the larger of two: from the curve's covariance, widened for the errors' correlation in time; and from
    leaving out each anchor in turn.

    Args:
        log: n ranges.
        tags_m: (n, 3) positions of the tag's antenna, in the anchors' frame; NaN where unknown.
        anchors: all with positions.

    Raises:
        InputError: an anchor of the log has no position.
        GeometryError: there are too few ranges of known length, or all are of one length.
    """
    distance, error = _errors(log, tags_m, anchors)
    used = np.flatnonzero(np.isfinite(error) & (distance > _AT_ANCHOR_M))
    if len(used) < _MIN_RANGES:
        raise GeometryError(f"{len(used)} ranges of known length, expected {_MIN_RANGES} or more to learn from")
    distance, error, index = distance[used], error[used], log.anchor_index[used]
    knots = _knots(distance)
    problem = _problem(log, used, distance, error, index, knots)
    fitted, scatter = _fit(problem)
    covariance = np.linalg.inv(_information(problem, fitted.weights, scatter.stddev_m))[: len(knots), : len(knots)]
    stddev = np.maximum(np.sqrt(np.diag(covariance)), _spread_by_anchor(problem, index, len(knots)))
    noise = _noise_by_knot(problem, fitted.residuals_m, len(knots), scatter.noise_m)
    curve = ErrorCurve(knots, fitted.values[: len(knots)], stddev, noise)
    biases = dict(zip(log.anchor_ids, fitted.values[len(knots) :].tolist(), strict=True))
    outliers = float(np.mean(fitted.weights < 0.1))
    return RadioCalibration(curve, len(used), scatter.noise_m, outliers, biases, distance, error)


def _errors(log: RangeLog, tags_m: Array, anchors: Sequence[Anchor]) -> tuple[Array, Array]:
    """Return (n,) true distances, and measured minus true distances; NaN where unknown."""
    by_id = {anchor.anchor_id: anchor.position_m for anchor in anchors}
    positions = []
    for anchor_id in log.anchor_ids:
        position = by_id.get(anchor_id)
        if position is None:
            raise InputError(f"anchor {anchor_id} of the log has no position, expected all to be surveyed", log.source)
        positions.append(position)
    distance: Array = np.linalg.norm(tags_m - np.array(positions)[log.anchor_index], axis=1)
    return distance, log.range_m - distance


def _knots(distance: Array) -> Array:
    """Return (k,) distances with even spacing of their logarithms, over all but the few shortest and longest ranges."""
    ends = np.quantile(distance, [_EDGE_SHARE, 1 - _EDGE_SHARE])
    low, high = np.log(ends)
    if not high - low > 2 * _LOG_SPACING:
        raise GeometryError(
            f"the ranges are {ends[0]:.2f} to {ends[1]:.2f} m long: a curve needs ranges of different lengths"
        )
    return np.exp(np.linspace(low, high, int(np.ceil((high - low) / _LOG_SPACING)) + 1))


def _problem(log: RangeLog, used: Indices, distance: Array, error: Array, index: Indices, knots: Array) -> _Problem:
    num_anchors = len(log.anchor_ids)
    # The curve is linear in the distance between knots, as it is when it is applied.
    hats = np.column_stack([np.interp(distance, knots, unit) for unit in np.eye(len(knots))])
    is_anchor = np.eye(num_anchors)[index]
    if log.timestamp_s is None:
        block = np.unique(np.array(log.image_name)[used], return_inverse=True)[1]
    else:
        block = np.floor((log.timestamp_s[used] - log.timestamp_s[used].min()) / _BLOCK_S).astype(np.int64)
    return _Problem(np.hstack([hats, is_anchor]), error, _prior(knots, num_anchors), block * num_anchors + index)


def _prior(knots: Array, num_anchors: int) -> Array:
    """Return rows of the prior with standard deviation 1: for the curve's bends, its ends and the biases.

    The bends are those of a slope that changes as a random walk.
    """
    step = np.log(knots[1] / knots[0])
    bends = np.diff(np.eye(len(knots)), 2, axis=0) / (_BEND_STDDEV_M * step**1.5)
    ends = np.eye(len(knots))[[0, -1]] / _LEVEL_STDDEV_M
    return np.asarray(block_diag(np.vstack([bends, ends]), np.eye(num_anchors) / _BIAS_STDDEV_M))


def _information(problem: _Problem, weights: Array, stddev: float) -> Array:
    data: Array = (problem.design * weights[:, None]).T @ problem.design / stddev**2
    return data + problem.prior.T @ problem.prior


@dataclass(frozen=True)
class _Scatter:
    """Scatter of ranges about a curve: its standard deviation, and the widening by correlation."""

    noise_m: float
    inflation: float

    @property
    def stddev_m(self) -> float:
        """Standard deviation for the weights: correlated errors count as fewer ranges, and so do not bend the curve."""
        return self.noise_m * self.inflation


@dataclass(frozen=True)
class _Fit:
    """Values of all unknowns (k + m,), the robust weights (n,) of the fit, and its residuals (n,)."""

    values: Array
    weights: Array
    residuals_m: Array


def _fit(problem: _Problem) -> tuple[_Fit, _Scatter]:
    """Return the fit with its robust weights, and the scatter of its residuals."""

    def fit(scatter: _Scatter, before: _Fit | None) -> _Fit:
        start_m = problem.error_m - np.median(problem.error_m) if before is None else before.residuals_m
        weights = CAUCHY.weights(start_m / scatter.noise_m)
        right = problem.design.T @ (weights * problem.error_m) / scatter.stddev_m**2
        information = _information(problem, weights, scatter.stddev_m)
        values = np.asarray(np.linalg.solve(information, right), np.float64)
        return _Fit(values, weights, problem.error_m - problem.design @ values)

    def estimate(_: _Scatter, fitted: _Fit) -> _Scatter:
        noise = robust_stddev(fitted.residuals_m)
        return _Scatter(noise, correlation_inflation(fitted.residuals_m / noise, fitted.weights, problem.groups))

    start = _Scatter(robust_stddev(problem.error_m - np.median(problem.error_m)), 1.0)
    fitted, _, seen = fit_with_own_errors(fit, estimate, start, max_num_rounds=_NUM_ROUNDS)
    return fitted, seen


def _spread_by_anchor(problem: _Problem, index: Indices, num_knots: int) -> Array:
    """Return the (k,) jackknife standard deviation of the curve over anchors; 0 with too few of them."""
    present = np.unique(index)
    if len(present) < _MIN_ANCHORS_TO_LEAVE_OUT:
        return np.zeros(num_knots)
    curves = []
    for k in present:
        rest = index != k
        part = _Problem(problem.design[rest], problem.error_m[rest], problem.prior, problem.groups[rest])
        curves.append(_fit(part)[0].values[:num_knots])
    num = len(present)
    return np.asarray(np.sqrt((num - 1) / num * np.sum((np.array(curves) - np.mean(curves, axis=0)) ** 2, axis=0)))


def _noise_by_knot(problem: _Problem, residuals: Array, num_knots: int, noise: float) -> Array:
    """Return the (k,) scatter of the ranges nearest to each knot; the scatter of all where they are few."""
    nearest = np.argmax(problem.design[:, :num_knots], axis=1)
    parts = [residuals[nearest == k] for k in range(num_knots)]
    return np.array([robust_stddev(part) if len(part) >= _MIN_RANGES_OF_KNOT else noise for part in parts])

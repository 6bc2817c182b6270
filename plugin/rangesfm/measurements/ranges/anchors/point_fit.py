"""Robust least squares for the position of a point and a range bias, without a first guess, with their uncertainty.

    predicted = || p - a || + b

p: known position of the tag; a: unknown position of the point, an anchor's antenna; b: range bias.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import block_diag
from scipy.optimize import least_squares

from rangesfm.arrays import Array, Indices
from rangesfm.measurements.ranges.errors.learned import learn_errors, radio_components
from rangesfm.measurements.ranges.errors.noise import MIN_ORDINARY, START_STDDEV_M, inlier_noise
from rangesfm.measurements.ranges.errors.range_bins import noisiness, range_bins
from rangesfm.measurements.ranges.range_gradient import RangeGradient
from rangesfm.util.geometry.numerics import MAX_NUM_ROUNDS, ROUNDING
from rangesfm.util.geometry.robust_statistics import CAUCHY, SAME_COST, RobustLoss, robust_stddevs
from rangesfm.util.geometry.similarity import path_shape

# Rounds of reweighting in the linear solution.
_NUM_ROUNDS = 12
# Added to the diagonal of normal equations, whose columns have length 1 before weighting. It keeps them regular where
# outliers have lost all their weight.
_RIDGE = 1e-16
ENOUGH_TO_SEARCH = 300
"""Ranges, spread over all of them, with which the place of a point is searched as well as with more."""
ENOUGH_TO_JUDGE = 2000
"""Ranges of a point, spread over all of them, that tell places apart and show errors as well as more would."""
# The search for a start uses this many directions of starting points around the tag, and losses of these widths (in
# units of the noise).
_NUM_DIRECTIONS = 20
_WIDTHS = np.geomspace(30.0, 0.3, 5)
# Number of ranges that the usual noise counts as.
_USUAL_NOISE_COUNTS = 2.0
# Error components that are not learnt here, because each anchor's bias is estimated with a prior of its own.
_NOT_HERE = ("bias", "common_bias")


def multilaterate(positions: Array, ranges: Array) -> tuple[Array, Array]:
    """Locate a point by its distances to known positions, by a robust linear method that needs no start.

    rho^2 = |p|^2 - 2 a.p + |a|^2 is linear in (a, |a|^2). Where the positions lie in a plane, the height above it
    follows from |a|^2, with an arbitrary sign.

    Args:
        positions: (..., n, 3) known positions, metres, for one point or for many at once.
        ranges: (n,) or (..., n) distances, metres.

    Returns:
        The point (..., 3), and the residuals (..., n) of the linear model, metres.
    """
    shape = path_shape(positions)
    local = (positions - shape.centroid[..., None, :]) @ shape.axes
    # In directions of smaller extent than this, ranges with noise of about a decimetre carry no information.
    seen = shape.stddevs > np.maximum(0.02 * shape.stddevs[..., :1], 1e-9)
    squared = ranges**2 - np.sum(local**2, axis=-1)
    design = np.concatenate([-2 * local * seen[..., None, :], np.ones_like(local[..., :1])], axis=-1)
    sizes = np.linalg.norm(design, axis=-2, keepdims=True)
    sizes = np.where(sizes > 0, sizes, 1.0)
    design, nothing = design / sizes, np.concatenate([~seen, np.zeros_like(seen[..., :1])], axis=-1)
    rest = (nothing + _RIDGE)[..., None] * np.eye(4)
    weights = 1 / np.maximum(2 * ranges, 1e-3)
    robust = np.ones_like(squared)
    for _ in range(_NUM_ROUNDS):
        weighted = (design * (weights**2 * robust)[..., None]).swapaxes(-1, -2)
        solution = np.linalg.solve(weighted @ design + rest, weighted @ squared[..., None])
        residuals = weights * ((design @ solution)[..., 0] - squared)
        robust = 1 / (1 + (residuals / (2 * robust_stddevs(residuals))) ** 2)
    point, height = np.split(solution[..., 0] / sizes[..., 0, :], [3], axis=-1)
    above = np.sqrt(np.maximum(height - np.sum(point**2, axis=-1, keepdims=True), 0.0))
    point = np.where(~seen & (np.arange(3) == 2), above, point)
    anchor: Array = shape.centroid + (shape.axes @ point[..., None])[..., 0]
    return anchor, residuals


@dataclass(frozen=True)
class PointProblem:
    """n ranges to one point with the unknowns x = (a, b), four numbers.

    The point must be near the origin, because large coordinates lose digits.

    Attributes:
        positions_m: (n, 3) positions of the tag.
        range_m: (n,) measured ranges.
        stddev_m: (n,) their standard deviations.
        shared_stddev_m: (n,) part of the standard deviation that ranges of about the same length share.
        prior_mean: (4,) prior mean of x.
        prior: (k, 4) square root of the prior information: ``prior @ (x - prior_mean)`` is standard normal.
    """

    positions_m: Array
    range_m: Array
    stddev_m: Array
    shared_stddev_m: Array
    prior_mean: Array
    prior: Array

    def subset(self, rows: Indices) -> PointProblem:
        """Return the problem with some of its ranges."""
        names = ("positions_m", "range_m", "stddev_m", "shared_stddev_m")
        return replace(self, **{name: getattr(self, name)[rows] for name in names})

    def residuals_m(self, x: Array) -> Array:
        """Return predicted minus measured ranges (n,), metres."""
        residuals: Array = self._gradient(x).distance_m + x[3] - self.range_m
        return residuals

    def slopes(self, x: Array) -> Array:
        """Return the derivatives (n, 4) of the residuals in metres."""
        by_anchor = self._gradient(x).by_anchor
        return np.column_stack([by_anchor, np.ones(len(by_anchor))])

    def jacobian(self, x: Array) -> Array:
        """Return the derivatives (n, 4) of the residuals in standard deviations."""
        jacobian: Array = self.slopes(x) / self.stddev_m[:, None]
        return jacobian

    def _gradient(self, x: Array) -> RangeGradient:
        return RangeGradient.of(self.positions_m - x[:3])

    def cost(self, x: Array, loss: RobustLoss = CAUCHY) -> float:
        """Return half the robust sum of squares, including the prior."""
        rho = loss.rho((self.residuals_m(x) / self.stddev_m) ** 2)[0]
        return float(np.sum(rho) + np.sum((self.prior @ (x - self.prior_mean)) ** 2)) / 2


@dataclass(frozen=True)
class PointFit:
    """Estimate of a point, with the noise that was estimated with it.

    Attributes:
        problem: the problem with the final standard deviations.
        x: (4,) position and bias.
        own_stddev_m: (n,) noise of each range, without the part that ranges share.
    """

    problem: PointProblem
    x: Array
    own_stddev_m: Array

    @property
    def noise_m(self) -> float:
        """Median noise of a range, metres."""
        return float(np.median(self.own_stddev_m))

    @property
    def residuals_m(self) -> Array:
        return self.problem.residuals_m(self.x)

    @property
    def off_m(self) -> Array:
        """Measured minus predicted ranges (n,), with the prior mean of the bias, metres."""
        return -self.problem.residuals_m(np.append(self.x[:3], self.problem.prior_mean[3]))

    @property
    def weights(self) -> Array:
        """Weights of the robust loss (n,)."""
        return CAUCHY.weights(self.residuals_m / self.problem.stddev_m)


def fit_with_own_noise(problem: PointProblem, given_m: Array) -> PointFit:
    """Fit a point and estimate the noise from its residuals, until both agree; given noise is a lower bound.

    Args:
        problem: the problem; of its standard deviations only the shared ones are used.
        given_m: (n,) noise of each range, NaN where it is unknown.
    """
    is_given = np.isfinite(given_m)
    unit = np.where(is_given, given_m, np.median(given_m[is_given]) if is_given.any() else START_STDDEV_M)
    x, noise = _best_start(problem, unit)
    least = 1.0 if is_given.all() else 0.0
    noise = max(noise, least)
    for _ in range(MAX_NUM_ROUNDS):
        now = replace(problem, stddev_m=np.hypot(noise * unit, problem.shared_stddev_m))
        fit = PointFit(now, improve(now, x), noise * unit)
        x = fit.x
        ordinary = problem.shared_stddev_m < noise * unit
        rows = ordinary if np.mean(ordinary) > MIN_ORDINARY else np.ones(len(unit), dtype=np.bool_)
        before, noise = noise, max(_noise_of(fit.residuals_m[rows] / unit[rows], len(x)), least)
        if abs(noise - before) <= SAME_COST * before:
            break
    return fit


def _noise_of(scaled: Array, num_unknowns: int) -> float:
    """Return the standard deviation of scaled residuals, with a prior that counts where there are few.

    The degrees of freedom are reduced by the unknowns of the fit.
    """
    freedom = max(len(scaled) - num_unknowns, 0)
    found = inlier_noise(scaled).stddev ** 2 * len(scaled)
    return float(np.sqrt((found + _USUAL_NOISE_COUNTS) / (freedom + _USUAL_NOISE_COUNTS)))


def improve(problem: PointProblem, x: Array, tolerance: float = ROUNDING) -> Array:
    """Return the minimum (4,) of the cost near ``x``, with a Cauchy loss on the ranges and none on the prior."""
    num = len(problem.range_m)

    def loss(squared: Array) -> Array:
        prior = squared[num:]
        return np.hstack([CAUCHY.rho(squared[:num]), [prior, np.ones(len(prior)), np.zeros(len(prior))]])

    found = least_squares(
        lambda x: np.append(problem.residuals_m(x) / problem.stddev_m, problem.prior @ (x - problem.prior_mean)),
        x,
        lambda x: np.vstack([problem.jacobian(x), problem.prior]),
        loss=loss,
        **dict.fromkeys(("ftol", "xtol", "gtol"), tolerance),
    )
    return np.asarray(found.x)


def _best_start(problem: PointProblem, unit_m: Array) -> tuple[Array, float]:
    """Return the most likely unknowns (4,) in spite of outliers, and the noise there as a multiple of ``unit_m``.

    Starting points all around the tag, and the linear solution, follow the minima of a Cauchy loss while it narrows
    from metres to centimetres. Of all minima on the way, the most likely one is chosen.

    Args:
        unit_m: (n,) noise of the ranges relative to each other.
    """
    rows = np.linspace(0, len(unit_m) - 1, min(len(unit_m), ENOUGH_TO_SEARCH)).astype(np.int64)
    part, unit_m = problem.subset(rows), unit_m[rows]
    now, passed = _starts(part), []
    for width in _WIDTHS:
        narrowed = replace(part, stddev_m=np.hypot(width * unit_m, part.shared_stddev_m))
        now = _distinct([improve(narrowed, x, SAME_COST) for x in now], float(unit_m.min()))
        passed += now
    noises = [inlier_noise(part.residuals_m(x) / np.hypot(unit_m, part.shared_stddev_m)) for x in passed]
    best = int(np.argmax([noise.log_likelihood for noise in noises]))
    return passed[best], noises[best].stddev


def _distinct(points: list[Array], noise_m: float) -> list[Array]:
    """Return the first of each group of points that ranges with this noise do not tell apart."""
    kept: list[Array] = []
    for x in points:
        if all(np.linalg.norm(x - other) > noise_m for other in kept):
            kept.append(x)
    return kept


def _starts(problem: PointProblem) -> list[Array]:
    """Return starting points around the mean of the tag's positions, and the linear solution with its mirror image."""
    bias = problem.prior_mean[3]
    ranges = problem.range_m - bias
    shape = path_shape(problem.positions_m)
    linear, _ = multilaterate(problem.positions_m, ranges)
    normal = shape.axes[:, 2]
    mirrored = linear - 2 * ((linear - shape.centroid) @ normal) * normal
    around = shape.centroid + np.median(ranges) * _directions()
    return [np.append(point, bias) for point in (*around, linear, mirrored)]


def _directions() -> Array:
    """Return unit vectors (m, 3), evenly spread along a spiral from pole to pole."""
    step = np.arange(_NUM_DIRECTIONS) + 0.5
    height, turn = 1 - 2 * step / _NUM_DIRECTIONS, np.pi * (1 + 5**0.5) * step
    flat = np.sqrt(1 - height**2)
    return np.stack([flat * np.cos(turn), flat * np.sin(turn), height], axis=1)


@dataclass(frozen=True)
class JudgedFit:
    """A fit with the covariance of the errors of its n ranges.

    Attributes:
        fit: the fit.
        of_bin: (n,) index of each range's bin.
        covariance_m2: (c, c) covariance of the errors of all bins.
        inflation_of_prior: factor by which the prior in the fit was strengthened.
    """

    fit: PointFit
    of_bin: Indices
    covariance_m2: Array
    inflation_of_prior: float = 1.0

    def of_sums(self, influence: Array) -> Array:
        """Return the covariance (k, k) of k weighted sums of the ranges' errors, with weights (k, n)."""
        of_bins = np.stack([np.bincount(self.of_bin, row, len(self.covariance_m2)) for row in influence])
        covariance: Array = of_bins @ self.covariance_m2 @ of_bins.T
        return covariance

    def inflation(self, change_m: Array) -> float:
        """Return the ratio of a parameter's standard deviation to the one for independent errors of the ranges.

        Args:
            change_m: (n,) change of the ranges per unit of the parameter, metres.
        """
        weight = self.fit.weights * change_m / self.fit.problem.stddev_m**2
        formal = float(weight @ change_m)
        return float(np.sqrt(max(self.of_sums(weight[None])[0, 0] / formal, 1.0))) if formal > 0 else 1.0

    def balanced(self) -> JudgedFit:
        """Return the fit with a prior as strong beside ranges whose common errors are not in their weights.

        It is strengthened by the inflation of the bias, with the position estimated along with it.
        """
        fit, problem = self.fit, self.fit.problem
        root, slopes = np.sqrt(fit.weights) / problem.stddev_m, problem.slopes(fit.x)
        adapted = np.linalg.lstsq(root[:, None] * slopes[:, :3], root, rcond=None)[0]
        inflation = self.inflation(1.0 - slopes[:, :3] @ adapted)
        problem = replace(problem, prior=problem.prior * inflation)
        return replace(self, fit=replace(fit, problem=problem, x=improve(problem, fit.x)), inflation_of_prior=inflation)

    def judged_by(self, inflation: float) -> PointProblem:
        """Return the problem with standard deviations that account for common errors, for comparing costs."""
        problem = self.fit.problem
        prior = problem.prior / self.inflation_of_prior
        return replace(problem, stddev_m=inflation * problem.stddev_m, prior=prior)


def judged_fits(
    fits: Sequence[PointFit], times_s: Sequence[Array], tags: Sequence[Indices], *, is_calibrated: bool
) -> list[JudgedFit]:
    """Learn the errors of the ranges from the residuals of all fits together.

    Args:
        fits: the fits.
        times_s, tags: (n_k,) times and indices of tags of the ranges of each fit.
        is_calibrated: whether an error curve has been subtracted, whose uncertainty the ranges share.
    """
    lengths = [len(fit.residuals_m) for fit in fits]
    anchor_index = np.repeat(np.arange(len(fits)), lengths)
    slopes = [fit.problem.slopes(fit.x) for fit in fits]
    curve_stddev_m = np.concatenate([fit.problem.shared_stddev_m for fit in fits])
    precision = np.concatenate([fit.own_stddev_m**-2 for fit in fits])
    bins = range_bins(
        anchor_index,
        np.concatenate(tags),
        np.concatenate(times_s),
        np.concatenate([fit.problem.positions_m - fit.x[:3] for fit in fits]),
        np.tile(np.eye(3), (len(anchor_index), 1, 1)),
        np.concatenate([fit.weights for fit in fits]) * precision / precision.mean(),
        noisiness(anchor_index, np.concatenate([fit.residuals_m for fit in fits]), len(fits)),
    )
    learned = learn_errors(
        radio_components(bins, curve_stddev_m if is_calibrated else None, _NOT_HERE),
        bins,
        off_m=bins.mean(np.concatenate([fit.off_m for fit in fits])),
        design=bins.mean(block_diag(*slopes)),
        prior_design=block_diag(*(fit.problem.prior for fit in fits)),
        noise_m=float(precision.mean() ** -0.5),
    )
    covariance = learned.covariance_m2
    return [JudgedFit(fit, learned.of_range[anchor_index == k], covariance) for k, fit in enumerate(fits)]

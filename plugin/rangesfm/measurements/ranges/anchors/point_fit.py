"""Robust fit of an anchor to ranges at known positions of the tag, without a first guess, and the ranges' errors.

It is the problem of ``scale/range_equation.py`` for one anchor and a path that is given.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import block_diag

from rangesfm.arrays import Array, Indices
from rangesfm.measurements.ranges.errors.learned import learn_errors, radio_components
from rangesfm.measurements.ranges.errors.noise import MIN_ORDINARY, START_STDDEV_M, inlier_noise, shared_stddev
from rangesfm.measurements.ranges.errors.range_bins import noisiness, range_bins
from rangesfm.measurements.ranges.scale.range_equation import (
    RangeFit,
    RangeProblem,
    RangeState,
    columns_of,
    predicted_ranges,
    prior_jacobian,
    range_gradient,
    range_jacobian,
    solve,
)
from rangesfm.util.geometry.numerics import MAX_NUM_ROUNDS
from rangesfm.util.geometry.robust_statistics import SAME_COST, robust_stddevs
from rangesfm.util.geometry.similarity import IDENTITY, path_shape

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
# Standard deviation of a coordinate that is known, as a height, metres.
_KNOWN_STDDEV_M = 0.01
# Error components that are not learnt here, because each anchor's bias is estimated with a prior of its own.
_NOT_HERE = ("bias", "common_bias")


def multilaterate(positions: Array, ranges: Array, num_rounds: int = 12) -> tuple[Array, Array]:
    """Locate a point by its distances to known positions, by a robust linear method that needs no start.

    rho^2 = |p|^2 - 2 a.p + |a|^2 is linear in (a, |a|^2). Where the positions lie in a plane, the height above it
    follows from |a|^2, with an arbitrary sign.

    Args:
        positions: (..., n, 3) known positions, metres, for one point or for many at once.
        ranges: (n,) or (..., n) distances, metres.
        num_rounds: of reweighting.

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
    for _ in range(num_rounds):
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
class PointFit:
    """Estimate of an anchor by its n ranges, with the noise that was estimated with it.

    Attributes:
        problem: of the anchor alone, on a path that is given, with the final standard deviations. Coordinates in
            ``anchor_mean_m`` are known, and NaN are not. All are near the origin, because large ones lose digits.
        fit: its solution.
        own_stddev_m: (n,) noise of each range, without the part that ranges share.
    """

    problem: RangeProblem
    fit: RangeFit
    own_stddev_m: Array

    @property
    def at_m(self) -> Array:
        """Position (3,) of the anchor."""
        return np.asarray(self.fit.state.anchors_m[0])

    @property
    def bias_m(self) -> float:
        """Bias of the ranges."""
        return float(self.fit.state.bias_m[0])

    @property
    def noise_m(self) -> float:
        """Median noise of a range, metres."""
        return float(np.median(self.own_stddev_m))

    @property
    def off_m(self) -> Array:
        """Measured minus predicted ranges (n,), with the prior mean of the bias, metres."""
        return np.asarray(self.bias_m - self.problem.bias_mean_m[0] - self.fit.residuals_m)

    @property
    def slopes(self) -> Array:
        """(n, q) derivatives of the ranges by the position and, unless it is known, the bias."""
        in_metres, state = replace(self.problem, stddev_m=np.ones(len(self.own_stddev_m))), self.fit.state
        return range_jacobian(in_metres, self.fit.columns[0], state, state)[:, 1:]

    def prior(self, factor: float = 1.0) -> Array:
        """Return the (r, q) derivatives of the priors by the same, in standard deviations.

        Args:
            factor: by which the prior of the bias was strengthened, as the known coordinates are then, too.
        """
        of_bias = prior_jacobian(self.problem, self.fit.columns[0], self.fit.state, self.fit.state)
        _, *known = known_directions(self.problem)
        return np.vstack([of_bias, *(factor / _KNOWN_STDDEV_M * each for each in known)])[:, 1:]

    def near(self, place_m: Array) -> PointFit:
        """Return the best fit near another place (3,)."""
        start = replace(self.fit.state, anchors_m=place_m[None])
        return replace(self, fit=solve(self.problem, start, held=known_directions(self.problem)))


def known_directions(problem: RangeProblem) -> list[Array]:
    """Return what is held in the problem of an anchor: the scale of the path, and the coordinates that are known.

    They are directions (p,) in the parameters of the problem.
    """
    columns = columns_of([problem])[0]
    known = columns.anchor[0] + np.flatnonzero(~np.isnan(problem.anchor_mean_m))
    return [*np.eye(columns.num)[[columns.scale, *known]]]


def fit_with_own_noise(problem: RangeProblem, curve_stddev_m: Array, given_m: Array) -> PointFit:
    """Fit an anchor and estimate the noise from its residuals, until both agree; given noise is a lower bound.

    Args:
        problem: as in ``PointFit``; its standard deviations are not used.
        curve_stddev_m: (n,) of a learnt error curve that was subtracted; NaN if none was.
        given_m: (n,) noise of each range, NaN where it is unknown.
    """
    is_given = np.isfinite(given_m)
    unit = np.where(is_given, given_m, np.median(given_m[is_given]) if is_given.any() else START_STDDEV_M)
    state, noise = _best_start(problem, shared_stddev(problem.range_m, curve_stddev_m), unit)
    least = 1.0 if is_given.all() else 0.0
    noise = max(noise, least)
    for _ in range(MAX_NUM_ROUNDS):
        # By the distance from the anchor: garbage that reads short is none of the short ranges that err together.
        shared_m = shared_stddev(range_gradient(problem, state).distance_m, curve_stddev_m)
        now = replace(problem, stddev_m=np.hypot(noise * unit, shared_m))
        found = PointFit(now, solve(now, state, held=known_directions(now)), noise * unit)
        state = found.fit.state
        ordinary = shared_m < noise * unit
        rows = ordinary if np.mean(ordinary) > MIN_ORDINARY else np.ones(len(unit), dtype=np.bool_)
        num_unknowns = found.slopes.shape[1]
        before, noise = noise, max(_noise_of(found.fit.residuals_m[rows] / unit[rows], num_unknowns), least)
        if abs(noise - before) <= SAME_COST * before:
            break
    return found


def _noise_of(scaled: Array, num_unknowns: int) -> float:
    """Return the standard deviation of scaled residuals, with a prior that counts where there are few.

    The degrees of freedom are reduced by the unknowns of the fit.
    """
    freedom = max(len(scaled) - num_unknowns, 0)
    found = inlier_noise(scaled).stddev ** 2 * len(scaled)
    return float(np.sqrt((found + _USUAL_NOISE_COUNTS) / (freedom + _USUAL_NOISE_COUNTS)))


def _best_start(problem: RangeProblem, shared_m: Array, unit_m: Array) -> tuple[RangeState, float]:
    """Return the most likely state in spite of outliers, and the noise there as a multiple of ``unit_m``.

    Starting points all around the tag, and the linear solution, follow the minima of a Cauchy loss while it narrows
    from metres to centimetres. Of all minima on the way, the most likely one is chosen.

    Args:
        unit_m: (n,) noise of the ranges relative to each other.
    """
    rows = np.linspace(0, len(unit_m) - 1, min(len(unit_m), ENOUGH_TO_SEARCH)).astype(np.int64)
    part, unit_m, shared_m = problem.subset(rows), unit_m[rows], shared_m[rows]
    now, passed, held = _starts(part), list[RangeState](), known_directions(part)
    for width in _WIDTHS:
        narrowed = replace(part, stddev_m=np.hypot(width * unit_m, shared_m))
        fits = [solve(narrowed, state, held=held, tolerance=SAME_COST) for state in now]
        now = _distinct([fit.state for fit in fits], float(unit_m.min()))
        passed += now
    off_m = [predicted_ranges(part, state) - part.range_m for state in passed]
    noises = [inlier_noise(each / np.hypot(unit_m, shared_m)) for each in off_m]
    best = int(np.argmax([noise.log_likelihood for noise in noises]))
    return passed[best], noises[best].stddev


def _distinct(states: list[RangeState], noise_m: float) -> list[RangeState]:
    """Return the first of each group of states that ranges with this noise do not tell apart."""
    kept: list[RangeState] = []
    for each in states:
        off_m = [np.append(each.anchors_m - other.anchors_m, each.bias_m - other.bias_m) for other in kept]
        if all(np.linalg.norm(of) > noise_m for of in off_m):
            kept.append(each)
    return kept


def _starts(problem: RangeProblem) -> list[RangeState]:
    """Return starting points around the mean of the tag's positions, and the linear solution with its mirror image."""
    tags_m, known_m = problem.tag_from_center, problem.anchor_mean_m
    ranges = problem.range_m - problem.bias_mean_m[0]
    shape = path_shape(tags_m)
    linear, _ = multilaterate(tags_m, ranges)
    normal = shape.axes[:, 2]
    mirrored = linear - 2 * ((linear - shape.centroid) @ normal) * normal
    places_m = np.vstack([shape.centroid + np.median(ranges) * _directions(), linear, mirrored])
    places_m = np.where(np.isnan(known_m), places_m, known_m)
    return [RangeState(IDENTITY, place_m[None], problem.bias_mean_m) for place_m in places_m]


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
        point: the fit.
        of_bin: (n,) index of each range's bin.
        covariance_m2: (c, c) covariance of the errors of all bins.
        inflation_of_prior: factor by which the prior in the fit was strengthened.
    """

    point: PointFit
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
        weight = self.point.fit.weights * change_m / self.point.problem.stddev_m**2
        formal = float(weight @ change_m)
        return float(np.sqrt(max(self.of_sums(weight[None])[0, 0] / formal, 1.0))) if formal > 0 else 1.0

    def balanced(self) -> JudgedFit:
        """Return the fit with a prior as strong beside ranges whose common errors are not in their weights.

        It is strengthened by the inflation of the bias, with the position estimated along with it.
        """
        point, problem = self.point, self.point.problem
        root, by_place = np.sqrt(point.fit.weights) / problem.stddev_m, point.slopes[:, :3]
        adapted = np.linalg.lstsq(root[:, None] * by_place, root, rcond=None)[0]
        inflation = self.inflation(1.0 - by_place @ adapted)
        problem = replace(problem, bias_stddev_m=problem.bias_stddev_m / inflation)
        return replace(self, point=replace(point, problem=problem).near(point.at_m), inflation_of_prior=inflation)

    def judged_by(self, inflation: float) -> RangeProblem:
        """Return the problem with standard deviations that account for common errors, for comparing costs."""
        problem = self.point.problem
        bias_stddev_m = problem.bias_stddev_m * self.inflation_of_prior
        return replace(problem, stddev_m=inflation * problem.stddev_m, bias_stddev_m=bias_stddev_m)


def judged_fits(fits: Sequence[PointFit], times_s: Array, tag_index: Indices, curve_stddev_m: Array) -> list[JudgedFit]:
    """Learn the errors of the ranges from the residuals of all fits together.

    Args:
        fits: the fits.
        times_s, tag_index: (n,) of the ranges of all fits, one below the other.
        curve_stddev_m: (n,), as of ``radio_components``.
    """
    lengths = [len(fit.own_stddev_m) for fit in fits]
    anchor_index = np.repeat(np.arange(len(fits)), lengths)
    precision = np.concatenate([fit.own_stddev_m**-2 for fit in fits])
    bins = range_bins(
        anchor_index,
        tag_index,
        times_s,
        np.concatenate([fit.problem.tag_from_center - fit.at_m for fit in fits]),
        np.tile(np.eye(3), (len(anchor_index), 1, 1)),
        np.concatenate([fit.fit.weights for fit in fits]) * precision / precision.mean(),
        noisiness(anchor_index, np.concatenate([fit.fit.residuals_m for fit in fits]), len(fits)),
    )
    learned = learn_errors(
        radio_components(bins, curve_stddev_m, _NOT_HERE),
        bins,
        off_m=bins.mean(np.concatenate([fit.off_m for fit in fits])),
        design=bins.mean(block_diag(*(fit.slopes for fit in fits))),
        prior_design=block_diag(*(fit.prior() for fit in fits)),
        noise_m=float(precision.mean() ** -0.5),
    )
    covariance = learned.covariance_m2
    return [JudgedFit(fit, bins.of_range[anchor_index == k], covariance) for k, fit in enumerate(fits)]

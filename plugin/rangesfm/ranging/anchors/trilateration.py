"""Trilateration: where an anchor stands, from ranges taken at known positions of the tag.

The first step of Lee, Zhu, Giorgi and Günther (2018), made robust and honest about its error.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from rangesfm.arrays import Array
from rangesfm.errors import GeometryError
from rangesfm.geometry.similarity import PathShape, oriented, path_shape
from rangesfm.ranging.anchors.point_fit import PointProblem, best_start, improve
from rangesfm.ranging.errors.inlier_noise import inlier_noise
from rangesfm.ranging.errors.noise import correlation_inflation, inflation_before_fit, short_range_stddev
from rangesfm.ranging.errors.robust_loss import CAUCHY, GEMAN_MCCLURE, SAME_COST

# Three numbers, and one range more to see that they fit.
MIN_NUM_RANGES = 4
_NUM_NOISE_ROUNDS = 4
# What the noise is taken for before residuals say so, and the number of ranges that this counts as.
_USUAL_NOISE_M = 0.1
_USUAL_NOISE_COUNTS = 2.0
_MIN_ORDINARY = 0.3
# Half of 3 stddevs squared: a rival this close in cost is not ruled out.
_MIN_COST_GAP = 4.5
_MIN_CURVATURE = 0.2
# Formal stddevs beyond this share of the distance are checked against the cost itself.
_NONLINEAR = 0.02
_PROFILE_STEPS_M = np.geomspace(0.01, 100.0, 41)
_HOLD = 100.0
_MAX_RANGES_OF_PROFILE = 2000
_NEARLY_STRAIGHT = 0.1
_ACROSS = 0.9
_MIN_BLOCKS = 16
_NUM_UNKNOWNS = 4
# Sine of the angle between a plane and a direction that is along it, but for rounding.
_ALONG_PLANE = 1e-6


@dataclass(frozen=True)
class TrilaterationOptions:
    """How an anchor is found.

    Attributes:
        range_stddev_m: noise of the ranges that do not say theirs; None: estimated from the residuals.
        range_bias_m: prior mean of what the ranges read too long.
        range_bias_stddev_m: stddev of that prior; 0: exactly known.
        max_position_stddev_m: an anchor less certain than this in any direction is refused.
        block_s: errors of ranges closer in time than this are taken to go together, if times are given.
    """

    range_stddev_m: float | None = None
    range_bias_m: float = 0.0
    range_bias_stddev_m: float = 0.1
    max_position_stddev_m: float = 1.0
    block_s: float = 10.0


@dataclass(frozen=True)
class Trilateration:
    """An anchor's place, found from n ranges.

    Attributes:
        position_m: (3,) in the frame of the tag's positions.
        covariance_m2: (3, 3) of the position.
        mirror_position_m: (3,) the place on the other side of the tag's positions that fits as well; or None.
        range_bias_m, range_bias_stddev_m: what the ranges read too long.
        noise_stddev_m: of a range away from all special cases.
        residuals_m: (n,) predicted minus measured.
        weights: (n,) of the robust loss, 1 for a range that fits.
    """

    position_m: Array
    covariance_m2: Array
    mirror_position_m: Array | None
    range_bias_m: float
    range_bias_stddev_m: float
    noise_stddev_m: float
    residuals_m: Array
    weights: Array

    @property
    def position_stddev_m(self) -> float:
        """Of each coordinate: root of their mean variance."""
        return float(np.sqrt(np.trace(self.covariance_m2) / 3))


@dataclass(frozen=True)
class _Fit:
    """An estimate with its own noise.

    Attributes:
        problem: with the final stddevs.
        x: (4,) position and bias.
        noise_m: of a range away from all special cases.
        inflation: of every stddev, by errors that go together.
    """

    problem: PointProblem
    x: Array
    noise_m: float
    inflation: float

    @property
    def residuals_m(self) -> Array:
        return self.problem.residuals_m(self.x)

    @property
    def scaled_residuals(self) -> Array:
        return self.residuals_m / self.problem.stddev_m


def trilaterate(
    tag_positions_m: npt.ArrayLike,
    range_m: npt.ArrayLike,
    *,
    range_stddev_m: npt.ArrayLike | None = None,
    shared_stddev_m: npt.ArrayLike | None = None,
    timestamp_s: npt.ArrayLike | None = None,
    toward: npt.ArrayLike | None = None,
    options: TrilaterationOptions | None = None,
) -> Trilateration:
    """Find an anchor from its ranges to known positions of the tag.

    Up to about half of the ranges may be wrong by any amount. If the positions lie in a plane, the anchor's
    mirror image in it fits as well: then both are returned, unless ``toward`` says which it is; the upper one first if
    no range tells.

    Args:
        tag_positions_m: (n, 3) positions of the tag's antenna, metres.
        range_m: (n,) measured distances.
        range_stddev_m: (n,) noise of each range, NaN where unknown; or None.
        shared_stddev_m: (n,) what ranges of about this length may be off together, by the radio's error curve;
            None: without one, short ranges weigh less.
        timestamp_s: (n,) when they were taken, so that errors that last count for what they are; or None.
        toward: (3,) direction in which the anchor lies, seen from its mirror image; or None.

    Raises:
        GeometryError: too few ranges, positions on a line or all close together, or else an anchor less
            certain than ``options.max_position_stddev_m``.
    """
    options = options or TrilaterationOptions()
    positions, ranges = np.asarray(tag_positions_m, dtype=np.float64), np.asarray(range_m, dtype=np.float64)
    if len(ranges) < MIN_NUM_RANGES:
        raise GeometryError(f"{len(ranges)} ranges at known positions of the tag, {MIN_NUM_RANGES} are needed")
    # A bias that is known is held by a prior far stronger than any ranges.
    bias_stddev_m = max(options.range_bias_stddev_m, 1e-6)
    middle = positions.mean(axis=0)
    problem = PointProblem(
        positions - middle,
        ranges,
        np.full(len(ranges), _USUAL_NOISE_M),
        short_range_stddev(ranges) if shared_stddev_m is None else np.asarray(shared_stddev_m, dtype=np.float64),
        np.array([0.0, 0.0, 0.0, options.range_bias_m]),
        np.array([[0.0, 0.0, 0.0, 1 / bias_stddev_m]]),
    )
    fit = _fit_with_own_noise(problem, range_stddev_m, _groups(timestamp_s, options.block_s), options)
    covariance, shape = _covariance(fit), path_shape(problem.positions_m)
    _refuse_uncertain(covariance, shape, options)
    mirror = _mirror(fit, covariance, shape)
    if mirror is not None:
        across = (mirror - fit.x)[:3]
        told = None if toward is None else _unless_along_plane(np.asarray(toward, dtype=np.float64), across)
        # Where no range tells the two apart, rounding would choose.
        is_free = told is not None or abs(_gap(fit, mirror)) < SAME_COST
        if is_free and across @ (shape.axes[:, 2] if told is None else told) > 0:
            fit, mirror = replace(fit, x=mirror), fit.x
            covariance = _covariance(fit)
        mirror = mirror if told is None else None
    return Trilateration(
        position_m=middle + fit.x[:3],
        covariance_m2=covariance[:3, :3],
        mirror_position_m=None if mirror is None else middle + mirror[:3],
        range_bias_m=float(fit.x[3]),
        range_bias_stddev_m=float(np.sqrt(covariance[3, 3])) if options.range_bias_stddev_m > 0 else 0.0,
        noise_stddev_m=fit.noise_m,
        residuals_m=fit.residuals_m,
        weights=CAUCHY.weights(fit.scaled_residuals),
    )


def _groups(timestamp_s: npt.ArrayLike | None, block_s: float) -> npt.NDArray[np.int64] | None:
    """(n,) labels of stretches of time, at least sixteen of them."""
    if timestamp_s is None:
        return None
    since = np.asarray(timestamp_s, dtype=np.float64) - np.min(timestamp_s)
    length = max(min(block_s, float(since.max()) / _MIN_BLOCKS), 1e-9)
    labels: npt.NDArray[np.int64] = np.floor(since / length).astype(np.int64)
    return labels


def _fit_with_own_noise(
    problem: PointProblem,
    range_stddev_m: npt.ArrayLike | None,
    groups: npt.NDArray[np.int64] | None,
    options: TrilaterationOptions,
) -> _Fit:
    """The best fit; the noise is that of its residuals, and never less than what was given."""
    num = len(problem.range_m)
    given = np.full(num, np.nan) if range_stddev_m is None else np.asarray(range_stddev_m, dtype=np.float64)
    given = np.where(np.isfinite(given), given, options.range_stddev_m or np.nan)
    is_given = np.isfinite(given)
    unit = np.where(is_given, given, np.median(given[is_given]) if is_given.any() else _USUAL_NOISE_M)
    x, noise = best_start(problem, unit)
    inflation = 1.0
    for _ in range(_NUM_NOISE_ROUNDS):
        noise = max(noise, 1.0) if is_given.all() else noise
        # Ranges keep their weight among themselves; the prior gains by what correlated errors cost them.
        stddev = np.hypot(noise * unit, problem.shared_stddev_m)
        now = replace(problem, stddev_m=stddev, prior=problem.prior * inflation)
        fit = _Fit(now, improve(now, x), noise * float(np.median(unit)), inflation)
        x = fit.x
        ordinary = problem.shared_stddev_m < noise * unit
        rows = ordinary if np.mean(ordinary) > _MIN_ORDINARY else np.ones(num, dtype=np.bool_)
        noise = _noise_of(fit.residuals_m[rows] / unit[rows])
        if groups is not None:
            inflation = _inflation(fit.scaled_residuals, groups)
    return replace(fit, inflation=inflation)


def _inflation(scaled: Array, groups: npt.NDArray[np.int64]) -> float:
    """Of every stddev by errors that go together."""
    seen = correlation_inflation(scaled, CAUCHY.weights(scaled), groups)
    return inflation_before_fit(seen, len(np.unique(groups)), _NUM_UNKNOWNS)


def _noise_of(scaled: Array) -> float:
    """Stddev of residuals in units, drawn to what is usual where there are few; four of them went into the fit."""
    freedom = max(len(scaled) - _NUM_UNKNOWNS, 0)
    found = inlier_noise(scaled).stddev ** 2 * len(scaled)
    return float(np.sqrt((found + _USUAL_NOISE_COUNTS) / (freedom + _USUAL_NOISE_COUNTS)))


def _covariance(fit: _Fit) -> Array:
    """(4, 4) of position and bias, by the curvature of the cost; the weakest direction by the cost itself.

    Huber and Ronchetti, "Robust Statistics" (2009), section 7.6: for M-estimates the information is that of
    the weighted Jacobian, scaled by the loss' mean squared slope over its squared mean curvature.
    """
    scaled, jacobian = fit.scaled_residuals, fit.problem.jacobian(fit.x)
    weights = CAUCHY.weights(scaled)
    curvature = max(float(np.mean(weights * (2 * weights - 1)) / np.mean(weights)), _MIN_CURVATURE)
    slope = float(np.mean((weights * scaled) ** 2) / np.mean(weights))
    shrinking = curvature**2 / max(slope, 1e-12) / fit.inflation**2
    prior = fit.problem.prior / fit.inflation
    information = (jacobian * weights[:, None]).T @ jacobian * min(shrinking, 1 / fit.inflation**2) + prior.T @ prior
    covariance = _inverse(information)
    return _with_weak_direction(fit, covariance)


def _inverse(information: Array) -> Array:
    # Position and bias each in a unit of its own: beside a bias that is known, in metres, no place counts at all.
    strongest = np.diag(information)
    unit = 1 / np.sqrt(np.append(np.full(3, strongest[:3].max()), strongest[3]))
    values, vectors = np.linalg.eigh(unit[:, None] * information * unit)
    inverse: Array = unit[:, None] * ((vectors / np.maximum(values, 1e-12)) @ vectors.T) * unit
    return inverse


def _with_weak_direction(fit: _Fit, covariance: Array) -> Array:
    """Near the plane of the tag's positions the curvature across it vanishes, but the cost rises further off."""
    variances, axes = np.linalg.eigh(covariance[:3, :3])
    if np.sqrt(variances[2]) < _NONLINEAR * float(np.median(fit.problem.range_m)):
        return covariance
    along = np.append(axes[:, 2], 0.0)
    # The other numbers follow along as they do where the curvature holds.
    tied = covariance @ along / variances[2]
    changed: Array = covariance + (_profile_stddev(fit, along) ** 2 - variances[2]) * np.outer(tied, tied)
    return changed


def _profile_stddev(fit: _Fit, along: Array) -> float:
    """How far the point moves ``along`` (4,) until the cost, all else adapted, has risen by that of one stddev."""
    num = len(fit.problem.range_m)
    part = fit.problem.subset(np.linspace(0, num - 1, min(num, _MAX_RANGES_OF_PROFILE)).astype(np.int64))
    hold = np.vstack([part.prior, _HOLD * np.sqrt(np.sum(part.stddev_m**-2)) * along])
    allowed = part.cost(fit.x) + 0.5 * fit.inflation**2 * len(part.range_m) / num

    def is_far(step: float) -> bool:
        moved = fit.x + step * along
        held = replace(part, prior_mean=np.append(moved[:3], part.prior_mean[3]), prior=hold)
        return held.cost(improve(held, moved)) > allowed

    last = _PROFILE_STEPS_M[-1]
    return float(max(next((step for step in _PROFILE_STEPS_M if is_far(sign * step)), last) for sign in (1, -1)))


def _refuse_uncertain(covariance: Array, shape: PathShape, options: TrilaterationOptions) -> None:
    variances, axes = np.linalg.eigh(covariance[:3, :3])
    stddev = float(np.sqrt(variances[2]))
    if stddev <= options.max_position_stddev_m:
        return
    length, width = shape.stddevs[:2]
    if length <= options.max_position_stddev_m / 10:
        why = f"the tag's positions lie within {length:.3g} m of each other"
    elif width < _NEARLY_STRAIGHT * length:
        why = "the tag's positions lie on a line, about which the anchor may stand anywhere"
    elif abs(axes[:, 2] @ shape.axes[:, 2]) > _ACROSS:
        why = "the anchor stands near the plane in which the tag's positions lie, and how far off it is not seen"
    else:
        why = f"the tag's positions extend over {length:.3g} by {width:.3g} m, too little or too far away"
    # No minus sign by rounding, neither of all three nor of a zero.
    direction = ", ".join(f"{component:.2f}" for component in np.round(oriented(axes)[:, 2], 2) + 0.0)
    raise GeometryError(
        f"the position is not determined: {why} (stddev {min(stddev, _PROFILE_STEPS_M[-1]):.2g} m along {direction})"
    )


def _mirror(fit: _Fit, covariance: Array, shape: PathShape) -> Array | None:
    """(4,) the place on the other side of the tag's positions, if it is another one and fits as well."""
    normal = np.append(shape.axes[:, 2], 0.0)
    height = float((fit.x[:3] - shape.centroid) @ shape.axes[:, 2])
    found = improve(fit.problem, fit.x - 2 * height * normal)
    apart = (found - fit.x)[:3]
    distance = float(np.linalg.norm(apart))
    stddev = float(np.sqrt(apart @ covariance[:3, :3] @ apart)) / max(distance, 1e-12)
    return found if distance > 2 * stddev and _gap(fit, found) < _MIN_COST_GAP * fit.inflation**2 else None


def _gap(fit: _Fit, mirror: Array) -> float:
    """How much worse the mirror image fits, by a bounded loss: outliers cost the same wherever the point is."""
    return fit.problem.cost(mirror, GEMAN_MCCLURE) - fit.problem.cost(fit.x, GEMAN_MCCLURE)


def _unless_along_plane(direction: Array, across: Array) -> Array | None:
    """A direction that tells two places apart; of one along the plane between them, rounding would choose the sign."""
    least = _ALONG_PLANE * float(np.linalg.norm(direction) * np.linalg.norm(across))
    return direction if abs(direction @ across) > least else None

"""Robust least squares for a point and a range bias, also without a first guess, and how wrong they may be.

    predicted = || p - a || + b

p: known position of the tag; a: the point that is sought, an anchor's antenna; b: range bias.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import block_diag
from scipy.optimize import least_squares

from rangesfm.arrays import Array, Indices
from rangesfm.geometry.similarity import path_shape
from rangesfm.ranging.errors.cells import cells, noisiness
from rangesfm.ranging.errors.learned import learn_errors
from rangesfm.ranging.errors.noise import inlier_noise, robust_stddevs
from rangesfm.ranging.errors.robust_loss import CAUCHY, RobustLoss
from rangesfm.ranging.range_gradient import RangeGradient

_NUM_ROUNDS = 12
# On the diagonal of normal equations, whose columns have length 1 before weights: where outliers take all weight.
_RIDGE = 1e-16
_CONVERGED = 1e-13
# Of a search: as many ranges and directions of starts, widths of the loss in units, and how far apart places are two.
_MAX_NUM_RANGES = 300
_NUM_DIRECTIONS = 20
_WIDTHS = (30.0, 10.0, 3.0, 1.0, 0.3)
_NEARLY_CONVERGED = 1e-5
_DISTINCT_M = 0.01
_NUM_UNKNOWNS = 4
_NUM_NOISE_ROUNDS = 4
# What the noise is taken for before residuals say so, and the number of ranges that this counts as.
_USUAL_NOISE_M = 0.1
_USUAL_NOISE_COUNTS = 2.0
_MIN_ORDINARY = 0.3
# Of the errors that are learnt: each anchor's bias is estimated with a prior of its own, and the path is known.
_NOT_HERE = ("bias", "common_bias")


def multilaterate(positions: Array, ranges: Array) -> tuple[Array, Array]:
    """A point from its distances to known positions, robustly, without a start.

    rho^2 = |p|^2 - 2 a.p + |a|^2 is linear in (a, |a|^2). Where the positions lie in a plane,
    the height above it follows from |a|^2; its sign is arbitrary.

    Args:
        positions: (..., n, 3), of one point or of many at once.
        ranges: (n,) or (..., n).

    Returns:
        the point (..., 3), and (..., n) residuals in metres (of the linear model).
    """
    shape = path_shape(positions)
    local = (positions - shape.centroid[..., None, :]) @ shape.axes
    # Noise of about a decimetre decides which directions the ranges see at all.
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
    """n ranges to one point. Its unknowns are x = (a, b), four numbers; a near the origin, or digits are lost.

    Attributes:
        positions_m: (n, 3) of the tag.
        range_m: (n,) measured.
        stddev_m: (n,).
        shared_stddev_m: (n,) the part of it that ranges of about this length have in common.
        prior_mean: (4,).
        prior: (k, 4) what is known of x: ``prior @ (x - prior_mean)`` is as large as a standard normal number.
    """

    positions_m: Array
    range_m: Array
    stddev_m: Array
    shared_stddev_m: Array
    prior_mean: Array
    prior: Array

    def subset(self, rows: Indices) -> PointProblem:
        """The same problem with some of its ranges."""
        names = ("positions_m", "range_m", "stddev_m", "shared_stddev_m")
        return replace(self, **{name: getattr(self, name)[rows] for name in names})

    def residuals_m(self, x: Array) -> Array:
        """(n,) predicted minus measured."""
        residuals: Array = self._gradient(x).distance_m + x[3] - self.range_m
        return residuals

    def slopes(self, x: Array) -> Array:
        """(n, 4) derivatives of the residuals in metres."""
        by_anchor = self._gradient(x).by_anchor
        return np.column_stack([by_anchor, np.ones(len(by_anchor))])

    def jacobian(self, x: Array) -> Array:
        """(n, 4) derivatives of the residuals in stddevs."""
        jacobian: Array = self.slopes(x) / self.stddev_m[:, None]
        return jacobian

    def _gradient(self, x: Array) -> RangeGradient:
        return RangeGradient.of(self.positions_m - x[:3])

    def cost(self, x: Array, loss: RobustLoss = CAUCHY) -> float:
        """Half the robust sum of squares, the prior included."""
        rho = loss.rho((self.residuals_m(x) / self.stddev_m) ** 2)[0]
        return float(np.sum(rho) + np.sum((self.prior @ (x - self.prior_mean)) ** 2)) / 2


@dataclass(frozen=True)
class PointFit:
    """An estimate with its own noise.

    Attributes:
        problem: with the final stddevs.
        x: (4,) position and bias.
        own_stddev_m: (n,) noise of each range, without what it shares with others.
    """

    problem: PointProblem
    x: Array
    own_stddev_m: Array

    @property
    def noise_m(self) -> float:
        """Of a range away from all special cases."""
        return float(np.median(self.own_stddev_m))

    @property
    def residuals_m(self) -> Array:
        return self.problem.residuals_m(self.x)

    @property
    def off_m(self) -> Array:
        """(n,) measured minus predicted, with the bias that was expected."""
        return -self.problem.residuals_m(np.append(self.x[:3], self.problem.prior_mean[3]))

    @property
    def weights(self) -> Array:
        """(n,) of the robust loss."""
        return CAUCHY.weights(self.residuals_m / self.problem.stddev_m)


def fit_with_own_noise(problem: PointProblem, given_m: Array) -> PointFit:
    """The best fit; the noise is that of its residuals, and never less than what was given.

    Args:
        problem: of its stddevs only the shared ones are looked at.
        given_m: (n,) noise of each range, NaN where it is to be found.
    """
    is_given = np.isfinite(given_m)
    unit = np.where(is_given, given_m, np.median(given_m[is_given]) if is_given.any() else _USUAL_NOISE_M)
    x, noise = _best_start(problem, unit)
    for _ in range(_NUM_NOISE_ROUNDS):
        noise = max(noise, 1.0) if is_given.all() else noise
        now = replace(problem, stddev_m=np.hypot(noise * unit, problem.shared_stddev_m))
        fit = PointFit(now, improve(now, x), noise * unit)
        x = fit.x
        ordinary = problem.shared_stddev_m < noise * unit
        rows = ordinary if np.mean(ordinary) > _MIN_ORDINARY else np.ones(len(unit), dtype=np.bool_)
        noise = _noise_of(fit.residuals_m[rows] / unit[rows])
    return fit


def _noise_of(scaled: Array) -> float:
    """Stddev of residuals in units, drawn to what is usual where there are few; four of them went into the fit."""
    freedom = max(len(scaled) - _NUM_UNKNOWNS, 0)
    found = inlier_noise(scaled).stddev ** 2 * len(scaled)
    return float(np.sqrt((found + _USUAL_NOISE_COUNTS) / (freedom + _USUAL_NOISE_COUNTS)))


def improve(problem: PointProblem, x: Array, tolerance: float = _CONVERGED) -> Array:
    """(4,) the minimum of the cost near to ``x``, under a Cauchy loss that the prior is not subject to."""
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
    """The most likely unknowns (4,), whatever the outliers, and the noise there as a multiple of ``unit_m``.

    Starts all around the tag and a linear one follow the minima of a Cauchy loss while it narrows from metres to
    centimetres; the likelihood chooses among all that they pass. ``unit_m`` (n,): how the noise of the ranges compares.
    """
    rows = np.linspace(0, len(unit_m) - 1, min(len(unit_m), _MAX_NUM_RANGES)).astype(np.int64)
    part, unit_m = problem.subset(rows), unit_m[rows]
    now, passed = _starts(part), []
    for width in _WIDTHS:
        narrowed = replace(part, stddev_m=np.hypot(width * unit_m, part.shared_stddev_m))
        now = _distinct([improve(narrowed, x, _NEARLY_CONVERGED) for x in now])
        passed += now
    noises = [inlier_noise(part.residuals_m(x) / np.hypot(unit_m, part.shared_stddev_m)) for x in passed]
    best = int(np.argmax([noise.log_likelihood for noise in noises]))
    return passed[best], noises[best].stddev


def _distinct(points: list[Array]) -> list[Array]:
    kept: list[Array] = []
    for x in points:
        if all(np.linalg.norm(x - other) > _DISTINCT_M for other in kept):
            kept.append(x)
    return kept


def _starts(problem: PointProblem) -> list[Array]:
    """All around the middle of the tag's positions, and the linear solution on either side."""
    bias = problem.prior_mean[3]
    ranges = problem.range_m - bias
    shape = path_shape(problem.positions_m)
    linear, _ = multilaterate(problem.positions_m, ranges)
    normal = shape.axes[:, 2]
    mirrored = linear - 2 * ((linear - shape.centroid) @ normal) * normal
    around = shape.centroid + np.median(ranges) * _directions()
    return [np.append(point, bias) for point in (*around, linear, mirrored)]


def _directions() -> Array:
    """(m, 3) unit vectors, evenly spread along a spiral from pole to pole."""
    step = np.arange(_NUM_DIRECTIONS) + 0.5
    height, turn = 1 - 2 * step / _NUM_DIRECTIONS, np.pi * (1 + 5**0.5) * step
    flat = np.sqrt(1 - height**2)
    return np.stack([flat * np.cos(turn), flat * np.sin(turn), height], axis=1)


@dataclass(frozen=True)
class FitErrors:
    """Of the n ranges of one anchor: (n,) the cell of each, and (c, c) the covariance of the errors of cells."""

    of_cell: Indices
    covariance_m2: Array

    def of_sums(self, influence: Array) -> Array:
        """(k, k) covariance of (k, n) sums of the ranges' errors."""
        of_cells = np.stack([np.bincount(self.of_cell, row, len(self.covariance_m2)) for row in influence])
        covariance: Array = of_cells @ self.covariance_m2 @ of_cells.T
        return covariance

    def inflation(self, fit: PointFit, change_m: Array) -> float:
        """How much larger a stddev is than if ranges erred independently, of what changes them by (n,) ``change_m``."""
        weight = fit.weights * change_m / fit.problem.stddev_m**2
        formal = float(weight @ change_m)
        return float(np.sqrt(max(self.of_sums(weight[None])[0, 0] / formal, 1.0))) if formal > 0 else 1.0

    def inflation_of_bias(self, fit: PointFit) -> float:
        """The same of the bias, all else adapted."""
        root = np.sqrt(fit.weights) / fit.problem.stddev_m
        slopes = fit.problem.slopes(fit.x)
        adapted = np.linalg.lstsq(root[:, None] * slopes[:, :3], root, rcond=None)[0]
        return self.inflation(fit, 1.0 - slopes[:, :3] @ adapted)


def errors_of_fits(
    fits: Sequence[PointFit], times_s: Sequence[Array], tags: Sequence[Indices], *, is_calibrated: bool
) -> list[FitErrors]:
    """What the residuals of all fits together say of their ranges' errors; ``times_s``, ``tags``: (n_k,) of each fit.

    ``is_calibrated``: an error curve has been taken off, whose stddev the ranges share.
    """
    lengths = [len(fit.residuals_m) for fit in fits]
    anchor_index = np.repeat(np.arange(len(fits)), lengths)
    slopes = [fit.problem.slopes(fit.x) for fit in fits]
    curve_stddev_m = np.concatenate([fit.problem.shared_stddev_m for fit in fits])
    precision = np.concatenate([fit.own_stddev_m**-2 for fit in fits])
    learned = learn_errors(
        cells(
            anchor_index,
            np.concatenate(tags),
            np.concatenate(times_s),
            np.concatenate([fit.problem.positions_m - fit.x[:3] for fit in fits]),
            np.tile(np.eye(3), (len(anchor_index), 1, 1)),
            np.concatenate([fit.weights for fit in fits]) * precision / precision.mean(),
            noisiness(anchor_index, np.concatenate([fit.residuals_m for fit in fits]), len(fits)),
        ),
        off_m=np.concatenate([fit.off_m for fit in fits]),
        design=block_diag(*slopes),
        prior_design=block_diag(*(fit.problem.prior for fit in fits)),
        noise_m=float(precision.mean() ** -0.5),
        curve_stddev_m=curve_stddev_m if is_calibrated else None,
        ruled_out=_NOT_HERE,
    )
    covariance = learned.covariance_m2
    return [FitErrors(learned.of_range[anchor_index == k], covariance) for k in range(len(fits))]

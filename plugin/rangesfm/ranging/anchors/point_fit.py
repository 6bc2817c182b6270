"""Robust least squares for a point and a range bias, also without a first guess.

    predicted = || p - a || + b

p: known position of the tag; a: the point that is sought, an anchor's antenna; b: range bias.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares

from rangesfm.arrays import Array, Indices
from rangesfm.geometry.similarity import path_shape
from rangesfm.ranging.anchors.multilateration import multilaterate
from rangesfm.ranging.errors.noise import inlier_noise
from rangesfm.ranging.errors.robust_loss import CAUCHY, RobustLoss
from rangesfm.ranging.range_gradient import RangeGradient

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
    x, noise = best_start(problem, unit)
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


def best_start(problem: PointProblem, unit_m: Array) -> tuple[Array, float]:
    """The most likely point, whatever the outliers.

    Starts all around the tag and a linear one follow the minima of a Cauchy loss while it narrows from metres to
    centimetres; the likelihood chooses among all that they pass.

    Args:
        problem: of its stddevs only the shared ones are looked at.
        unit_m: (n,) how the noise of the ranges compares.

    Returns:
        (4,) unknowns, and the noise there as a multiple of ``unit_m``.
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

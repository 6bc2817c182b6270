"""Robust least squares for a point and a range bias, also without a first guess.

    predicted = || p - a || + b

p: known position of the tag; a: the point that is sought, an anchor's antenna; b: range bias.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.optimize import least_squares

from rangesfm.arrays import Array
from rangesfm.geometry.similarity import path_shape
from rangesfm.ranging.anchors.multilateration import multilaterate
from rangesfm.ranging.errors.inlier_noise import inlier_noise
from rangesfm.ranging.errors.robust_loss import CAUCHY, RobustLoss
from rangesfm.ranging.range_gradient import RangeGradient

_CONVERGED = 1e-13
# Of a search: as many ranges and directions of starts, widths of the loss in units, and how far apart places are two.
_MAX_NUM_RANGES = 300
_NUM_DIRECTIONS = 20
_WIDTHS = (30.0, 10.0, 3.0, 1.0, 0.3)
_NEARLY_CONVERGED = 1e-5
_DISTINCT_M = 0.01


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

    def subset(self, rows: npt.NDArray[np.int64]) -> PointProblem:
        """The same problem with some of its ranges."""
        names = ("positions_m", "range_m", "stddev_m", "shared_stddev_m")
        return replace(self, **{name: getattr(self, name)[rows] for name in names})

    def residuals_m(self, x: Array) -> Array:
        """(n,) predicted minus measured."""
        residuals: Array = self._gradient(x).distance_m + x[3] - self.range_m
        return residuals

    def jacobian(self, x: Array) -> Array:
        """(n, 4) derivatives of the residuals in stddevs."""
        by_anchor = self._gradient(x).by_anchor
        jacobian: Array = np.column_stack([by_anchor, np.ones(len(by_anchor))]) / self.stddev_m[:, None]
        return jacobian

    def _gradient(self, x: Array) -> RangeGradient:
        return RangeGradient.of(self.positions_m - x[:3])

    def cost(self, x: Array, loss: RobustLoss = CAUCHY) -> float:
        """Half the robust sum of squares, the prior included."""
        rho = loss.rho((self.residuals_m(x) / self.stddev_m) ** 2)[0]
        return float(np.sum(rho) + np.sum((self.prior @ (x - self.prior_mean)) ** 2)) / 2


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

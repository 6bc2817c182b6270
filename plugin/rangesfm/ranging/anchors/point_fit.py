"""Robust least squares for a point and a range bias, from many starts at once.

    predicted = || p - a || + b

p: known position of the tag; a: the point that is sought, an anchor's antenna; b: range bias.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from rangesfm.ranging.errors.robust_loss import CAUCHY

Array = npt.NDArray[np.float64]

_TINY_M = 1e-9
# Of all ranges, before any is looked at; spread over twice the usual length of a range.
_OUTLIER_SHARE = 0.3
_NUM_ITERATIONS = 60
_CONVERGED_M = 1e-10
_FIRST_DAMPING = 1e-3
_MAX_DAMPING = 1e12


@dataclass(frozen=True)
class PointProblem:
    """n ranges to one point. Its unknowns are x = (a, b), four numbers.

    Attributes:
        positions_m: (n, 3) of the tag.
        range_m: (n,) measured.
        stddev_m: (n,), or (k, n) if the k starts differ.
        shared_stddev_m: (n,) the part of it that ranges of about this length have in common.
        prior_mean: (4,) or (k, 4).
        prior_information: (4, 4), symmetric; zero where nothing is known.
    """

    positions_m: Array
    range_m: Array
    stddev_m: Array
    shared_stddev_m: Array
    prior_mean: Array
    prior_information: Array

    def subset(self, rows: npt.NDArray[np.int64]) -> PointProblem:
        """The same problem with some of its ranges."""
        return replace(
            self,
            positions_m=self.positions_m[rows],
            range_m=self.range_m[rows],
            stddev_m=self.stddev_m[..., rows],
            shared_stddev_m=self.shared_stddev_m[rows],
        )

    def residuals_m(self, x: Array) -> Array:
        """(k, n) predicted minus measured for (k, 4) unknowns."""
        residuals: Array = self._distances(x)[1] + x[:, 3:] - self.range_m
        return residuals

    def cost(self, x: Array) -> Array:
        """(k,) half the robust sum of squares, the prior included."""
        squared = (self.residuals_m(x) / self.stddev_m) ** 2
        cost: Array = np.sum(CAUCHY.rho(squared)[0], axis=1) / 2 + self._prior_cost(x)
        return cost

    def unlikelihood(self, x: Array) -> Array:
        """(k,) negative log-likelihood where any range may be an outlier of any length: to choose among rivals.

        Outliers cost the same wherever the point is; under the Cauchy loss a place near to many of them
        could win over the true one.
        """
        outlier_density = _OUTLIER_SHARE / (2 * float(np.median(self.range_m)))
        squared = (self.residuals_m(x) / self.stddev_m) ** 2
        density = (1 - _OUTLIER_SHARE) / (np.sqrt(2 * np.pi) * self.stddev_m) * np.exp(-squared / 2)
        unlikelihood: Array = self._prior_cost(x) - np.sum(np.log(density + outlier_density), axis=1)
        return unlikelihood

    def linearized(self, x: Array) -> tuple[Array, Array]:
        """(k, n) residuals in stddevs, and (k, n, 4) their derivatives."""
        from_point, distances = self._distances(x)
        jacobian = np.empty((*distances.shape, 4))
        # On the point the distance has no derivative; zero keeps the step finite.
        jacobian[..., :3] = -from_point / (np.maximum(distances, _TINY_M) * self.stddev_m)[..., None]
        jacobian[..., 3] = 1 / self.stddev_m
        return (distances + x[:, 3:] - self.range_m) / self.stddev_m, jacobian

    def _prior_cost(self, x: Array) -> Array:
        off = x - self.prior_mean
        cost: Array = 0.5 * np.einsum("ki,ij,kj->k", off, self.prior_information, off)
        return cost

    def _distances(self, x: Array) -> tuple[Array, Array]:
        from_point = self.positions_m[None] - x[:, None, :3]
        return from_point, np.sqrt(np.einsum("kni,kni->kn", from_point, from_point))


def improve(problem: PointProblem, x: Array, num_iterations: int = _NUM_ITERATIONS) -> tuple[Array, Array]:
    """Levenberg-Marquardt with a Cauchy loss from (k, 4) starts, each on its own.

    Returns:
        (k, 4) unknowns and (k,) their cost, never above that of the start.
    """
    cost = problem.cost(x)
    damping = np.full(len(x), _FIRST_DAMPING)
    for _ in range(num_iterations):
        gradient, information = _normal_equations(problem, x)
        diagonal = np.einsum("kii->ki", information)
        damped = information + (damping[:, None] * diagonal + 1e-12)[..., None] * np.eye(4)
        trial = x - np.linalg.solve(damped, gradient[..., None])[..., 0]
        trial_cost = problem.cost(trial)
        better = trial_cost <= cost
        moved = np.linalg.norm(trial - x, axis=1)
        x, cost = np.where(better[:, None], trial, x), np.where(better, trial_cost, cost)
        damping = np.clip(np.where(better, damping / 10, damping * 10), 1e-12, _MAX_DAMPING)
        if np.all(moved < _CONVERGED_M):
            break
    return x, cost


def _normal_equations(problem: PointProblem, x: Array) -> tuple[Array, Array]:
    """(k, 4) gradient of the cost and (k, 4, 4) its Gauss-Newton information."""
    scaled, jacobian = problem.linearized(x)
    weighted = jacobian * CAUCHY.weights(scaled)[..., None]
    gradient = (scaled[:, None] @ weighted)[:, 0] + (x - problem.prior_mean) @ problem.prior_information
    return gradient, np.swapaxes(weighted, 1, 2) @ jacobian + problem.prior_information

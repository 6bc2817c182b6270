"""The linear Gaussian problem of a map, and its best estimate (Gauss and Markov)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.linalg import solve_triangular

from rangesfm.arrays import Array, Indices
from rangesfm.util.geometry.numerics import ROUNDING, UNDETERMINED


@dataclass(frozen=True)
class Columns:
    """Position of each unknown of a model in the parameter vector; -1 for an unknown that is not estimated.

    The order is: for each model in turn, the logarithm of the scale and the frame (6: turn, shift); then the anchors
    (3 each); then the biases.
    """

    scale: int
    frame: int
    anchor: Indices
    bias: Indices
    num: int

    @classmethod
    def of_whole(cls, num: int) -> Columns:
        """Return those of the map as a whole alone: the logarithm of the scale, and the frame if there are 7."""
        nothing = np.zeros(0, dtype=np.int64)
        return cls(0, 1 if num == 7 else -1, nothing, nothing, num)

    @property
    def of_map(self) -> list[int]:
        """Columns of the map as a whole: the logarithm of the scale and, if estimated, the turn and the shift."""
        return [self.scale, *(range(self.frame, self.frame + 6) if self.frame >= 0 else ())]

    def map_step(self, step: Array) -> Array:
        """Return the (7,) step of the map as a whole in one (p,) of all unknowns; 0 where it is not estimated."""
        of_map = np.zeros(7)
        of_map[: len(self.of_map)] = step[self.of_map]
        return of_map

    def placement(self, covariance: Array) -> Array | None:
        """Return the part (7, 7) of the map as a whole of a (p, p) covariance; None if its place is not estimated."""
        return None if self.frame < 0 else np.asarray(covariance[np.ix_(self.of_map, self.of_map)])


@dataclass(frozen=True)
class LinearMap:
    """Linear equations of c observations and r priors for p unknowns of a map, about the map's state.

    Attributes:
        columns: position of each unknown; the first is the logarithm of the scale.
        design: (c, p) derivatives of the residuals by the unknowns.
        residual_m: (c,) predicted minus measured, without any bias.
        prior_residual, prior_design: (r,), (r, p) the same for the priors, in standard deviations.
    """

    columns: Columns
    design: Array
    residual_m: Array
    prior_residual: Array = field(default_factory=lambda: np.zeros(0))
    prior_design: Array = field(default_factory=lambda: np.zeros((0, 0)))

    @property
    def residual(self) -> Array:
        """(c + r,) residuals of observations, and below them of priors."""
        return np.append(self.residual_m, self.prior_residual)

    @property
    def jacobian(self) -> Array:
        """(c + r, p) derivatives of all residuals."""
        return np.vstack([self.design, self.prior_design.reshape(-1, self.design.shape[1])])

    def with_more(self, unknowns: Sequence[Array]) -> LinearMap:
        """Return the equations with further unknowns, by effects (c, m) on observations, or (c + r, m) on all."""
        num, own = len(self.residual_m), self.jacobian
        columns = _side_by_side([own, *unknowns], len(own))
        return LinearMap(self.columns, columns[:num], self.residual_m, self.prior_residual, columns[num:])

    def solved(self, covariance_m2: Array) -> Solved:
        """Return the solution for residuals with this (c, c) covariance."""
        return Solved(covariance_m2, self.jacobian, self.residual)


class Solved:
    """The decompositions of a linear problem with given errors, which its estimate and all mistakes in it share.

    Its equations are those of c observations, with the covariance of their errors, and below them those of r priors,
    in standard deviations.

    Attributes:
        covariance: (p, p) of the estimate; a direction that nothing determines has a huge variance.
        residual: (c + r,) whitened residuals that the unknowns leave.
    """

    def __init__(self, covariance_m2: Array, design: Array, residual: Array):
        self.lower, self._num = np.linalg.cholesky(regular(covariance_m2)), len(residual)
        whitened = self.whitened(design)
        lengths = np.maximum(np.linalg.norm(whitened, axis=0), 1e-100)
        basis, values, turns = np.linalg.svd(whitened / lengths, full_matrices=False)
        determined, root = np.maximum(values, UNDETERMINED), turns.T / lengths[:, None]
        self.covariance = root / determined**2 @ root.T
        self._basis, self._gains = basis[:, values > UNDETERMINED], root * (values / determined**2) @ basis.T
        self._whole = self.whitened(residual[:, None])
        self.residual = self.left(self._whole)[:, 0]

    def whitened(self, *effects: Array) -> Array:
        """Return the (c + r, k) effects of all, by those (c, m) on observations or (c + r, m) on all, in stddevs."""
        num, together = len(self.lower), _side_by_side(effects, self._num)
        return np.vstack([solve_triangular(self.lower, together[:num], lower=True), together[num:]])

    def left(self, whitened: Array) -> Array:
        """Return what the unknowns cannot explain of whitened effects (c + r, k)."""
        left: Array = whitened - self._basis @ (self._basis.T @ whitened)
        return left

    @property
    def misfit(self) -> float:
        """Sum of the squared residuals that the unknowns leave, with those of the priors, in standard deviations."""
        return float(self.residual @ self.residual)

    @property
    def step(self) -> Array:
        """(p,) step from the state to the likeliest one."""
        return self.by_unknowns(self._whole)[:, 0]

    def by_unknowns(self, whitened: Array) -> Array:
        """Return the (p, k) change of the estimate by whitened effects (c + r, k) on the residuals."""
        return np.asarray(-self._gains @ whitened)

    @property
    def pulls(self) -> Array:
        """(c,) inverse covariance times what the unknowns leave of the observations, measured minus predicted."""
        return np.asarray(-solve_triangular(self.lower, self.residual[: len(self.lower)], lower=True, trans=1))

    @property
    def gains(self) -> tuple[Array, Array]:
        """(p, c) and (p, r) change of the estimate per unit of each measurement and prior."""
        num = len(self.lower)
        return solve_triangular(self.lower, self._gains[:, :num].T, lower=True, trans=1).T, self._gains[:, num:]


def _side_by_side(effects: Sequence[Array], num: int) -> Array:
    """Return effects on all ``num`` residuals together, of which some are on the first ones alone."""
    return np.hstack([np.pad(each, ((0, num - len(each)), (0, 0))) for each in effects])


def regular(covariance: Array) -> Array:
    """Return a covariance that is positive definite in spite of rounding."""
    return np.asarray(covariance + ROUNDING * np.trace(covariance) * np.eye(len(covariance)))

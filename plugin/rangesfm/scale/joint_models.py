"""Several models and one set of anchors: all similarities and all anchors from all ranges at once.

The range equation of each model has a scale and a frame of its own; anchors and biases are common to all.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.optimize import least_squares

from rangesfm.geometry.similarity import Similarity
from rangesfm.ranging.errors.robust_loss import CAUCHY
from rangesfm.scale.range_equation import (
    Columns,
    RangeProblem,
    RangeState,
    columns_of,
    invert_information,
    predicted_ranges,
    prior_jacobian,
    prior_residuals,
    range_jacobian,
    state_after,
)

Array = npt.NDArray[np.float64]

_MAX_NUM_EVALUATIONS = 100


@dataclass(frozen=True)
class JointState:
    """Values of all unknowns: a similarity for each model, anchors (m, 3) and biases (m,) of all."""

    metric_from_model: tuple[Similarity, ...]
    anchors_m: Array
    bias_m: Array

    def of_model(self, k: int) -> RangeState:
        """As one model has it."""
        return RangeState(self.metric_from_model[k], self.anchors_m, self.bias_m)


@dataclass(frozen=True)
class JointFit:
    """A solution.

    Attributes:
        state: the estimate.
        cost: half the robust sum of squares, priors included.
        covariance: formal, of all parameters; what nothing determines has a huge variance.
        own: where the parameters of each model are: logarithm of the scale, then turn and shift of one that is free.
    """

    state: JointState
    cost: float
    covariance: Array
    own: tuple[slice, ...]

    def path_stddev_m(self, k: int, centers: Array) -> float:
        """Formal, root mean square, of the places (n, 3; in the model's unit) of one model that is free."""
        similarity = self.state.metric_from_model[k]
        grown = similarity.scale * centers @ similarity.rotation.T
        jacobian = np.zeros((len(centers), 3, 7))
        jacobian[:, :, 0] = grown
        jacobian[:, :, 1:4] = -np.cross(grown[:, None, :], np.eye(3)).swapaxes(1, 2)
        jacobian[:, :, 4:] = np.eye(3)
        covariance = self.covariance[self.own[k], self.own[k]]
        return float(np.sqrt(np.mean(np.einsum("nij,jk,nik->n", jacobian, covariance, jacobian))))


def solve_together(parts: Sequence[RangeProblem], start: JointState, *, tolerance: float = 1e-12) -> JointFit:
    """Robust least squares over all models, each with a similarity of its own.

    Args:
        parts: of each model, in its own unit, with its own say whether its frame is free. Anchors, biases and what is
            known of them beforehand are those of the first, and the same for all.
        start: anchors that have no place have no ranges.
        tolerance: as in ``solve``.
    """
    problem = _JointProblem.of(parts)

    def rho(z: Array) -> Array:
        # Priors are believed as they are; only ranges have outliers.
        values = np.stack([z, np.ones_like(z), np.zeros_like(z)])
        values[:, : problem.num_ranges] = CAUCHY.rho(z[: problem.num_ranges])
        return values

    result = least_squares(
        lambda x: problem.residuals(start, x),
        np.zeros(problem.columns.num),
        jac=lambda x: problem.jacobian(start, x),
        loss=rho,
        x_scale="jac",
        ftol=tolerance,
        xtol=tolerance,
        gtol=None,
        max_nfev=_MAX_NUM_EVALUATIONS,
    )
    state = problem.state_after(start, result.x)
    return JointFit(state, float(result.cost), problem.covariance(state), problem.own)


@dataclass(frozen=True)
class _JointProblem:
    """The models' problems, and where the parameters stand: each model's own in turn, then what all share.

    Attributes:
        own: of each model. shared: of all.
        columns: of anchors and biases.
    """

    parts: tuple[RangeProblem, ...]
    part_columns: tuple[Columns, ...]
    own: tuple[slice, ...]
    shared: slice
    columns: Columns

    @property
    def num_ranges(self) -> int:
        return sum(len(part.range_m) for part in self.parts)

    @classmethod
    def of(cls, parts: Sequence[RangeProblem]) -> _JointProblem:
        of_parts = tuple(columns_of(part) for part in parts)
        num_own = [7 if part.frame_is_free else 1 for part in parts]
        ends = np.cumsum(num_own).tolist()
        own = tuple(slice(end - num, end) for num, end in zip(num_own, ends, strict=True))
        first, shift = of_parts[0], ends[-1] - num_own[0]
        anchor, bias = (np.where(where >= 0, where + shift, -1) for where in (first.anchor, first.bias))
        columns = Columns(-1, anchor, bias, first.num + shift)
        return cls(tuple(parts), of_parts, own, slice(ends[-1], columns.num), columns)

    def state_after(self, start: JointState, x: Array) -> JointState:
        states = [
            state_after(part, columns, start.of_model(k), np.concatenate([x[self.own[k]], x[self.shared]]))
            for k, (part, columns) in enumerate(zip(self.parts, self.part_columns, strict=True))
        ]
        similarities = tuple(state.metric_from_model for state in states)
        return JointState(similarities, states[0].anchors_m, states[0].bias_m)

    def residuals(self, start: JointState, x: Array) -> Array:
        state = self.state_after(start, x)
        ranges = [
            (predicted_ranges(part, state.of_model(k)) - part.range_m) / part.stddev_m
            for k, part in enumerate(self.parts)
        ]
        return np.concatenate([*ranges, prior_residuals(self.parts[0], self.columns, state.of_model(0))])

    def jacobian(self, start: JointState, x: Array) -> Array:
        state = self.state_after(start, x)
        blocks = []
        for k, (part, columns) in enumerate(zip(self.parts, self.part_columns, strict=True)):
            alone = range_jacobian(part, columns, start.of_model(k), state.of_model(k))
            block = np.zeros((len(alone), self.columns.num))
            num_own = self.own[k].stop - self.own[k].start
            block[:, self.own[k]], block[:, self.shared] = alone[:, :num_own], alone[:, num_own:]
            blocks.append(block)
        priors = prior_jacobian(self.parts[0], self.columns, start.of_model(0), state.of_model(0))
        return np.concatenate([*blocks, priors])

    def covariance(self, state: JointState) -> Array:
        """With the robust weights; what is open counts as open, not as certain."""
        x = np.zeros(self.columns.num)
        jacobian, residuals = self.jacobian(state, x), self.residuals(state, x)
        weights = np.ones(len(residuals))
        weights[: self.num_ranges] = CAUCHY.weights(residuals[: self.num_ranges])
        return invert_information((jacobian * weights[:, None]).T @ jacobian)

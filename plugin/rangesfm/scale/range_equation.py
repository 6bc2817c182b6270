"""The range equation and its robust least squares solution.

    predicted = || scale * R c + t + R r - a || + b

c: camera centre in the model's unit; r: lever arm turned into the model's world, metres;
R, t, scale: metric world from model world; a: anchor; b: range bias of the anchor.
This is the model of Lee, Zhu, Giorgi and Günther (2018) with a bias and an anchor that may
be unknown; the lever arm is metric and so never scaled.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from rangesfm.distances.ends import LocatedDistances
from rangesfm.geometry.gravity import Gravity
from rangesfm.geometry.similarity import Similarity
from rangesfm.ranging.errors.noise import bias_whitening
from rangesfm.ranging.errors.robust_loss import CAUCHY, RobustLoss
from rangesfm.scale.distance_equation import distance_jacobian, distance_residuals

Array = npt.NDArray[np.float64]

_TINY_DISTANCE_M = 1e-9


@dataclass(frozen=True)
class RangeProblem:
    """n ranges to m anchors, and what is known beforehand.

    Attributes:
        centers: (n, 3) camera centres, model units.
        tag_from_center: (n, 3) lever arms turned into the model's world, metres.
        anchor_index: (n,) into the anchors.
        range_m: (n,) measured.
        stddev_m: (n,) noise.
        anchor_mean_m: (m, 3) prior positions in the metric world; NaN where unknown.
        anchor_stddev_m: (m,) of the prior; 0: exact, inf: unknown.
        bias_mean_m, bias_stddev_m: (m,) prior of each bias; stddev 0 fixes it.
        common_bias_stddev_m: prior of what all (free) biases share, the tag's own delay.
        frame_is_free: whether rotation and translation are estimated, or stay as started.
        gravity: the upward direction, where somebody told it and the frame is free; None otherwise.
        distances: taped ones that are to be kept to; their anchors are indices as ``anchor_index``.
        share: (n,) by how much each range counts beside its noise, as ranges from one place err alike; None: 1.
    """

    centers: Array
    tag_from_center: Array
    anchor_index: npt.NDArray[np.int64]
    range_m: Array
    stddev_m: Array
    anchor_mean_m: Array
    anchor_stddev_m: Array
    bias_mean_m: Array
    bias_stddev_m: Array
    common_bias_stddev_m: float
    frame_is_free: bool
    distances: LocatedDistances | None = None
    gravity: Gravity | None = None
    share: Array | None = None

    @property
    def share_or_1(self) -> Array:
        """(n,)"""
        return np.ones(len(self.range_m)) if self.share is None else self.share

    @property
    def num_anchors(self) -> int:
        return len(self.anchor_stddev_m)

    def subset(self, rows: npt.NDArray[np.int64]) -> RangeProblem:
        """The same problem with some of its ranges."""
        return replace(
            self,
            centers=self.centers[rows],
            tag_from_center=self.tag_from_center[rows],
            anchor_index=self.anchor_index[rows],
            range_m=self.range_m[rows],
            stddev_m=self.stddev_m[rows],
            share=None if self.share is None else self.share[rows],
        )


@dataclass(frozen=True)
class RangeState:
    """Values of all unknowns of a RangeProblem."""

    metric_from_model: Similarity
    anchors_m: Array
    bias_m: Array


@dataclass(frozen=True)
class RangeFit:
    """A solution.

    Attributes:
        state: the estimate.
        residuals_m: (n,) predicted minus measured.
        weights: (n,) of the robust loss, 1 for a range that fits.
        pulls: (n,) the same times the ranges' shares.
        curvatures: (n,) its second derivative times the shares; negative for outliers.
        cost: half the robust sum of squares, priors included.
        information: (p, p) Gauss-Newton approximation with the robust weights, in ``free``'s parameters.
        gradients: (n, p) of each range's weighted residual, for resampling.
        prior_information: (p, p) the part of ``information`` that comes from priors.
        scaled_residuals: (n,) residuals in stddevs.
        prior_gradient: (p,) of the priors at the estimate.
        columns: which of the p parameters is what; the first is the logarithm of the scale.
    """

    state: RangeState
    residuals_m: Array
    weights: Array
    pulls: Array
    curvatures: Array
    cost: float
    information: Array
    gradients: Array
    scaled_residuals: Array
    prior_information: Array
    prior_gradient: Array
    columns: Columns

    @property
    def log_scale_stddev(self) -> float:
        """Formal stddev of the logarithm of the scale, which is its relative error."""
        return float(np.sqrt(self.covariance[0, 0]))

    @property
    def covariance(self) -> Array:
        """(p, p); directions that nothing determines count as infinitely uncertain, not as certain."""
        return invert_information(self.information)

    def anchor_covariance_m2(self) -> Array:
        """(m, 3, 3) formal covariance of each anchor; 0 of one that is not estimated."""
        covariance, columns = self.covariance, self.columns
        of_anchors = np.zeros((len(self.state.anchors_m), 3, 3))
        for k, column in enumerate(columns.anchor):
            if column >= 0:
                of_anchors[k] = covariance[column : column + 3, column : column + 3]
        return of_anchors


@dataclass(frozen=True)
class Columns:
    """Where each unknown stands in the parameter vector; -1: not estimated.

    First the logarithm of the scale, then the frame (6), the anchors (3 each), the biases.
    """

    frame: int
    anchor: npt.NDArray[np.int64]
    bias: npt.NDArray[np.int64]
    num: int


def columns_of(problem: RangeProblem) -> Columns:
    """Of all that a problem leaves open."""
    next_column = 1 + (6 if problem.frame_is_free else 0)
    anchor = np.full(problem.num_anchors, -1, dtype=np.int64)
    bias = np.full(problem.num_anchors, -1, dtype=np.int64)
    for k in range(problem.num_anchors):
        if problem.anchor_stddev_m[k] > 0:
            anchor[k], next_column = next_column, next_column + 3
    for k in range(problem.num_anchors):
        if problem.bias_stddev_m[k] > 0:
            bias[k], next_column = next_column, next_column + 1
    return Columns(1 if problem.frame_is_free else -1, anchor, bias, next_column)


def tag_positions(problem: RangeProblem, metric_from_model: Similarity) -> Array:
    """(n, 3) antenna in the metric world."""
    turned: Array = problem.tag_from_center @ metric_from_model.rotation.T
    return metric_from_model.apply(problem.centers) + turned


def directions_to_tag(problem: RangeProblem, state: RangeState) -> Array:
    """(n, 3) unit vectors from anchor to tag in the metric world; zero where one lies on the other."""
    from_anchor = tag_positions(problem, state.metric_from_model) - state.anchors_m[problem.anchor_index]
    directions: Array = from_anchor / np.maximum(np.linalg.norm(from_anchor, axis=1), _TINY_DISTANCE_M)[:, None]
    return directions


def predicted_ranges(problem: RangeProblem, state: RangeState) -> Array:
    """(n,) metres."""
    difference = tag_positions(problem, state.metric_from_model) - state.anchors_m[problem.anchor_index]
    predicted: Array = np.linalg.norm(difference, axis=1) + state.bias_m[problem.anchor_index]
    return predicted


def solve(
    problem: RangeProblem,
    start: RangeState,
    *,
    loss: RobustLoss = CAUCHY,
    tolerance: float = 1e-12,
    max_num_evaluations: int = 100,
) -> RangeFit:
    """Robust least squares from a start, by scipy's trust region solver with an analytic Jacobian.

    Args:
        loss: of the ranges.
        tolerance: relative change of cost and of parameters at which it stops.
    """
    columns = columns_of(problem)
    num_ranges = len(problem.range_m)

    def rho_with_derivatives(z: Array) -> Array:
        # Priors are believed as they are; only ranges have outliers.
        rho = np.stack([z, np.ones_like(z), np.zeros_like(z)])
        rho[:, :num_ranges] = problem.share_or_1 * loss.rho(z[:num_ranges])
        return rho

    def residuals(x: Array) -> Array:
        state = state_after(problem, columns, start, x)
        ranges = (predicted_ranges(problem, state) - problem.range_m) / problem.stddev_m
        return np.concatenate([ranges, prior_residuals(problem, columns, state)])

    def jacobian(x: Array) -> Array:
        state = state_after(problem, columns, start, x)
        return np.concatenate(
            [range_jacobian(problem, columns, start, state), prior_jacobian(problem, columns, start, state)]
        )

    result = least_squares(
        residuals,
        np.zeros(columns.num),
        jac=jacobian,
        loss=rho_with_derivatives,
        x_scale="jac",
        method="trf",
        ftol=tolerance,
        xtol=tolerance,
        gtol=None,
        max_nfev=max_num_evaluations,
    )
    return _fit(problem, columns, start, state_after(problem, columns, start, result.x), float(result.cost), loss)


def _fit(
    problem: RangeProblem, columns: Columns, start: RangeState, state: RangeState, cost: float, loss: RobustLoss
) -> RangeFit:
    residuals_m = predicted_ranges(problem, state) - problem.range_m
    scaled = residuals_m / problem.stddev_m
    weights = loss.weights(scaled)
    pulls = problem.share_or_1 * weights
    jacobian = range_jacobian(problem, columns, start, state)
    of_priors = prior_jacobian(problem, columns, start, state)
    prior_information = of_priors.T @ of_priors
    return RangeFit(
        state=state,
        residuals_m=residuals_m,
        weights=weights,
        pulls=pulls,
        curvatures=problem.share_or_1 * loss.curvatures(scaled),
        cost=cost,
        information=(jacobian * pulls[:, None]).T @ jacobian + prior_information,
        gradients=jacobian * pulls[:, None],
        scaled_residuals=scaled,
        prior_information=prior_information,
        prior_gradient=of_priors.T @ prior_residuals(problem, columns, state),
        columns=columns,
    )


def state_after(problem: RangeProblem, columns: Columns, start: RangeState, x: Array) -> RangeState:
    """The start moved by a parameter vector (p,)."""
    similarity = start.metric_from_model
    scale = similarity.scale * float(np.exp(np.clip(x[0], -20, 20)))
    rotation, translation = similarity.rotation, similarity.translation
    if columns.frame >= 0:
        rotation = Rotation.from_rotvec(x[1:4]).as_matrix() @ rotation
        translation = translation + x[4:7]
    anchors, bias = start.anchors_m.copy(), start.bias_m.copy()
    for k in range(problem.num_anchors):
        if columns.anchor[k] >= 0:
            anchors[k] += x[columns.anchor[k] : columns.anchor[k] + 3]
        if columns.bias[k] >= 0:
            bias[k] += x[columns.bias[k]]
    return RangeState(Similarity(scale, rotation, translation), anchors, bias)


def range_jacobian(problem: RangeProblem, columns: Columns, start: RangeState, state: RangeState) -> Array:
    """(n, p) of the ranges' residuals in stddevs."""
    similarity, index = state.metric_from_model, problem.anchor_index
    turned_centers = problem.centers @ similarity.rotation.T
    turned_levers = problem.tag_from_center @ similarity.rotation.T
    from_anchor = similarity.scale * turned_centers + similarity.translation + turned_levers - state.anchors_m[index]
    distance = np.linalg.norm(from_anchor, axis=1)
    # On the anchor the distance has no derivative; zero keeps the step finite.
    direction = from_anchor / np.maximum(distance, _TINY_DISTANCE_M)[:, None]
    direction /= problem.stddev_m[:, None]

    jacobian = np.zeros((len(distance), columns.num))
    jacobian[:, 0] = np.sum(direction * similarity.scale * turned_centers, axis=1)
    if columns.frame >= 0:
        arm = similarity.scale * turned_centers + turned_levers
        # The rotation vector is applied before the start's rotation; its derivative away
        # from zero is taken at the current rotation, through the left Jacobian.
        left = _left_jacobian(Rotation.from_matrix(similarity.rotation @ start.metric_from_model.rotation.T))
        jacobian[:, 1:4] = np.cross(arm, direction) @ left
        jacobian[:, 4:7] = direction
    for k in range(problem.num_anchors):
        rows = index == k
        if columns.anchor[k] >= 0:
            jacobian[rows, columns.anchor[k] : columns.anchor[k] + 3] = -direction[rows]
        if columns.bias[k] >= 0:
            jacobian[rows, columns.bias[k]] = 1 / problem.stddev_m[rows]
    return jacobian


def _left_jacobian(rotation: Rotation) -> Array:
    """d Exp(w) = [J dw]x Exp(w). Solà et al., "A micro Lie theory for state estimation in robotics", eq. 145."""
    vector = rotation.as_rotvec()
    angle = float(np.linalg.norm(vector))
    cross = np.array([[0, -vector[2], vector[1]], [vector[2], 0, -vector[0]], [-vector[1], vector[0], 0]])
    if angle < 1e-4:
        series: Array = np.eye(3) + cross / 2 + cross @ cross / 6
        return series
    first, second = (1 - np.cos(angle)) / angle**2, (angle - np.sin(angle)) / angle**3
    closed: Array = np.eye(3) + first * cross + second * cross @ cross
    return closed


def _prior_rows(problem: RangeProblem, columns: Columns) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    anchors = np.flatnonzero((columns.anchor >= 0) & np.isfinite(problem.anchor_stddev_m))
    biases = np.flatnonzero((columns.bias >= 0) & np.isfinite(problem.bias_stddev_m))
    return anchors, biases


def prior_residuals(problem: RangeProblem, columns: Columns, state: RangeState) -> Array:
    """(r,) of anchors, biases, distances and gravity, in stddevs."""
    anchors, biases = _prior_rows(problem, columns)
    off_anchor = (state.anchors_m - problem.anchor_mean_m)[anchors] / problem.anchor_stddev_m[anchors, None]
    off_bias = _bias_whitening(problem, biases) @ (state.bias_m - problem.bias_mean_m)[biases]
    priors = [off_anchor.ravel(), off_bias]
    if problem.distances is not None:
        priors.append(distance_residuals(problem.distances, state.metric_from_model.scale, state.anchors_m))
    if problem.gravity is not None and columns.frame >= 0:
        priors.append(problem.gravity.residuals(state.metric_from_model.rotation))
    return np.concatenate(priors)


def prior_cost(problem: RangeProblem, state: RangeState) -> float:
    """Half the sum of squares of what priors, distances and gravity have against a state."""
    off = prior_residuals(problem, columns_of(problem), state)
    return 0.5 * float(off @ off)


def prior_jacobian(problem: RangeProblem, columns: Columns, start: RangeState, state: RangeState) -> Array:
    """(r, p) of the same."""
    anchors, biases = _prior_rows(problem, columns)
    jacobian = np.zeros((3 * len(anchors) + len(biases), columns.num))
    for row, k in enumerate(anchors):
        for axis in range(3):
            jacobian[3 * row + axis, columns.anchor[k] + axis] = 1 / problem.anchor_stddev_m[k]
    jacobian[3 * len(anchors) :, columns.bias[biases]] = _bias_whitening(problem, biases)
    blocks, similarity = [jacobian], state.metric_from_model
    if problem.distances is not None:
        blocks.append(
            distance_jacobian(problem.distances, similarity.scale, state.anchors_m, columns.anchor, columns.num)
        )
    if problem.gravity is not None and columns.frame >= 0:
        block = np.zeros((3, columns.num))
        left = _left_jacobian(Rotation.from_matrix(similarity.rotation @ start.metric_from_model.rotation.T))
        block[:, 1:4] = problem.gravity.jacobian(similarity.rotation, left)
        blocks.append(block)
    return np.concatenate(blocks)


def _bias_whitening(problem: RangeProblem, biases: npt.NDArray[np.int64]) -> Array:
    return bias_whitening(problem.bias_stddev_m[biases], problem.common_bias_stddev_m)


def invert_information(information: Array) -> Array:
    """Inverse with unit-free conditioning; an undetermined direction gets a huge variance."""
    diagonal = np.sqrt(np.maximum(np.diag(information), 1e-200))
    values, vectors = np.linalg.eigh(information / np.outer(diagonal, diagonal))
    inverse: Array = (vectors / np.maximum(values, 1e-14)) @ vectors.T / np.outer(diagonal, diagonal)
    return inverse

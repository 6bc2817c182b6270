"""The range equation and its robust least squares solution.

    predicted = || scale * R c + t + R r - a || + b

c: camera centre in the model's unit; r: lever arm turned into the model's world, metres;
R, t, scale: metric world from model world; a: anchor position; b: range bias of the anchor.
This is the model of Lee, Zhu, Giorgi and Günther (2018), extended by a bias and by anchors that may be unknown. The
lever arm is metric, so it is never scaled. Several models can share one set of anchors and biases; each has its own
metric world from model world.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from rangesfm.arrays import Array, Indices
from rangesfm.measurements.ranges.anchors.anchor_distances import NO_DISTANCES, AnchorDistances
from rangesfm.measurements.ranges.errors.noise import bias_whitening
from rangesfm.measurements.ranges.range_gradient import RangeGradient
from rangesfm.measurements.ranges.scale.placement_prior import PlacementPrior
from rangesfm.solver.linear_map import Columns
from rangesfm.solver.posterior import ScaleByKind
from rangesfm.util.geometry.gravity import Gravity
from rangesfm.util.geometry.numerics import MAX_NUM_ROUNDS, ROUNDING
from rangesfm.util.geometry.robust_statistics import CAUCHY, SAME_COST, RobustLoss
from rangesfm.util.geometry.rotations import left_jacobians
from rangesfm.util.geometry.similarity import IDENTITY, Similarity

_MAX_NUM_EVALUATIONS = 100
_BY_TURN = np.eye(3)


@dataclass(frozen=True)
class RangeProblem:
    """n ranges to m anchors, and the prior knowledge about them.

    Attributes:
        centers: (n, 3) camera centres, model units.
        tag_from_center: (n, 3) lever arms turned into the model's world, metres.
        anchor_index: (n,) into the anchors.
        range_m: (n,) measured ranges.
        stddev_m: (n,) standard deviation of their noise.
        anchor_mean_m: (m, 3) prior positions in the metric world; NaN where unknown.
        anchor_stddev_m: (m,) of each prior coordinate that is known; 0: exact, inf: all are unknown.
        bias_mean_m, bias_stddev_m: (m,) prior of each bias; standard deviation 0 fixes it.
        common_bias_stddev_m: prior of the bias that all free biases share, such as the tag's own delay.
        frame_is_free: whether rotation and translation are estimated; otherwise they stay as started.
        share: (n,) factor on the cost of each range, below 1 where ranges from one place err alike.
        gravity: the upward direction, if given and the frame is free; None otherwise.
        placement: what known positions say of the frame, if it is free; None without any.
        scales: by other kinds alone, metres per unit of the model, as priors.
        distances: measured ones between anchors to fit; they refer to these by index, like ``anchor_index``.
    """

    centers: Array
    tag_from_center: Array
    anchor_index: Indices
    range_m: Array
    stddev_m: Array
    anchor_mean_m: Array
    anchor_stddev_m: Array
    bias_mean_m: Array
    bias_stddev_m: Array
    common_bias_stddev_m: float
    frame_is_free: bool
    share: Array
    distances: AnchorDistances = NO_DISTANCES
    gravity: Gravity | None = None
    placement: PlacementPrior | None = None
    scales: tuple[ScaleByKind, ...] = ()

    @property
    def num_anchors(self) -> int:
        return len(self.anchor_stddev_m)

    @property
    def has_known_anchors(self) -> bool:
        """Whether any anchor with ranges has a given position."""
        return bool(np.isfinite(self.anchor_stddev_m[self.anchor_index]).any())

    @cached_property
    def uncertain(self) -> tuple[Indices, Indices]:
        """Indices of the anchors, and of the biases, whose prior is neither exact nor unknown."""
        anchors, biases = (np.flatnonzero((s > 0) & np.isfinite(s)) for s in (self.anchor_stddev_m, self.bias_stddev_m))
        return anchors, biases

    @cached_property
    def bias_whitening(self) -> Array:
        """``noise.bias_whitening`` of the uncertain biases; cached because every step of a solve needs it."""
        return bias_whitening(self.bias_stddev_m[self.uncertain[1]], self.common_bias_stddev_m)

    def subset(self, rows: Indices) -> RangeProblem:
        """Return the problem with some of its ranges."""
        return replace(
            self,
            centers=self.centers[rows],
            tag_from_center=self.tag_from_center[rows],
            anchor_index=self.anchor_index[rows],
            range_m=self.range_m[rows],
            stddev_m=self.stddev_m[rows],
            share=self.share[rows],
        )

    def by_some(self, rows: Indices) -> RangeProblem:
        """Return the problem with some of its ranges, reweighted to stand for all ranges of their anchors.

        Args:
            rows: at least one range of each anchor.
        """
        part = self.subset(rows)
        num, taken = (np.bincount(each.anchor_index, minlength=self.num_anchors) for each in (self, part))
        return replace(part, share=part.share * (num / np.maximum(taken, 1))[part.anchor_index])

    def without_others(self) -> RangeProblem:
        """Return the problem without what other kinds say of the map.

        It helps to solve it, and they are observations of their own beside the ranges.
        """
        return replace(self, placement=None, scales=())

    def of_anchor(self, k: int) -> RangeProblem:
        """Return the problem of the ranges to anchor k alone, with a fixed frame."""
        part, one = self.subset(np.flatnonzero(self.anchor_index == k)), slice(k, k + 1)
        return replace(
            part,
            anchor_index=np.zeros(len(part.range_m), dtype=np.int64),
            anchor_mean_m=self.anchor_mean_m[one],
            anchor_stddev_m=self.anchor_stddev_m[one],
            bias_mean_m=self.bias_mean_m[one],
            bias_stddev_m=self.bias_stddev_m[one],
            frame_is_free=False,
            distances=NO_DISTANCES,
            scales=(),
        )


@dataclass(frozen=True)
class RangeState:
    """Values of all unknowns of a RangeProblem.

    Attributes:
        metric_from_model: of the model; of the first one if there are several.
        anchors_m: (m, 3). bias_m: (m,).
        others: metric_from_model of the further models.
    """

    metric_from_model: Similarity
    anchors_m: Array
    bias_m: Array
    others: tuple[Similarity, ...] = ()

    @property
    def similarities(self) -> tuple[Similarity, ...]:
        """The metric_from_model of each model."""
        return self.metric_from_model, *self.others

    def in_frame_of_model(self) -> RangeState:
        """Return the state of one model carried into the frame of that model, in metres."""
        placed = self.metric_from_model
        anchors_m = replace(placed, scale=1.0).inverse().apply(self.anchors_m)
        return RangeState(replace(IDENTITY, scale=placed.scale), anchors_m, self.bias_m)

    @property
    def of_models(self) -> tuple[RangeState, ...]:
        """The state of each model, as a state of one model."""
        return tuple(RangeState(each, self.anchors_m, self.bias_m) for each in self.similarities)


@dataclass(frozen=True)
class RangeFit:
    """A solution of a RangeProblem; with several models, the n ranges are those of each model in turn.

    Attributes:
        state: the estimate.
        weights: (n,) of the robust loss; 1 for a range that fits.
        cost: half the robust sum of squares, priors included.
        information: (p, p) Gauss-Newton approximation with the robust weights, in the parameters of ``columns``.
        columns: for each model, which of the p parameters is what; the very first is the logarithm of the scale.
    """

    state: RangeState
    weights: Array
    cost: float
    information: Array
    columns: tuple[Columns, ...]

    @property
    def log_scale_stddev(self) -> float:
        """Formal standard deviation of the logarithm of the scale, which is the scale's relative error."""
        return float(np.sqrt(self.covariance[0, 0]))

    @property
    def covariance(self) -> Array:
        """(p, p) formal covariance; undetermined directions get a huge variance."""
        # Scaled by the diagonal, so that the rule does not depend on units.
        diagonal = np.sqrt(np.maximum(np.diag(self.information), 1e-200))
        values, vectors = np.linalg.eigh(self.information / np.outer(diagonal, diagonal))
        return np.asarray((vectors / np.maximum(values, 1e-14)) @ vectors.T / np.outer(diagonal, diagonal))


def columns_of(parts: Sequence[RangeProblem]) -> tuple[Columns, ...]:
    """Return the columns of all unknowns of one problem, or of the joint problem of several models."""
    of_own, next_column = [], 0
    for part in parts:
        of_own.append((next_column, next_column + 1 if part.frame_is_free else -1))
        next_column += 7 if part.frame_is_free else 1
    anchor = np.full(parts[0].num_anchors, -1, dtype=np.int64)
    bias = anchor.copy()
    for k in np.flatnonzero(parts[0].anchor_stddev_m > 0):
        anchor[k], next_column = next_column, next_column + 3
    for k in np.flatnonzero(parts[0].bias_stddev_m > 0):
        bias[k], next_column = next_column, next_column + 1
    return tuple(Columns(scale, frame, anchor, bias, next_column) for scale, frame in of_own)


def antenna_positions(problem: RangeProblem, metric_from_model: Similarity) -> Array:
    """Return the (n, 3) antenna positions in the metric world."""
    turned: Array = problem.tag_from_center @ metric_from_model.rotation.T
    return metric_from_model.apply(problem.centers) + turned


def range_gradient(problem: RangeProblem, state: RangeState) -> RangeGradient:
    """Return the n distances between antenna and anchor, with their derivatives."""
    tags = antenna_positions(problem, state.metric_from_model)
    return RangeGradient.of(tags - state.anchors_m[problem.anchor_index])


def predicted_ranges(problem: RangeProblem, state: RangeState) -> Array:
    """Return the (n,) predicted ranges, biases included, in metres."""
    return range_gradient(problem, state).distance_m + state.bias_m[problem.anchor_index]


def solve(
    problem: RangeProblem,
    start: RangeState,
    *,
    others: Sequence[RangeProblem] = (),
    loss: RobustLoss = CAUCHY,
    tolerance: float = ROUNDING,
) -> RangeFit:
    """Solve by robust least squares, with scipy's trust region solver and an analytic Jacobian.

    Args:
        others: problems of further models, each in its own unit and with its own ``frame_is_free``. Anchors, biases
            and all priors are taken from the first problem.
        start: initial values; an anchor without a position must have no ranges.
        loss: robust loss of the ranges.
        tolerance: relative change of cost and of parameters at which the solver stops. Candidates to choose among need
            not be at the very minimum.
    """
    columns = columns_of((problem, *others))
    system = _System((problem, *others), columns, start, loss)
    result = least_squares(
        lambda y: np.concatenate(system.residuals(system.state_after(y))),
        np.zeros(columns[0].num),
        jac=lambda y: np.concatenate(system.jacobian(system.state_after(y))),
        loss=system.rho_with_derivatives,
        x_scale="jac",
        method="trf",
        ftol=tolerance,
        xtol=tolerance,
        # Only a start at the very minimum is below this; without it, the solver would divide zero by zero there.
        gtol=float(np.finfo(np.float64).eps),
        max_nfev=_MAX_NUM_EVALUATIONS,
    )
    y = _settled(system, result.x) if tolerance <= ROUNDING else result.x
    return system.fit(system.state_after(y), float(result.cost))


def cost_at(problem: RangeProblem, state: RangeState, loss: RobustLoss = CAUCHY) -> float:
    """Return half the robust sum of squares at a state, priors included."""
    scaled = (predicted_ranges(problem, state) - problem.range_m) / problem.stddev_m
    return 0.5 * float(problem.share @ loss.rho(scaled**2)[0]) + prior_cost(problem, state)


def fit_at(problem: RangeProblem, state: RangeState, weights: Array) -> RangeFit:
    """Return the fit that would end at this state, without solving.

    Args:
        weights: (n,) robust weights; larger than 1 for a range that stands for several.
    """
    columns = columns_of((problem,))
    return _System((problem,), columns, state, CAUCHY).fit(state, 0.0, weights)


def _settled(system: _System, y: Array) -> Array:
    """Move to the exact minimum by Newton steps that use the gradient alone.

    The trust region stops where rounding hides the decrease of the cost, some 1e-9 from the minimum. On which side it
    stops depends on the last digit of the input. A step is measured by the decrease of the cost that is expected of it,
    which is squared standard deviations of the parameters. Where a step promises more than the solver's tolerance, the
    solver has not converged, and its result is left as it is.
    """
    for _ in range(MAX_NUM_ROUNDS):
        gradient, curvature = system.slope(system.state_after(y))
        step = np.linalg.lstsq(curvature, gradient, rcond=ROUNDING)[0]
        gain = float(gradient @ step)
        if not ROUNDING**2 < gain < SAME_COST:
            break
        y = y - step
    return y


@dataclass(frozen=True)
class _System:
    """Residuals and derivatives of one problem, or of the joint problem of several models, as functions of a state."""

    parts: tuple[RangeProblem, ...]
    columns: tuple[Columns, ...]
    start: RangeState
    loss: RobustLoss

    def state_after(self, x: Array) -> RangeState:
        """Return the start moved by a parameter vector (p,)."""
        return state_after(self.columns, self.start, x)

    @property
    def share(self) -> Array:
        return np.concatenate([part.share for part in self.parts])

    def rho_with_derivatives(self, z: Array) -> Array:
        # Priors have no robust loss: only ranges have outliers.
        rho = np.stack([z, np.ones_like(z), np.zeros_like(z)])
        share = self.share
        rho[:, : len(share)] = share * self.loss.rho(z[: len(share)])
        return rho

    def residuals(self, state: RangeState) -> tuple[Array, Array]:
        """Return the residuals of ranges and of priors, in standard deviations."""
        of_parts = zip(self.parts, state.of_models, strict=True)
        ranges = [(predicted_ranges(part, own) - part.range_m) / part.stddev_m for part, own in of_parts]
        return np.concatenate(ranges), prior_residuals(self.parts[0], self.columns[0], state)

    def jacobian(self, state: RangeState) -> tuple[Array, Array]:
        """Return the Jacobians of the residuals of ranges and of priors by a parameter vector, which is 0 at the start.

        A rotation vector acts on the left of the start's rotation, so away from zero its derivative needs the left
        Jacobian of SO(3).
        """
        both = zip(self.start.similarities, state.similarities, strict=True)
        turned = [Rotation.from_matrix(now.rotation @ before.rotation.T).as_rotvec() for before, now in both]
        by_turns = [left_jacobians(each) for each in turned]
        of_parts = zip(self.parts, self.columns, state.of_models, by_turns, strict=True)
        priors = prior_jacobian(self.parts[0], self.columns[0], state, by_turns[0])
        return np.concatenate([range_jacobian(*each) for each in of_parts]), priors

    def slope(self, state: RangeState) -> tuple[Array, Array]:
        """Return the (p,) gradient and the (p, p) curvature of the cost.

        As in scipy, a range beyond the inflection point of the loss adds no curvature.
        """
        (scaled, off_priors), (jacobian, of_priors) = self.residuals(state), self.jacobian(state)
        _, first, second = self.rho_with_derivatives(scaled**2)
        curvature = (jacobian * np.maximum(first + 2 * second * scaled**2, 0.0)[:, None]).T @ jacobian
        gradient = jacobian.T @ (first * scaled) + of_priors.T @ off_priors
        return gradient, curvature + of_priors.T @ of_priors

    def fit(self, state: RangeState, cost: float, weights: Array | None = None) -> RangeFit:
        """Return the fit at a state; ``weights``: (n,), or None to take them from the loss."""
        (scaled, _), (jacobian, of_priors) = self.residuals(state), self.jacobian(state)
        weights = self.loss.weights(scaled) if weights is None else weights
        weighted = jacobian * (self.share * weights)[:, None]
        return RangeFit(
            state=state,
            weights=weights,
            cost=cost,
            information=weighted.T @ jacobian + of_priors.T @ of_priors,
            columns=self.columns,
        )


def state_after(columns: Sequence[Columns], start: RangeState, x: Array) -> RangeState:
    """Return the start moved by a parameter vector (p,)."""
    anchors, bias = start.anchors_m.copy(), start.bias_m.copy()
    first, *others = (
        _moved(own.metric_from_model, each, x) for each, own in zip(columns, start.of_models, strict=True)
    )
    for k, (anchor, own_bias) in enumerate(zip(columns[0].anchor, columns[0].bias, strict=True)):
        if anchor >= 0:
            anchors[k] += x[anchor : anchor + 3]
        if own_bias >= 0:
            bias[k] += x[own_bias]
    return RangeState(first, anchors, bias, tuple(others))


def _moved(similarity: Similarity, columns: Columns, x: Array) -> Similarity:
    scale = similarity.scale * float(np.exp(np.clip(x[columns.scale], -20, 20)))
    if columns.frame < 0:
        return replace(similarity, scale=scale)
    turn, shift = x[columns.frame : columns.frame + 6].reshape(2, 3)
    rotation = Rotation.from_rotvec(turn).as_matrix() @ similarity.rotation
    return Similarity(scale, rotation, similarity.translation + shift)


def range_jacobian(problem: RangeProblem, columns: Columns, state: RangeState, by_turn: Array = _BY_TURN) -> Array:
    """Return the (n, p) Jacobian of the residuals of one model's ranges, in standard deviations.

    Args:
        by_turn: (3, 3) derivatives of a turn of the world by the rotation vector among the parameters.
    """
    similarity, index = state.metric_from_model, problem.anchor_index
    grown = similarity.scale * problem.centers @ similarity.rotation.T
    by = range_gradient(problem, state)
    jacobian = np.zeros((len(index), columns.num))
    jacobian[:, columns.scale] = by.by_log_scale(grown)
    if columns.frame >= 0:
        arms = grown + problem.tag_from_center @ similarity.rotation.T
        jacobian[:, columns.frame : columns.frame + 3] = by.by_turn_of_world(arms) @ by_turn
        jacobian[:, columns.frame + 3 : columns.frame + 6] = by.by_tag
    rows = np.flatnonzero(columns.anchor[index] >= 0)
    jacobian[rows[:, None], columns.anchor[index[rows], None] + np.arange(3)] = by.by_anchor[rows]
    rows = np.flatnonzero(columns.bias[index] >= 0)
    jacobian[rows, columns.bias[index[rows]]] = 1.0
    jacobian /= problem.stddev_m[:, None]
    return jacobian


def prior_residuals(problem: RangeProblem, columns: Columns, state: RangeState) -> Array:
    """Return the (r,) residuals of anchors, biases, scales, distances, gravity and placement, in stddevs."""
    anchors, biases = problem.uncertain
    off_anchor = (state.anchors_m - problem.anchor_mean_m)[anchors] / problem.anchor_stddev_m[anchors, None]
    off_anchor = off_anchor[~np.isnan(off_anchor)]
    off_bias = problem.bias_whitening @ (state.bias_m - problem.bias_mean_m)[biases]
    off_scale = [(state.metric_from_model.scale - each.value) / each.stddev for each in problem.scales]
    priors = [off_anchor, off_bias, np.array(off_scale), problem.distances.residuals(state.anchors_m)]
    if problem.gravity is not None and columns.frame >= 0:
        priors.append(problem.gravity.residuals(state.metric_from_model.rotation))
    if problem.placement is not None and columns.frame >= 0:
        priors.append(problem.placement.residuals(state.metric_from_model))
    return np.concatenate(priors)


def prior_cost(problem: RangeProblem, state: RangeState) -> float:
    """Return half the sum of squares of ``prior_residuals``."""
    off = prior_residuals(problem, columns_of([problem])[0], state)
    return 0.5 * float(off @ off)


def prior_jacobian(problem: RangeProblem, columns: Columns, state: RangeState, by_turn: Array = _BY_TURN) -> Array:
    """Return the (r, p) Jacobian of ``prior_residuals``; arguments as of ``range_jacobian``."""
    anchors, biases = problem.uncertain
    known, axis = np.nonzero(~np.isnan(problem.anchor_mean_m[anchors]))
    jacobian = np.zeros((len(known) + len(biases), columns.num))
    column = columns.anchor[anchors[known]] + axis
    jacobian[np.arange(len(known)), column] = 1 / problem.anchor_stddev_m[anchors[known]]
    jacobian[len(known) :, columns.bias[biases]] = problem.bias_whitening
    similarity = state.metric_from_model
    by_scale = np.zeros((len(problem.scales), columns.num))
    by_scale[:, columns.scale] = [similarity.scale / each.stddev for each in problem.scales]
    blocks = [jacobian, by_scale, problem.distances.jacobian(state.anchors_m, columns.anchor, columns.num)]
    if problem.gravity is not None and columns.frame >= 0:
        block = np.zeros((3, columns.num))
        turn = problem.gravity.jacobian(similarity.rotation, by_turn)
        block[:, columns.frame : columns.frame + 3] = turn
        blocks.append(block)
    if problem.placement is not None and columns.frame >= 0:
        block = np.zeros((7, columns.num))
        block[:, columns.of_map] = problem.placement.jacobian(similarity, by_turn)
        blocks.append(block)
    return np.concatenate(blocks)

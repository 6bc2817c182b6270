"""The keyframe graph: poses constrained by the photos' information about neighbours, and by ranges.

It is the joint problem with the points eliminated once, stated so that bending a map costs only its local deformation.
Solved before the full bundle adjustment, it removes drift in cheap steps. The full problem needs many steps for this,
because its points have to follow every turn of the world.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy import sparse
from scipy.spatial.transform import Rotation

from rangesfm.arrays import Array, Indices, Mask
from rangesfm.ceres.linear_solver import factor, normal_matrix, resized
from rangesfm.ceres.nested_dissection import NestedFactor, SingularError
from rangesfm.geometry.gravity import Gravity
from rangesfm.geometry.numerics import MAX_NUM_ROUNDS, ROUNDING
from rangesfm.geometry.rotations import cross_matrices
from rangesfm.geometry.similarity import rounding_of
from rangesfm.geometry.trajectory import Trajectory
from rangesfm.ranging.anchors.anchor import AnchorEstimate
from rangesfm.ranging.errors.bending import BendingOfBins, bending_part, without_similarity
from rangesfm.ranging.errors.range_errors import RangeErrors
from rangesfm.ranging.range_gradient import RangeGradient
from rangesfm.refine.bundle_adjustment import farthest, still_to_come
from rangesfm.refine.radio import Antennas
from rangesfm.refine.vision_information import Poses, VisionInformation, relative_poses

_INITIAL_DAMPING = 1e-8
_MAX_DAMPING = 1e6
# Number of random vectors for the estimated trace (number of parameters that the ranges determine).
_NUM_PROBES = 12


@dataclass(frozen=True)
class GraphState:
    """Values of all unknowns.

    Attributes:
        poses: of n keyframes.
        anchors_m: (m, 3). biases_m: (m,).
        common_bias_m: change of the prior mean that all free biases share.
    """

    poses: Poses
    anchors_m: Array
    biases_m: Array
    common_bias_m: float


@dataclass(frozen=True)
class KeyframeGraph:
    """The least squares problem.

    Attributes:
        vision: information from the photos.
        antennas: of the k ranges that take part, by indices of the graph's keyframes.
        range_m: (k,) measured. errors: of these ranges.
        anchors: m, with priors as for ``refine_with_ranges``.
        held_frame: index of a keyframe that is held fixed; None: none is.
        gravity: the upward direction in the first keyframe; None if unknown.
    """

    vision: VisionInformation
    antennas: Antennas
    range_m: Array
    errors: RangeErrors
    anchors: tuple[AnchorEstimate, ...]
    held_frame: int | None
    gravity: Gravity | None

    def start(self) -> GraphState:
        """Return the map as it was given."""
        positions = np.array([anchor.position_m for anchor in self.anchors])
        biases = np.array([anchor.range_bias_m for anchor in self.anchors])
        return GraphState(self.vision.origin, positions, biases, 0.0)

    def residuals_m(self, state: GraphState) -> Array:
        """Return the (k,) residuals, predicted minus measured, metres."""
        return self.ranges_at(state)[0]

    def ranges_at(self, state: GraphState) -> tuple[Array, RangeGradient]:
        """Return ``residuals_m``, and the derivatives of the k distances."""
        index = self.errors.anchor_index
        at = self.antennas.positions(state.poses.centers, state.poses.world_from_rig)
        gradient = RangeGradient.of(at - state.anchors_m[index])
        return gradient.distance_m + state.biases_m[index] - self.range_m, gradient


@dataclass(frozen=True)
class GraphSolution:
    """The solution of a keyframe graph.

    Attributes:
        state: the estimate. num_steps: accepted and rejected ones.
        num_absorbed: degrees of freedom of the ranges that the parameters absorb, at the start of the last step.
    """

    state: GraphState
    num_steps: int
    num_absorbed: float


def solve_graph(graph: KeyframeGraph, start: GraphState, *, tolerance_m: float) -> GraphSolution:
    """Solve the graph by Levenberg-Marquardt steps.

    Args:
        tolerance_m: the solver stops when no keyframe moves further in a successful step, or in all steps to come.
    """
    layout = _Layout.of(graph)
    state, damping = start, _INITIAL_DAMPING
    terms = solved = _Terms.at(graph, layout, state)
    factored, used, step_count, movement = None, damping, 0, 0.0
    while step_count < MAX_NUM_ROUNDS and damping < _MAX_DAMPING:
        step_count += 1
        solved, used, factored = terms, damping, _factor(terms.hessian_of_free, damping, layout.blocks)
        step = factored.solve(-terms.gradient[layout.free])
        trial = _moved(state, layout, step)
        trial_terms = _Terms.at(graph, layout, trial)
        if not trial_terms.cost < terms.cost:
            damping *= 10
            continue
        last, movement = movement, farthest(trial.poses.centers, state.poses.centers)
        state, terms, damping = trial, trial_terms, max(damping / 10, ROUNDING)
        if min(movement, still_to_come(movement, last)) < tolerance_m:
            break
    if factored is None or used > _INITIAL_DAMPING:  # more would hide what the ranges determine
        factored = _factor(solved.hessian_of_free, 0.0, layout.blocks)
    return GraphSolution(state, step_count, _num_absorbed(solved, factored))


@dataclass(frozen=True)
class GraphBending:
    """Bending of a map as the photos' information on relative poses allows it.

    Attributes:
        vision: of a map with the same poses, in any world. path: of the map, in its first camera's frame.
    """

    vision: VisionInformation
    path: Trajectory

    def of_functions(self, by_pose: Array, *, frame_is_free: bool) -> BendingOfBins:
        functions = without_similarity(by_pose, self.path, frame_is_free=frame_is_free)
        parts = functions.reshape(len(by_pose), -1, 6)
        parts[:, :, 3:] = parts[:, :, 3:] @ self.vision.origin.world_from_rig[0].T
        covariance = functions @ self._factored.solve(np.ascontiguousarray(functions.T))
        found = bending_part("bending", covariance, 1.0, 0.0)
        return BendingOfBins(() if found is None else (found,), covariance, np.zeros(len(by_pose)))

    @cached_property
    def _factored(self) -> NestedFactor:
        return _photos_alone(self.vision)[0]


def with_gradient(vision: VisionInformation, gradient: Array) -> VisionInformation:
    """Return the information with the gradient (6 n,) of the photos' cost at its origin, where they need not fit best.

    In a map that was bent to its ranges they do not. The gradient has to be that of all observations: those of a part
    of the tracks, or with other weights, have their minimum elsewhere.
    """
    factored, by_pose = _photos_alone(vision)
    return replace(vision, from_optimum=by_pose @ factored.solve(gradient))


def _photos_alone(vision: VisionInformation) -> tuple[NestedFactor, sparse.bsr_array]:
    """Return the factor of the photos' normal equations of n poses, and the relative poses' derivatives by these."""
    _, by_pose = _relative_poses(vision, vision.origin)
    num = len(vision.origin)
    blocks = 6 * np.arange(num + 1), np.zeros(num, dtype=bool)
    return _factor(resized(normal_matrix(by_pose, vision.matrix), 6 * num), 0.0, blocks), by_pose


@dataclass(frozen=True)
class _Layout:
    """Order of the unknowns: 6 per pose (turn in its own frame, shift), 3 per anchor, the biases, their common part.

    Attributes:
        first_anchor, first_bias: first columns of these. num: of all columns.
        free: columns that are estimated. world_is_free: whether no keyframe is held fixed.
        of_ranges: (k, 16) columns of each range: two poses, an anchor, its bias.
        order, starts: order of the ranges in which those with the same keyframes and anchor are together, and the first
            of each such group. Their derivatives have the same columns.
    """

    first_anchor: int
    first_bias: int
    num: int
    free: Indices
    world_is_free: bool
    of_ranges: Indices
    order: Indices
    starts: Indices

    @classmethod
    def of(cls, graph: KeyframeGraph) -> _Layout:
        n, m = len(graph.vision.origin), len(graph.anchors)
        first_anchor, first_bias, num = 6 * n, 6 * n + 3 * m, 6 * n + 4 * m + 1
        is_free = np.ones(num, dtype=bool)
        if graph.held_frame is not None:
            is_free[6 * graph.held_frame : 6 * graph.held_frame + 6] = False
        heard = np.isin(np.arange(m), graph.errors.anchor_index)
        anchor_is_free = heard & [anchor.prior_position_stddev_m > 0 for anchor in graph.anchors]
        bias_is_free = heard & [anchor.prior_bias_stddev_m > 0 for anchor in graph.anchors]
        is_free[first_anchor:first_bias] = np.repeat(anchor_is_free, 3)
        is_free[first_bias:-1] = bias_is_free
        is_free[-1] = graph.errors.common_bias_stddev_m > 0 and bool(bias_is_free.any())
        before, after, anchor = graph.antennas.before, graph.antennas.after, graph.errors.anchor_index
        firsts = ((6 * before, 6), (6 * after, 6), (first_anchor + 3 * anchor, 3), (first_bias + anchor, 1))
        of_ranges = np.concatenate([first[:, None] + np.arange(size) for first, size in firsts], axis=1)
        key = (anchor * n + after) * n + before
        order = np.argsort(key, kind="stable")
        starts = np.flatnonzero(np.diff(key[order], prepend=-1))
        world_is_free = graph.held_frame is None
        return cls(first_anchor, first_bias, num, np.flatnonzero(is_free), world_is_free, of_ranges, order, starts)

    @property
    def blocks(self) -> tuple[Indices, Mask]:
        """Return the first free column of each pose, and of all else, and whether it is all else, which comes last."""
        num_of_poses = np.count_nonzero(self.free < self.first_anchor)
        ends = np.union1d(np.arange(0, num_of_poses + 1, 6), len(self.free))
        return ends, ends[1:] > num_of_poses

    def squares(self, rows: sparse.csr_array) -> sparse.coo_array:
        """Return J^T J of the ranges, from dense products within each group of equal columns."""
        values = rows.data.reshape(self.of_ranges.shape)[self.order]
        blocks = np.array([alike.T @ alike for alike in np.split(values, self.starts[1:])])
        column = self.of_ranges[self.order[self.starts]]
        places = np.broadcast_to(column[:, :, None], blocks.shape), np.broadcast_to(column[:, None], blocks.shape)
        return sparse.coo_array((blocks.ravel(), tuple(place.ravel() for place in places)), shape=(self.num, self.num))


@dataclass(frozen=True)
class _Terms:
    """Cost (half the robust sum of squares), gradient and Gauss-Newton Hessian over all columns.

    Attributes:
        seen: derivatives of the relative poses. vision: their information matrix.
        whitened: (k, columns) derivatives of the ranges' residuals, times the roots of the robust weights.
        prior: derivatives of the priors' residuals.
    """

    cost: float
    gradient: Array
    layout: _Layout
    seen: sparse.bsr_array
    vision: sparse.bsr_array
    whitened: sparse.csr_array
    prior: sparse.csr_array

    @classmethod
    def at(cls, graph: KeyframeGraph, layout: _Layout, state: GraphState) -> _Terms:
        residuals, jacobian = _relative_poses(graph.vision, state.poses)
        bound = graph.vision.matrix @ residuals
        cost = 0.5 * float(residuals @ bound)
        gradient = np.zeros(layout.num)
        gradient[: layout.first_anchor] = jacobian.T @ bound

        scaled, derivative = _range_rows(graph, layout, state)
        rho, weights, _ = graph.errors.worth * graph.errors.loss.rho(scaled**2)
        cost += 0.5 * float(rho.sum())
        gradient = gradient + derivative.T @ (weights * scaled)
        derivative.data *= np.repeat(np.sqrt(weights), layout.of_ranges.shape[1])

        off, prior = _prior_rows(graph, layout, state)
        cost += 0.5 * float(off @ off)
        gradient = gradient + prior.T @ off
        return cls(cost, gradient, layout, jacobian, graph.vision.matrix, derivative, prior)

    @cached_property
    def hessian(self) -> Array | sparse.csr_array:
        """Gauss-Newton Hessian; computed only for states from which a step is taken."""
        of_photos = resized(normal_matrix(self.seen, self.vision), self.layout.num)
        return of_photos + self.layout.squares(self.whitened) + self.prior.T @ self.prior

    @property
    def hessian_of_free(self) -> Array | sparse.csr_array:
        return self.hessian[self.layout.free][:, self.layout.free]


def _relative_poses(vision: VisionInformation, poses: Poses) -> tuple[Array, sparse.bsr_array]:
    """Return (6 u,) turns and shifts of relative poses against their origin, in the reference's frame, with derivative.

    The derivative is by the n poses, in blocks of 6 by 6, whose products are several times faster than of single
    numbers. Shifts are divided by the local scale of the map around the reference, because photos do not see that
    scale.
    """
    r, k = vision.reference, vision.frame
    turn, shift = relative_poses(poses, r, k)
    turn_before, shift_before = vision.measured()
    scale = _local_scale(vision, shift, shift_before)[r][:, None]
    angles = Rotation.from_matrix(np.swapaxes(turn_before, 1, 2) @ turn).as_rotvec()
    residuals = np.concatenate([angles, shift / scale - shift_before], axis=1).ravel() + vision.from_optimum
    # d log(Exp(a) Exp(d)) to first order in a: Solà et al., "A micro Lie theory", eq. 144.
    spread = np.eye(3) + 0.5 * cross_matrices(angles)
    to_reference, to_frame = np.zeros((2, len(r), 6, 6))
    to_frame[:, :3, :3] = spread
    to_reference[:, :3, :3] = -spread @ np.swapaxes(turn, 1, 2)
    to_frame[:, 3:, 3:] = np.swapaxes(poses.world_from_rig[r], 1, 2) / scale[:, :, None]
    to_reference[:, 3:, 3:] = -to_frame[:, 3:, 3:]
    to_reference[:, 3:, :3] = cross_matrices(shift) / scale[:, :, None]
    blocks = np.stack([to_reference, to_frame], axis=1).reshape(-1, 6, 6)
    columns, starts = np.stack([r, k], axis=1).ravel(), np.arange(0, 2 * len(r) + 1, 2)
    return residuals, sparse.bsr_array((blocks, columns, starts), shape=(6 * len(r), 6 * len(poses)))


def _local_scale(vision: VisionInformation, shift: Array, shift_before: Array) -> Array:
    """Return the (n,) growth of the map around each keyframe, where loops do not count."""
    n, near = len(vision.origin), slice(vision.num_from_points)
    now = np.bincount(vision.reference[near], np.sum(shift[near] ** 2, axis=1), minlength=n)
    before = np.bincount(vision.reference[near], np.sum(shift_before[near] ** 2, axis=1), minlength=n)
    least = rounding_of(vision.origin.centers) ** 2  # keyframes in one place have no scale
    known = (now > least) & (before > least)
    return np.sqrt(np.divide(now, before, where=known, out=np.ones(n)))


def local_scales(vision: VisionInformation, poses: Poses) -> Array:
    """Return the (n,) scale of the map around each keyframe relative to the origin, from its neighbours."""
    _, shift = relative_poses(poses, vision.reference, vision.frame)
    _, shift_before = vision.measured()
    return _local_scale(vision, shift, shift_before)


def _range_rows(graph: KeyframeGraph, layout: _Layout, state: GraphState) -> tuple[Array, sparse.csr_array]:
    """Return the (k,) residuals of the ranges in standard deviations, and their derivatives."""
    antennas, stddev_m = graph.antennas, graph.errors.stddev_m
    residuals_m, by = graph.ranges_at(state)
    value = np.empty((len(residuals_m), 16))
    for first, frame, share in ((0, antennas.before, 1 - antennas.fraction), (6, antennas.after, antennas.fraction)):
        value[:, first : first + 3] = by.by_turn_of_cam(antennas.tag_in_cam_m, state.poses.world_from_rig[frame])
        value[:, first + 3 : first + 6] = by.by_tag
        value[:, first : first + 6] *= share[:, None]
    value[:, 12:15] = by.by_anchor
    value[:, 15] = 1.0
    value /= stddev_m[:, None]
    starts = np.arange(0, value.size + 1, value.shape[1])
    shape = (len(value), layout.num)
    return residuals_m / stddev_m, sparse.csr_array((value.ravel(), layout.of_ranges.ravel(), starts), shape=shape)


def _prior_rows(graph: KeyframeGraph, layout: _Layout, state: GraphState) -> tuple[Array, sparse.csr_array]:
    """Return the residuals of the priors in standard deviations, and their derivatives."""
    residuals: list[float] = []
    entries: list[tuple[int, int, float]] = []
    free = set(layout.free.tolist())
    for k, anchor in enumerate(graph.anchors):
        mean, stddev = anchor.prior_position_m, anchor.prior_position_stddev_m
        for axis in range(3):
            column = layout.first_anchor + 3 * k + axis
            if mean is not None and column in free and np.isfinite(stddev):
                entries.append((len(residuals), column, 1 / stddev))
                residuals.append((state.anchors_m[k, axis] - mean[axis]) / stddev)
        column, stddev = layout.first_bias + k, anchor.prior_bias_stddev_m
        if column in free and np.isfinite(stddev):
            entries += [(len(residuals), column, 1 / stddev), (len(residuals), layout.num - 1, -1 / stddev)]
            residuals.append((state.biases_m[k] - anchor.prior_bias_m - state.common_bias_m) / stddev)
    if layout.num - 1 in free:
        entries.append((len(residuals), layout.num - 1, 1 / graph.errors.common_bias_stddev_m))
        residuals.append(state.common_bias_m / graph.errors.common_bias_stddev_m)
    if graph.gravity is not None:
        rotation = state.poses.world_from_rig[0]
        slopes = graph.gravity.jacobian(rotation, rotation)
        entries += [(len(residuals) + row, column, float(slopes[row, column])) for row, column in np.ndindex(3, 3)]
        residuals += graph.gravity.residuals(rotation).tolist()
    rows, columns, values = zip(*entries, strict=True) if entries else ((), (), ())
    shape = (len(residuals), layout.num)
    return np.array(residuals), sparse.coo_array((values, (rows, columns)), shape=shape).tocsr()


def _factor(hessian: Array | sparse.csr_array, damping: float, blocks: tuple[Indices, Mask]) -> NestedFactor:
    """Factor a Hessian, with more damping if rounding makes it indefinite, as happens in a meaningless map.

    Args:
        blocks: as ``_Layout.blocks``.
    """
    diagonal = hessian.diagonal()
    # The floor keeps a pose without constraints in place.
    damped = hessian + sparse.diags_array(damping * diagonal + ROUNDING * diagonal.max())
    try:
        return factor(damped, *blocks)
    except SingularError:
        if damping > _MAX_DAMPING:  # then the matrix has entries that are not finite
            raise
        return _factor(hessian, max(10 * damping, _INITIAL_DAMPING), blocks)


def _moved(state: GraphState, layout: _Layout, free_step: Array) -> GraphState:
    step = np.zeros(layout.num)
    step[layout.free] = free_step
    turns, shifts = np.split(step[: layout.first_anchor].reshape(-1, 6), 2, axis=1)
    moved = _turned(state.poses, turns, shifts, is_free=layout.world_is_free)
    anchors = state.anchors_m + step[layout.first_anchor : layout.first_bias].reshape(-1, 3)
    return GraphState(moved, anchors, state.biases_m + step[layout.first_bias : -1], state.common_bias_m + step[-1])


def _turned(poses: Poses, turns: Array, shifts: Array, *, is_free: bool) -> Poses:
    """Return the poses after (n, 3) turns, each in its own frame, and shifts.

    In a free map, the mean turn of all poses moves their centres on arcs, not on straight lines: photos are indifferent
    to a turn of the whole world, but not to the deformation that straight lines would cause.
    """
    in_world = np.einsum("nij,nj->ni", poses.world_from_rig, turns)
    common = in_world.mean(axis=0) if is_free else np.zeros(3)
    arms = poses.centers - poses.centers.mean(axis=0)
    around = Rotation.from_rotvec(common).as_matrix()
    own = Rotation.from_rotvec(in_world - common).as_matrix()
    arcs = arms @ (around - np.eye(3)).T - np.cross(common, arms)
    return Poses(around @ own @ poses.world_from_rig, poses.centers + shifts + arcs)


def _num_absorbed(terms: _Terms, factored: NestedFactor) -> float:
    """Estimate the trace of the ranges' hat matrix with random vectors (Hutchinson 1990)."""
    rng = np.random.default_rng(0)
    whitened = terms.whitened[:, terms.layout.free]
    probes = rng.choice([-1.0, 1.0], (whitened.shape[0], _NUM_PROBES))
    back = whitened.T @ probes
    solved = factored.solve(np.ascontiguousarray(back))
    return float(np.sum(back * solved) / _NUM_PROBES)

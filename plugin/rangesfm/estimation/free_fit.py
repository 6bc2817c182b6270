"""The free fit: all poses by the photos' information between neighbours and by all measurements (sections 3 and 5.3).

It is the joint problem with the points eliminated once, stated so that bending a map costs only its local deformation.
Solved before the full bundle adjustment, it removes drift in cheap steps. The full problem needs many steps for this,
because its points have to follow every turn of the world.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy import sparse
from scipy.spatial.transform import Rotation

from rangesfm.arrays import Array, Indices, Mask
from rangesfm.estimation.vision_information import VisionInformation
from rangesfm.measurements.kind import Block, Linearization, MapState, Measurements
from rangesfm.solver.bending import Bending, bending_parts, without_similarity
from rangesfm.solver.bundle_adjustment import farthest, still_to_come
from rangesfm.solver.linear_solver import factor, normal_matrix, resized
from rangesfm.solver.nested_dissection import NestedFactor, SingularError
from rangesfm.util.geometry.numerics import MAX_NUM_ROUNDS, ROUNDING
from rangesfm.util.geometry.poses import Poses, relative_poses
from rangesfm.util.geometry.rotations import cross_matrices
from rangesfm.util.geometry.similarity import align_points, rmse, rounding_of
from rangesfm.util.geometry.trajectory import Trajectory

_INITIAL_DAMPING = 1e-8
_MAX_DAMPING = 1e6
# Number of random vectors for the estimated trace (number of parameters that the measurements determine).
_NUM_PROBES = 12


@dataclass(frozen=True)
class KeyframeGraph:
    """The least squares problem. Its unknowns are 6 per pose (turn in its own frame, shift), then all blocks.

    Attributes:
        vision: information from the photos.
        kinds: the measurements, priors among them.
        held_frame: index of a keyframe that is held fixed; negative: none is.
        blocks: start values of all blocks.
    """

    vision: VisionInformation
    kinds: tuple[Measurements, ...]
    held_frame: int
    blocks: Mapping[Block, Array]

    @property
    def start(self) -> MapState:
        """The map as it was given."""
        return MapState(self.vision.origin, self.blocks)

    @cached_property
    def starts(self) -> Indices:
        """First column of each block, and the number of all columns."""
        return np.cumsum([6 * len(self.vision.origin), *map(len, self.blocks.values())])

    @cached_property
    def first_of(self) -> dict[Block, int]:
        """First column of each block, by its name."""
        return dict(zip(self.blocks, self.starts.tolist(), strict=False))

    @cached_property
    def free(self) -> Indices:
        """Columns that are estimated: of poses that are not held, and of blocks on which measurements depend."""
        linear = [kind.linearize(self.start) for kind in self.kinds]
        used = {by.blocks[k] for each in linear for by in each.by_block for k in np.unique(by.index[by.index >= 0])}
        used = used.difference(*(kind.fixed for kind in self.kinds))
        of_poses = np.repeat(np.arange(len(self.vision.origin)) != self.held_frame, 6)
        of_blocks = np.repeat(np.array([name in used for name in self.blocks], dtype=bool), np.diff(self.starts))
        return np.flatnonzero(np.concatenate([of_poses, of_blocks]))

    @cached_property
    def parts(self) -> tuple[Indices, Mask]:
        """First free column of each pose and each block, and their number; and whether each is of a block."""
        ends = np.unique(np.searchsorted(self.free, [*range(0, self.starts[0], 6), *self.starts]))
        return ends, ends[1:] > np.searchsorted(self.free, self.starts[0])


@dataclass(frozen=True)
class GraphSolution:
    """The solution of a keyframe graph.

    Attributes:
        state: the estimate. kinds: the measurements, with their noise.
        num_absorbed: degrees of freedom of each kind that the parameters absorb, at the start of the last step.
        num_steps: accepted and rejected ones.
        bend_m: root mean square distance of the keyframes, from where the graph has its origin, from their best fit by
            one similarity; 0 for fewer than three.
    """

    state: MapState
    kinds: tuple[Measurements, ...] = ()
    num_absorbed: tuple[float, ...] = ()
    num_steps: int = 0
    bend_m: float = 0.0


def solve_graph(graph: KeyframeGraph, start: MapState, *, tolerance_m: float) -> GraphSolution:
    """Solve the graph by Levenberg-Marquardt steps.

    Args:
        tolerance_m: the solver stops when no keyframe moves further in a successful step, or in all steps to come.
    """
    state, damping = start, _INITIAL_DAMPING
    terms = solved = _Terms.at(graph, state)
    factored, used, step_count, movement = None, damping, 0, 0.0
    while step_count < MAX_NUM_ROUNDS and damping < _MAX_DAMPING:
        step_count += 1
        solved, used, factored = terms, damping, _factor(terms.hessian, damping, graph.parts)
        trial = _moved(state, graph, factored.solve(-terms.gradient))
        trial_terms = _Terms.at(graph, trial)
        if not trial_terms.cost < terms.cost:
            damping *= 10
            continue
        last, movement = movement, farthest(trial.poses.centers, state.poses.centers)
        state, terms, damping = trial, trial_terms, max(damping / 10, ROUNDING)
        if min(movement, still_to_come(movement, last)) < tolerance_m:
            break
    if factored is None or used > _INITIAL_DAMPING:  # more would hide what the measurements determine
        factored = _factor(solved.hessian, 0.0, graph.parts)
    absorbed = tuple(_num_absorbed(rows, factored) for rows in solved.whitened)
    before, after = graph.vision.origin.centers, state.poses.centers
    bend_m = rmse(align_points(before, after).apply(before) - after) if len(before) > 2 else 0.0
    return GraphSolution(state, graph.kinds, absorbed, step_count, bend_m)


@dataclass(frozen=True)
class GraphBending:
    """Bending of a map as the photos' information on relative poses allows it.

    Attributes:
        vision: of a map with the same poses, in any world. path: of the map, in its own.
    """

    vision: VisionInformation
    path: Trajectory

    def of_functions(self, by_pose: Array, *, frame_is_free: bool) -> Bending:
        is_firm = np.ones(len(self.path), dtype=bool)
        functions = without_similarity(by_pose, self.path, is_firm, frame_is_free=frame_is_free)
        parts = functions.reshape(len(by_pose), -1, 6)
        turn = self.path.world_from_cam[0] @ self.vision.origin.world_from_rig[0].T  # from one world to the other
        parts[:, :, 3:] = parts[:, :, 3:] @ turn
        covariance = functions @ self._factored.solve(np.ascontiguousarray(functions.T))
        return Bending(bending_parts("bending", covariance, 1.0, 0.0), covariance, np.zeros(len(by_pose)))

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
class _Terms:
    """Cost (half the robust sum of squares), gradient and Gauss-Newton Hessian over the free columns.

    Attributes:
        graph: whose terms they are. seen: derivatives of the relative poses.
        whitened: for each kind the derivatives of its residuals in standard deviations, times the roots of the robust
            weights, as sparse rows.
    """

    cost: float
    gradient: Array
    graph: KeyframeGraph
    seen: sparse.bsr_array
    whitened: tuple[sparse.csr_array, ...]

    @classmethod
    def at(cls, graph: KeyframeGraph, state: MapState) -> _Terms:
        residuals, jacobian = _relative_poses(graph.vision, state.poses)
        bound = graph.vision.matrix @ residuals
        cost = 0.5 * float(residuals @ bound)
        gradient = np.zeros(graph.starts[-1])
        gradient[: graph.starts[0]] = jacobian.T @ bound
        gradient = gradient[graph.free]
        whitened = []
        for kind in graph.kinds:
            linear, weights = kind.linearize(state), kind.weights
            scaled = weights.whitened(linear.residual)
            rho, first, _ = weights.share * weights.loss.rho(np.sum(scaled**2, axis=1))
            cost += 0.5 * float(rho.sum())
            root = np.sqrt(first)[:, None]
            rows = _rows(linear, root[:, :, None] * weights.root_information, graph)
            gradient = gradient + rows.T @ (root * scaled).ravel()
            whitened.append(rows)
        return cls(cost, gradient, graph, jacobian, tuple(whitened))

    @cached_property
    def hessian(self) -> Array | sparse.csr_array:
        """Gauss-Newton Hessian; computed only for states from which a step is taken."""
        graph = self.graph
        of_all = resized(normal_matrix(self.seen, graph.vision.matrix), int(graph.starts[-1]))
        of_free = of_all[graph.free][:, graph.free]
        for rows in self.whitened:
            of_free = of_free + rows.T @ rows
        return of_free


def _rows(linear: Linearization, roots: Array, graph: KeyframeGraph) -> sparse.csr_array:
    """Return the derivatives of g groups of d residuals, times (g, r, d) roots, as (g r, num_free) sparse rows."""
    num, size = linear.residual.shape
    columns = [(6 * linear.pose[:, :, None] + np.arange(6)).reshape(num, -1)]
    derivatives = [linear.by_pose.reshape(num, size, -1)]
    for by in linear.by_block:
        # A group that depends on no block has derivatives of 0, by whatever column.
        first = np.array([graph.first_of[name] for name in by.blocks] + [0])[by.index]
        columns.append(first[:, None] + np.arange(by.values.shape[2]))
        derivatives.append(np.where(by.index[:, None, None] >= 0, by.values, 0.0))
    values = roots @ np.concatenate(derivatives, axis=2)
    indices = np.broadcast_to(np.concatenate(columns, axis=1)[:, None], values.shape)
    starts = values.shape[2] * np.arange(num * values.shape[1] + 1)
    shape = (num * values.shape[1], int(graph.starts[-1]))
    return sparse.csr_array((values.ravel(), indices.ravel(), starts), shape=shape)[:, graph.free]


def _relative_poses(vision: VisionInformation, poses: Poses) -> tuple[Array, sparse.bsr_array]:
    """Return (6 u,) turns and shifts of relative poses against their origin, in the reference's frame, with derivative.

    The derivative is by the n poses, in blocks of 6 by 6, whose products are several times faster than of single
    numbers. Shifts are divided by the local scale of the map around the reference, because photos do not see that
    scale.
    """
    r, k = vision.reference, vision.frame
    turn, shift = relative_poses(poses, r, k)
    scale = _local_scale(vision, shift)[r][:, None]
    angles = Rotation.from_matrix(np.swapaxes(vision.turn, 1, 2) @ turn).as_rotvec()
    residuals = np.concatenate([angles, shift / scale - vision.shift], axis=1).ravel() + vision.from_optimum
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


def _local_scale(vision: VisionInformation, shift: Array) -> Array:
    """Return the (n,) growth of the map around each keyframe, where loops do not count."""
    n, near = len(vision.origin), slice(vision.num_from_points)
    now = np.bincount(vision.reference[near], np.sum(shift[near] ** 2, axis=1), minlength=n)
    before = np.bincount(vision.reference[near], np.sum(vision.shift[near] ** 2, axis=1), minlength=n)
    least = rounding_of(vision.origin.centers) ** 2  # keyframes in one place have no scale
    known = (now > least) & (before > least)
    return np.sqrt(np.divide(now, before, where=known, out=np.ones(n)))


def local_scales(vision: VisionInformation, poses: Poses) -> Array:
    """Return the (n,) scale of the map around each keyframe relative to the origin, from its neighbours."""
    return _local_scale(vision, relative_poses(poses, vision.reference, vision.frame)[1])


def _factor(hessian: Array | sparse.csr_array, damping: float, blocks: tuple[Indices, Mask]) -> NestedFactor:
    """Factor a Hessian, with more damping if rounding makes it indefinite, as happens in a meaningless map.

    Args:
        blocks: as ``KeyframeGraph.parts``.
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


def _moved(state: MapState, graph: KeyframeGraph, free_step: Array) -> MapState:
    step = np.zeros(graph.starts[-1])
    step[graph.free] = free_step
    of_poses, *of_blocks = np.split(step, graph.starts[:-1])
    turns, shifts = np.split(of_poses.reshape(-1, 6), 2, axis=1)
    moved = _turned(state.poses, turns, shifts, is_free=graph.held_frame < 0)
    return MapState(moved, {name: at + by for (name, at), by in zip(state.blocks.items(), of_blocks, strict=True)})


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


def _num_absorbed(whitened: sparse.csr_array, factored: NestedFactor) -> float:
    """Estimate the trace of the hat matrix of a kind's rows with random vectors (Hutchinson 1990)."""
    rng = np.random.default_rng(0)
    probes = rng.choice([-1.0, 1.0], (whitened.shape[0], _NUM_PROBES))
    back = whitened.T @ probes
    solved = factored.solve(np.ascontiguousarray(back))
    return float(np.sum(back * solved) / _NUM_PROBES)

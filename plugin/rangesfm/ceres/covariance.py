"""Covariances of a bundle adjustment with ranges: of poses, anchors, biases and scale."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pycolmap
from scipy import linalg
from scipy.sparse import bsr_array, csc_array, csr_array, diags_array
from scipy.spatial.transform import Rotation

from rangesfm.arrays import Array, Indices, Mask
from rangesfm.ceres import num_columns, tangent_jacobian
from rangesfm.ceres.linear_solver import factor, normal_matrix, resized
from rangesfm.ceres.nested_dissection import NestedFactor, SingularError
from rangesfm.ceres.part_errors import PartSteps, map_errors
from rangesfm.errors import GeometryError
from rangesfm.geometry.map_errors import MapErrors
from rangesfm.geometry.rotations import cross_matrices
from rangesfm.geometry.similarity import similarity_motions
from rangesfm.geometry.trajectory import pose_of
from rangesfm.processes.threads import both

# A motion of the whole world changes no residual if its effect is below this share of the effects of its parts alone:
# rounding leaves some 1e-15, a single weak range some 1e-5.
_FREE_MOTION = 1e-9
# Smallest pivot of the normal equations, with their diagonal scaled to 1, for a direction to count as determined.
_MIN_PIVOT = 1e-13
# Share of the squared extent of a path below which it is straight: then the turn about it is not determined.
_NO_TURN = 1e-10


@dataclass(frozen=True)
class ResidualErrors:
    """Errors of residuals that are not independent with the problem's standard deviation.

    Attributes:
        rows: (k,) indices of these residuals in the problem; they do not depend on 3-D points.
        by_error: (k, m) sparse derivatives by m errors, in standard deviations of the residuals.
        covariance: (m, m) of these errors, which replace those of the residuals.
        exact: indices of residuals without errors: priors of errors that ``covariance`` has already.
        variance_without_points: variance of all other residuals that do not depend on 3-D points, such as priors.
    """

    rows: Indices
    by_error: csr_array
    covariance: Array
    exact: Indices
    variance_without_points: float = 1.0


@dataclass(frozen=True)
class JointCovariance:
    """Covariances of everything that a problem estimates, from its joint normal equations.

    Attributes:
        frame_ids: (n,) registered frames, ascending.
        rig_from_world: (n, 6, 6) of a rotation from the left (rotation vector, rad) and the translation (metres).
        centers: (n, 3, 3) of the rig frames' origins in the world, square metres.
        anchors: (num_anchors, 3, 3) square metres.
        others: (k, k) of each other block, in its unit.
        similarity: (7, 7) of the map as a whole: logarithm of the scale, turn (rad) and shift (m) about the middle of
            the centres, for the best similarity between true and estimated centres.
        num_free_directions: number of motions of the whole map that change no residual (7 without ranges and gauge).
            Along these, covariances are those of the map that moves least (inner constraints). Constant blocks have
            covariance 0.
        errors: joint errors of frames, cameras, sensors of rigs and anchors.
    """

    frame_ids: Indices
    rig_from_world: Array
    centers: Array
    anchors: Array
    others: tuple[Array, ...]
    similarity: Array
    num_free_directions: int
    errors: MapErrors

    @property
    def relative_scale_stddev(self) -> float:
        """Relative standard deviation of every length in the map that is due to the scale."""
        return float(np.sqrt(self.similarity[0, 0]))


def joint_covariance(
    problem: Any,
    reconstruction: pycolmap.Reconstruction,
    *,
    anchors: Sequence[Array] = (),
    others: Sequence[Array] = (),
    residual_stddev: float = 1.0,
    errors: ResidualErrors | None = None,
    anchor_ids: Sequence[str] | None = None,
    refined_params: Mapping[int, Sequence[int]] | None = None,
) -> JointCovariance:
    """Compute covariances at a problem's current parameters, to first order: the inverse of J^T J.

    If the covariance S of the residuals is not the identity, the result is (J^T J)^-1 J^T S J (J^T J)^-1.

    3-D points are eliminated first (Schur complement), except those that share a residual with another point.

    Args:
        problem: of an adjuster of ``reconstruction``, with any further residuals.
        anchors: (3,) blocks of points in the world.
        others: further blocks: biases, lever arms, a time shift.
        residual_stddev: standard deviation of the residuals: 1 if they are in standard deviations.
        errors: of residuals that are not independent; None: all are.
        anchor_ids: names of the anchors in the map's errors; None: their indices.
        refined_params: indices of the adjusted parameters of each camera, by the camera's id; cameras that are missing
            here are adjusted as a whole or not at all.

    Raises:
        ValueError: the problem has blocks that are neither of the reconstruction nor given.
        GeometryError: a block is not determined by the residuals.
    """
    columns = _Columns.of(problem, reconstruction, anchors, others)
    inverse = _Inverse(_Reduced.of(problem, columns, errors), columns)
    size, num_free_directions = inverse.free.shape
    blocks = inverse.diagonal_blocks()
    variance = residual_stddev**2
    frames = columns.frames
    poses = np.array([variance * columns.covariance(pose, blocks) for pose in columns.poses]).reshape(-1, 6, 6)
    turn = np.diag([2.0, 2, 2, 1, 1, 1])  # Ceres turns by twice its step
    to_center = np.array([_center_from_step(pose) for pose in columns.poses]).reshape(-1, 3, 6)
    names = list(map(str, range(len(anchors)))) if anchor_ids is None else anchor_ids
    parts = [*_parts(columns, reconstruction, dict(zip(names, anchors, strict=True)), refined_params or {})]
    by_similarity = _similarity_gradients(columns, size)
    similarity = variance * inverse.of_functions(by_similarity) if len(frames) > 1 else np.full((7, 7), np.nan)
    return JointCovariance(
        frame_ids=frames,
        rig_from_world=turn @ poses @ turn,
        centers=to_center @ poses @ np.swapaxes(to_center, 1, 2),
        anchors=np.array([variance * columns.covariance(anchor, blocks) for anchor in anchors]).reshape(-1, 3, 3),
        others=tuple(variance * columns.covariance(block, blocks) for block in others),
        similarity=similarity,
        num_free_directions=num_free_directions,
        errors=map_errors(
            parts,
            size,
            lambda right: variance * inverse.covariance_times(right),
            lambda start: variance * blocks[columns.index_at(start)],
            by_similarity[:, 0],
            float(np.sqrt(similarity[0, 0])),
        ),
    )


class PhotosAlone:
    """First-order errors of poses from the photos alone: their covariance, and their distance from the minimum."""

    def __init__(self, problem: Any, reconstruction: pycolmap.Reconstruction, residual_stddev: float) -> None:
        """Linearise a problem of photos alone at its current parameters.

        Args:
            residual_stddev: standard deviation of its residuals.

        Raises:
            GeometryError: the residuals do not determine the map up to a similarity.
        """
        self._columns = _Columns.of(problem, reconstruction, (), ())
        reduced = _Reduced.of(problem, self._columns, None)
        self._gradient, self._stddev = reduced.gradient, residual_stddev
        self._inverse = _Inverse(reduced, self._columns)

    def of_functions(self, frame_ids: Indices, by_turn: Array, by_center: Array) -> tuple[Array, Array]:
        """Return the errors of functions that do not depend on the place and the size of the map.

        Args:
            frame_ids: (k,). by_turn, by_center: (c, k, 3) derivatives by a turn of each frame's rig in its own frame,
                and by a shift of the rig's origin.

        Returns:
            (c, c) covariance, and (c,) change of the functions if the map moves to the minimum of the photos alone.
        """
        columns, gradients = self._columns, np.zeros((len(self._gradient), len(by_turn)))
        pose_of_frame = dict(zip(columns.frames.tolist(), columns.poses, strict=True))
        for k, frame_id in enumerate(frame_ids.tolist()):
            pose = pose_of_frame[frame_id]
            if (index := columns.index_of.get(_address(pose))) is not None:
                # Ceres turns on the left of the rotation, and by twice its step.
                by_step = by_center[:, k] @ _center_from_step(pose)
                by_step[:, :3] -= 2.0 * by_turn[:, k]
                gradients[columns.span(index)] = by_step.T
        solution = self._inverse.solve(gradients)
        return self._stddev**2 * gradients.T @ solution, -solution.T @ self._gradient


@dataclass(frozen=True)
class _Columns:
    """Variable blocks in the order of the Jacobian's columns: poses, rigs, cameras, anchors, others, points.

    Attributes:
        frames: ids of registered frames. poses: their blocks, including constant ones.
        variable: all blocks that are estimated.
        kinds: of these blocks: "pose", "sensor", "anchor", "point" or "other".
        starts: first column of each block, and the number of columns at the end.
        index_of: index in ``variable`` by address.
    """

    frames: Indices
    poses: list[Array]
    variable: list[Array]
    kinds: list[str]
    starts: Indices
    index_of: dict[int, int]

    @classmethod
    def of(
        cls, problem: Any, reconstruction: pycolmap.Reconstruction, anchors: Sequence[Array], others: Sequence[Array]
    ) -> _Columns:
        frames = sorted(reconstruction.reg_frame_ids())
        poses = [pose_of(reconstruction.frame(frame)).params for frame in frames]
        blocks = [("pose", pose) for pose in poses]
        for rig in reconstruction.rigs.values():
            # The poses themselves are needed as blocks: sensor_from_rig() returns copies.
            blocks += [("sensor", pose.params) for pose in rig.non_ref_sensors.values() if pose is not None]
        blocks += [("other", camera.params) for camera in reconstruction.cameras.values()]
        blocks += [("anchor", anchor) for anchor in anchors]
        blocks += [("other", other) for other in others]
        blocks += [("point", point.xyz) for point in reconstruction.points3D.values()]
        known = [(kind, block) for kind, block in blocks if problem.has_parameter_block(block)]
        if len(known) != problem.num_parameter_blocks():
            raise ValueError(
                f"the problem has {problem.num_parameter_blocks()} blocks, expected {len(known)}: those of the "
                "reconstruction, of anchors and others"
            )
        variable = [(kind, block) for kind, block in known if not problem.is_parameter_block_constant(block)]
        sizes = [num_columns(problem, block) for _, block in variable]
        return cls(
            np.array(frames, dtype=np.int64),
            poses,
            [block for _, block in variable],
            [kind for kind, _ in variable],
            np.concatenate([[0], np.cumsum(sizes, dtype=np.int64)]),
            {_address(block): i for i, (_, block) in enumerate(variable)},
        )

    @property
    def num_kept_blocks(self) -> int:
        """Number of blocks without the points, which come last."""
        return self.kinds.index("point") if "point" in self.kinds else len(self.kinds)

    @property
    def num_kept_columns(self) -> int:
        return int(self.starts[self.num_kept_blocks])

    def span(self, index: int) -> slice:
        return slice(int(self.starts[index]), int(self.starts[index + 1]))

    def covariance(self, block: Array, inverse_blocks: list[Array]) -> Array:
        """Return a block's part of the inverse; 0 if the block is constant or not in the problem."""
        index = self.index_of.get(_address(block))
        size = 6 if len(block) == 7 else len(block)
        return np.zeros((size, size)) if index is None else inverse_blocks[index]

    def index_at(self, start: int) -> int:
        """Return the index in ``variable`` of the block that begins at a column."""
        return int(np.searchsorted(self.starts, start))

    def name(self, column: int) -> str:
        """Return a name for the block of a column, for messages."""
        index = int(np.searchsorted(self.starts, column, side="right")) - 1
        kind = self.kinds[index]
        return f"{kind} number {self.kinds[:index].count(kind)}"


def _address(block: Array) -> int:
    return int(block.__array_interface__["data"][0])


@dataclass(frozen=True)
class _Spread:
    """J^T S J for the residuals' covariance S: ``independent + by_error @ covariance @ by_error.T``."""

    independent: Array | csr_array
    by_error: csr_array
    covariance: Array

    def times(self, right: Array) -> Array:
        """Return the product with a matrix (size, k)."""
        return np.asarray(self.independent @ right + self.by_error @ (self.covariance @ (self.by_error.T @ right)))


@dataclass(frozen=True)
class _Reduced:
    """Normal equations after the elimination of the points; the Jacobian, which is larger, is not kept.

    ``normal``, J^T J, and ``spread`` are sums, since a difference of the two would leave negative variances where
    residuals that err together determine nearly everything.

    Attributes:
        gradient: (size,) of half the sum of squares, where the points follow.
        free: (size, k) basis of the motions of the world that change no residual.
    """

    normal: Array | csr_array
    spread: _Spread
    gradient: Array
    free: Array

    @classmethod
    def of(cls, problem: Any, columns: _Columns, errors: ResidualErrors | None) -> _Reduced:
        jacobian, residuals = tangent_jacobian(problem, columns.variable), np.asarray(problem.evaluate_residuals())
        first = columns.num_kept_columns
        of_points = jacobian[:, first:]
        stays = np.repeat(_tied_points(of_points), 3)
        kept = np.concatenate([np.arange(first), first + np.flatnonzero(stays)])
        free = _free_motions(jacobian, _world_motions(columns))[kept]
        rows, points = csr_array(jacobian[:, kept]), of_points[:, np.flatnonzero(~stays)]
        whitener = _whitener(points)
        has_point = np.diff(csr_array(of_points).indptr) > 0
        seen, others = csr_array(rows[has_point]), csr_array(rows[~has_point])
        own, explained = both(lambda: csr_array(seen.T) @ seen, lambda: _explained_by(points, rows, whitener))
        of_photos = own - explained
        normal = of_photos + others.T @ others
        gradient = rows.T @ (residuals - points @ (whitener @ (whitener.T @ (points.T @ residuals))))
        if errors is None:
            return cls(normal, _Spread(normal, csr_array((len(kept), 0)), np.zeros((0, 0))), gradient, free)
        has_point[errors.rows] = has_point[errors.exact] = True
        alone = csr_array(rows[~has_point])
        independent = of_photos + errors.variance_without_points * (alone.T @ alone)
        by_error = csr_array(rows[errors.rows].T @ errors.by_error)
        return cls(normal, _Spread(independent, by_error, errors.covariance), gradient, free)


def _whitener(points: csc_array) -> bsr_array:
    """Return W, square in blocks of 3, so that W @ W.T is the inverse of the points' own normal equations."""
    num_points = points.shape[1] // 3
    squares = (points.T @ points.tocsr()).tocoo()
    blocks = np.zeros((num_points, 3, 3))
    blocks[squares.row // 3, squares.row % 3, squares.col % 3] = squares.data
    # A point near the horizon has no determined depth; this holds it without any noticeable effect elsewhere.
    blocks += 1e-12 * np.maximum(np.trace(blocks, axis1=1, axis2=2), 1e-300)[:, None, None] * np.eye(3)
    whitener = np.swapaxes(np.linalg.inv(np.linalg.cholesky(blocks)), 1, 2)
    indices = np.arange(num_points)
    return bsr_array((whitener, indices, np.arange(num_points + 1)), shape=(3 * num_points, 3 * num_points))


def _explained_by(points: csc_array, kept: csr_array, whitener: bsr_array) -> Array | csr_array:
    """Return the part of the kept normal equations that the elimination of the points subtracts."""
    coupling = csr_array(points.T @ kept)
    coupling.resize(points.shape[1], -(-kept.shape[1] // 6) * 6)
    coupling = whitener.T @ coupling.tobsr((3, 6))  # blocks of poses and points multiply faster than numbers
    return resized(normal_matrix(coupling), kept.shape[1])


def _tied_points(points: csc_array) -> Mask:
    """Return a (num_points,) mask of points that share a residual with another point, as marks of a length do."""
    entries = points.tocoo()
    shape = points.shape[0], points.shape[1] // 3
    meets = csr_array((np.ones(entries.nnz), (entries.row, entries.col // 3)), shape=shape)
    tied = np.zeros(shape[1], dtype=bool)
    of_row = np.repeat(np.diff(meets.indptr), np.diff(meets.indptr))
    tied[meets.indices[of_row > 1]] = True
    return tied


def _world_motions(columns: _Columns) -> Array:
    """Return (num_columns, 7) motions of everything by small turns, shifts and a change of scale of the world."""
    motions = np.zeros((int(columns.starts[-1]), 7))
    num = columns.num_kept_blocks
    for i, (kind, block) in enumerate(zip(columns.kinds[:num], columns.variable[:num], strict=True)):
        rows = motions[columns.span(i)]
        if kind == "pose":
            rotation, translation = _matrix(block), block[4:]
            center = -rotation.T @ translation
            rows[:3, :3] = -0.5 * rotation
            rows[3:, 3:] = -rotation @ np.column_stack([np.eye(3), center])
        elif kind == "sensor" and len(rows) == 6:
            rows[3:, 6] = block[4:]
        elif kind == "anchor":
            rows[:] = np.roll(similarity_motions(block[None])[0], -1, axis=1)
    points = np.array(columns.variable[num:]).reshape(-1, 3)
    motions[columns.num_kept_columns :] = np.roll(similarity_motions(points), -1, axis=2).reshape(-1, 7)
    return motions


def _free_motions(jacobian: csc_array, motions: Array) -> Array:
    """Return a basis (num_columns, k) of the motions of the world that change no residual."""
    alone = np.sqrt(np.square(abs(jacobian) @ np.abs(motions)).sum(axis=0))
    moves = alone > _FREE_MOTION * alone.max()
    scaled = motions[:, moves] / alone[moves]
    _, strengths, directions = np.linalg.svd(jacobian @ scaled, full_matrices=False)
    return np.asarray(scaled @ directions[strengths < _FREE_MOTION].T)


class _Inverse:
    """Pseudo-inverse of the normal equations, orthogonal to the free motions, and the covariance by it.

    Attributes:
        free: (size, k) orthonormal basis of the free motions.
    """

    free: Array

    def __init__(self, reduced: _Reduced, columns: _Columns) -> None:
        normal, free = reduced.normal, reduced.free
        self._spread, self.free = reduced.spread, linalg.orth(free) if free.shape[1] else free
        self._scale = 1.0 / np.sqrt(np.maximum(normal.diagonal(), 1e-300))[:, None]
        # Fixing as many coordinates as there are free motions makes the matrix regular; any suitable choice will do.
        held = np.zeros(len(self._scale))
        held[linalg.qr(self.free.T, mode="r", pivoting=True)[1][: free.shape[1]]] = 1.0
        self._starts = np.concatenate(
            [columns.starts[: columns.num_kept_blocks + 1], np.arange(columns.num_kept_columns, len(held), 3) + 3]
        )
        self._factor = _factored(self._scaled(normal) + diags_array(held), self._starts, columns)

    def _scaled(self, matrix: Array | csr_array) -> Array | csr_array:
        return diags_array(self._scale[:, 0]) @ matrix @ diags_array(self._scale[:, 0])

    def solve(self, right: Array) -> Array:
        """Solve for a right side (size, k)."""
        return self._off_free(self._solve_regular(self._off_free(right)))

    def _solve_regular(self, right: Array) -> Array:
        return np.asarray(self._scale * self._factor.solve(self._scale * right))

    def _off_free(self, right: Array) -> Array:
        return np.asarray(right - self.free @ (self.free.T @ right))

    def diagonal_blocks(self) -> list[Array]:
        """Return the blocks of the covariance on its diagonal."""
        free, spread = self.free, self._spread
        blocks = self._factor.blocks_of_sandwich(self._scaled(spread.independent))
        # The same without the free motions, from the product of this matrix with them.
        of_free = self._solve_regular(np.asarray(spread.independent @ self._solve_regular(free)))
        of_free -= 0.5 * free @ (free.T @ of_free)
        by_error = self.solve(spread.by_error.toarray())
        of_errors = by_error @ spread.covariance
        return [
            self._scale[rows] * block * self._scale[rows].T
            - of_free[rows] @ free[rows].T
            - free[rows] @ of_free[rows].T
            + of_errors[rows] @ by_error[rows].T
            for block, rows in zip(blocks, map(slice, self._starts[:-1], self._starts[1:]), strict=True)
        ]

    def covariance_times(self, right: Array) -> Array:
        """Return the covariance of all columns times (size, k)."""
        return self.solve(self._spread.times(self.solve(right)))

    def of_functions(self, gradients: Array) -> Array:
        """Return the (k, k) covariance of linear functions with (size, k) gradients."""
        solution = self.solve(gradients)
        return np.asarray(solution.T @ self._spread.times(solution))


def _factored(normal: Array | csr_array, starts: Indices, columns: _Columns) -> NestedFactor:
    is_pose = np.array([kind == "pose" for kind in columns.kinds[: columns.num_kept_blocks]], dtype=bool)
    is_last = np.append(~is_pose, np.zeros(len(starts) - 1 - len(is_pose), dtype=bool))
    try:
        found = factor(normal, starts, is_last)
    except SingularError as error:
        raise _not_determined(columns, error.column) from error
    worst = int(np.argmin(found.pivots))
    if not found.pivots[worst] > _MIN_PIVOT:
        raise _not_determined(columns, worst)
    return found


def _not_determined(columns: _Columns, column: int) -> GeometryError:
    return GeometryError(f"the residuals do not determine the problem's {columns.name(column)}: no covariance")


def _similarity_gradients(columns: _Columns, num_rows: int) -> Array:
    """Return (num_rows, 7) gradients of the similarity that fits the errors of all centres by least squares."""
    centers = np.array([-_matrix(pose).T @ pose[4:] for pose in columns.poses])
    motions = similarity_motions(centers - centers.mean(axis=0))
    # Lengths and angles get one unit. The turn about a straight path is not determined and is left out.
    size = float(np.linalg.norm(centers - centers.mean(axis=0)) / np.sqrt(len(centers))) or 1.0
    unit = np.array([size] * 4 + [1.0] * 3)
    in_lengths = np.einsum("nik,nij->kj", motions, motions) / np.outer(unit, unit)
    to_similarity = np.linalg.pinv(in_lengths, rcond=_NO_TURN, hermitian=True) / np.outer(unit, unit)
    gradients = np.zeros((num_rows, 7))
    for pose, motion in zip(columns.poses, motions, strict=True):
        index = columns.index_of.get(_address(pose))
        if index is not None:
            gradients[columns.span(index)] = _center_from_step(pose).T @ motion @ to_similarity
    return gradients


def _parts(
    columns: _Columns,
    reconstruction: pycolmap.Reconstruction,
    anchors: Mapping[str, Array],
    refined_params: Mapping[int, Sequence[int]],
) -> Iterator[PartSteps]:
    """Yield the parts of the map that places of points depend on."""

    def start(block: Array) -> int | None:
        index = columns.index_of.get(_address(block))
        return None if index is None else int(columns.starts[index])

    size_m = _size_m(columns)
    turn_and_shift = np.repeat([size_m, 1.0], 3)
    for frame_id, pose in zip(columns.frames.tolist(), columns.poses, strict=True):
        turn = np.column_stack([-2.0 * _matrix(pose).T, np.zeros((3, 3))])  # Ceres turns by twice its step
        by_step = np.vstack([turn, _center_from_step(pose)])
        yield PartSteps("frame", frame_id, start(pose), by_step, turn_and_shift)
    for rig in reconstruction.rigs.values():
        for sensor, sensor_pose in rig.non_ref_sensors.items():
            if sensor_pose is not None:
                at = start(sensor_pose.params)
                yield PartSteps("sensor", sensor.id, at, np.diag([2.0, 2, 2, 1, 1, 1]), turn_and_shift)
    num_params = max((len(camera.params) for camera in reconstruction.cameras.values()), default=0)
    for camera_id, camera in reconstruction.cameras.items():
        by_step = np.eye(num_params)[:, list(refined_params.get(camera_id, range(len(camera.params))))]
        index = columns.index_of.get(_address(camera.params))
        if index is not None and by_step.shape[1] != columns.starts[index + 1] - columns.starts[index]:
            raise ValueError(f"camera {camera_id} is adjusted in part: expected the numbers of these parameters")
        unit = np.full(num_params, size_m / camera.mean_focal_length())
        yield PartSteps("camera", camera_id, start(camera.params), by_step, unit)
    for anchor_id, position in anchors.items():
        yield PartSteps("anchor", anchor_id, start(position), np.eye(3), np.ones(3))


def _size_m(columns: _Columns) -> float:
    """Return the median distance from the middle of the frames to the points, or to the frames without points."""
    centers = np.array([-_matrix(pose).T @ pose[4:] for pose in columns.poses])
    points = np.array(columns.variable[columns.num_kept_blocks :]).reshape(-1, 3)
    seen = points if len(points) else centers
    return float(np.median(np.linalg.norm(seen - centers.mean(axis=0), axis=1))) or 1.0


def _center_from_step(pose: Array) -> Array:
    """Return the (3, 6) derivative of the centre -R^T t by a step in Ceres' tangent space, which turns by twice it."""
    rotation = _matrix(pose)
    return -rotation.T @ np.column_stack([2.0 * cross_matrices(pose[4:]), np.eye(3)])


def _matrix(pose: Array) -> Array:
    """Return the (3, 3) rotation of [qx qy qz qw tx ty tz]."""
    return np.asarray(Rotation.from_quat(pose[:4]).as_matrix())

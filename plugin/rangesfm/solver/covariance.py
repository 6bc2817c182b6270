"""Covariances of a bundle adjustment: of all parts of a map, and of what its photos alone leave open."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from copy import copy
from types import MappingProxyType

import numpy as np
from scipy import linalg
from scipy.sparse import csr_array, diags_array

from rangesfm.arrays import Array, Indices, Mask
from rangesfm.errors import GeometryError
from rangesfm.solver.linear_solver import factor
from rangesfm.solver.nested_dissection import NestedFactor, SingularError
from rangesfm.solver.normal_equations import HALF_A_REVOLUTION, BlockColumns, NormalEquations, address, rotation_of
from rangesfm.solver.part_errors import PartSteps, map_errors, steps_of
from rangesfm.util.geometry.map_errors import MapErrors
from rangesfm.util.geometry.poses import Poses
from rangesfm.util.geometry.rotations import cross_matrices

# Smallest pivot of the normal equations, with their diagonal scaled to 1, for a direction to count as determined.
_MIN_PIVOT = 1e-13


def joint_covariance(
    equations: NormalEquations,
    *,
    anchors: Mapping[str, Array] = MappingProxyType({}),
    residual_stddev: float = 1.0,
    refined_params: Mapping[int, Sequence[int]] = MappingProxyType({}),
    firm_frame_ids: Indices,
) -> MapErrors:
    """Compute the covariance of all parts of a map to first order: the inverse of the normal equations J^T J.

    Motions of the whole map that change no residual are left out: along these, the covariance is that of the map that
    moves least (inner constraints). Constant blocks have covariance 0.

    Args:
        anchors: their blocks of the problem, as ``NormalEquations.of`` had them, by name.
        residual_stddev: standard deviation of the residuals: 1 if they are in standard deviations.
        refined_params: indices of the adjusted parameters of each camera, by the camera's id; cameras that are missing
            here are adjusted as a whole or not at all.
        firm_frame_ids: of the frames whose size is that of the map.

    Raises:
        GeometryError: a block is not determined by the residuals, or next to rounding the map as a whole is not.
    """
    columns, variance = equations.columns, residual_stddev**2
    equations, inverse, blocks = _solved(equations)
    turns = [2.0 * np.sqrt(variance * np.trace(columns.covariance(pose, blocks)[:3, :3])) for pose in columns.poses]
    if np.median(turns) > HALF_A_REVOLUTION and not inverse.free.shape[1]:
        equations, inverse, blocks = _solved(equations.with_turns_bounded(residual_stddev))
    parts = [*_parts(equations, columns, anchors, refined_params)]
    steps = steps_of(parts, len(equations.gradient))
    is_firm = np.isin(columns.frames, firm_frame_ids)
    of_scale = _scale_gradient(columns, is_firm)
    with_scale = variance * inverse.solve(of_scale)[:, 0]
    by_scale, scale_m2 = steps.T @ with_scale, float(of_scale[:, 0] @ with_scale)
    if scale_m2 < 0:  # as where a solver has thrown points and photos far apart
        raise GeometryError("rounding leaves nothing of how well the map's scale is known: no covariance")
    return map_errors(
        parts,
        lambda right: variance * (steps.T @ inverse.solve(steps @ right)),
        (part.covariance(lambda start: variance * blocks[columns.index_at(start)]) for part in parts),
        by_scale / scale_m2 if scale_m2 > 0 else by_scale,
        float(np.sqrt(scale_m2)),
    )


class PhotosAlone:
    """First-order errors of poses from the photos alone: their covariance, and their distance from the minimum.

    Steps are those of the equations' n columns.

    Attributes:
        gradient: (n,) of half the sum of squares of the reprojection errors.
    """

    def __init__(self, equations: NormalEquations, residual_stddev: float) -> None:
        """Take the photos' part of normal equations.

        Args:
            residual_stddev: standard deviation of a reprojection error's coordinate.

        Raises:
            GeometryError: the photos do not determine the map up to a similarity.
        """
        seen = equations.seen_blocks
        self._rows = equations.columns.of_blocks(seen)
        self._equations, self._columns = equations, equations.columns.subset(seen)
        self.gradient, self._stddev = equations.gradient[self._rows], residual_stddev
        self._more = np.zeros((len(self.gradient), 0)), np.zeros(0)
        _, self._inverse = _held_if_loose(equations, self._inverse_of)

    def _inverse_of(self, equations: NormalEquations) -> _Inverse:
        rows = self._rows
        return _Inverse(equations.of_photos[rows][:, rows], equations.free_of_photos[rows], self._columns)

    def with_more(self, steps: Array, variances: Array) -> PhotosAlone:
        """Return a copy in which independent errors along (n, m) steps have (m,) more variance, less if negative."""
        found = copy(self)
        found._more = steps, variances
        return found

    def solve(self, right: Array) -> Array:
        """Return the covariance of the steps times (n, k)."""
        steps, variances = self._more
        return self._stddev**2 * self._inverse.solve(right) + steps @ (variances[:, None] * (steps.T @ right))

    def blocks(self) -> Callable[[int], Array]:
        """Return a function that returns the covariance of the steps of one block, by the first of its columns."""
        found, (steps, variances) = self._inverse.diagonal_blocks(), self._more

        def block(start: int) -> Array:
            index = self._columns.index_at(start)
            own = steps[self._columns.span(index)]
            return np.asarray(self._stddev**2 * found[index] + own * variances @ own.T)

        return block

    def parts(self, refined_params: Mapping[int, Sequence[int]]) -> list[PartSteps]:
        """Return frames, sensors and cameras by the steps; arguments as of ``joint_covariance``."""
        return [*_parts(self._equations, self._columns, {}, refined_params)]

    @property
    def at_minimum(self) -> Array:
        """Return the (n,) steps to the minimum of the photos alone."""
        steps, variances = self._more
        more = steps @ (variances * (steps.T @ self.gradient)) / self._stddev**2
        return -self._inverse.solve(self.gradient[:, None])[:, 0] - more

    def by_steps(self, frame_ids: Indices, by_turn: Array, by_center: Array) -> Array:
        """Return the derivatives (n, c) of functions that do not depend on the place and the size of the map.

        Args:
            frame_ids: (k,). by_turn, by_center: (c, k, 3) derivatives by a turn of each frame's rig in its own frame,
                and by a shift of the rig's origin.
        """
        gradients = np.zeros((len(self.gradient), len(by_turn)))
        place = {frame_id: k for k, frame_id in enumerate(frame_ids.tolist())}
        for frame_id, pose, rows in self._free_poses():
            if (k := place.get(frame_id)) is not None:
                gradients[rows] = (np.hstack([by_turn[:, k], by_center[:, k]]) @ _pose_from_step(pose)).T
        return gradients

    def of_frames(self, steps: Array) -> Array:
        """Return (n,) steps as (m, 6) of ``poses``, turns of rigs in their own frames and shifts of their origins."""
        found = np.zeros((len(self._columns.frames), 6))
        for frame_id, pose, rows in self._free_poses():
            found[self._columns.frames == frame_id] = _pose_from_step(pose) @ steps[rows]
        return found

    @property
    def poses(self) -> tuple[Indices, Poses]:
        """Ids (m,) and poses of the frames, in the model's world."""
        turns = np.array([rotation_of(pose).T for pose in self._columns.poses])
        shifts = np.array([pose[4:] for pose in self._columns.poses])
        return self._columns.frames, Poses(turns, -np.einsum("mij,mj->mi", turns, shifts))

    def _free_poses(self) -> Iterator[tuple[int, Array, slice]]:
        """Yield the id, the pose and the rows in the equations of each frame that is not held."""
        columns = self._columns
        for frame_id, pose in zip(columns.frames.tolist(), columns.poses, strict=True):
            if (index := columns.index_of.get(address(pose))) is not None:
                yield frame_id, pose, columns.span(index)


class _Inverse:
    """Pseudo-inverse of normal equations, orthogonal to the free motions.

    Attributes:
        free: (size, k) orthonormal basis of the free motions.
    """

    free: Array

    def __init__(self, normal: Array | csr_array, free: Array, columns: BlockColumns) -> None:
        """Factor normal equations.

        Args:
            normal: (size, size). free: (size, k) basis of the free motions. columns: of the equations.

        Raises:
            GeometryError: a block is not determined.
        """
        self.free = linalg.orth(free) if free.shape[1] else free
        self._scale = 1.0 / np.sqrt(np.maximum(normal.diagonal(), 1e-300))[:, None]
        # Fixing as many coordinates as there are free motions makes the matrix regular; any suitable choice will do.
        held = np.zeros(len(self._scale))
        held[linalg.qr(self.free.T, mode="r", pivoting=True)[1][: free.shape[1]]] = 1.0
        self._starts = columns.starts
        scale = diags_array(self._scale[:, 0])
        self._factor = _factored(scale @ normal @ scale + diags_array(held), columns)

    def solve(self, right: Array) -> Array:
        """Solve for a right side (size, k)."""
        return self._off_free(self._solve_regular(self._off_free(right)))

    def _solve_regular(self, right: Array) -> Array:
        return np.asarray(self._scale * self._factor.solve(self._scale * right))

    def _off_free(self, right: Array) -> Array:
        return np.asarray(right - self.free @ (self.free.T @ right))

    def diagonal_blocks(self) -> list[Array]:
        """Return the blocks on its diagonal."""
        free = self.free
        of_free = self._solve_regular(free)
        of_free -= 0.5 * free @ (free.T @ of_free)
        return [
            self._scale[rows] * block * self._scale[rows].T
            - of_free[rows] @ free[rows].T
            - free[rows] @ of_free[rows].T
            for block, rows in zip(
                self._factor.blocks_of_inverse(), map(slice, self._starts[:-1], self._starts[1:]), strict=True
            )
        ]


def _solved(equations: NormalEquations) -> tuple[NormalEquations, _Inverse, list[Array]]:
    """Return the equations, perhaps with loose poses held, their inverse, and the blocks' covariances."""
    equations, inverse = _held_if_loose(equations, _joint_inverse)
    blocks = inverse.diagonal_blocks()
    if any(np.any(np.diag(block) < 0) for block in blocks):  # a pose is so loose that rounding leaves no digit of it
        equations = equations.with_loose_poses_held()
        inverse = _joint_inverse(equations)
        blocks = inverse.diagonal_blocks()
    return equations, inverse, blocks


def _held_if_loose(
    equations: NormalEquations, inverse_of: Callable[[NormalEquations], _Inverse]
) -> tuple[NormalEquations, _Inverse]:
    """Return the equations and their inverse, with loose poses held if they are not determined otherwise."""
    try:
        return equations, inverse_of(equations)
    except GeometryError:
        held = equations.with_loose_poses_held()
        return held, inverse_of(held)


def _joint_inverse(equations: NormalEquations) -> _Inverse:
    of_all = equations.of_photos + equations.others.T @ equations.others
    return _Inverse(of_all, equations.free, equations.columns)


def _factored(normal: Array | csr_array, columns: BlockColumns) -> NestedFactor:
    may_be_last = np.array([kind not in ("pose", "point") for kind in columns.kinds], dtype=bool)
    try:
        found = factor(normal, columns.starts, may_be_last)
    except SingularError as error:
        raise _not_determined(columns, error.column) from error
    worst = int(np.argmin(found.pivots))
    if not found.pivots[worst] > _MIN_PIVOT:
        raise _not_determined(columns, worst)
    return found


def _not_determined(columns: BlockColumns, column: int) -> GeometryError:
    return GeometryError(f"the residuals do not determine the problem's {columns.name(column)}: no covariance")


def _scale_gradient(columns: BlockColumns, is_firm: Mask) -> Array:
    """Return the gradient (size, 1) of the scale's logarithm that fits the errors of firm centres by least squares."""
    poses = [pose for pose, counts in zip(columns.poses, is_firm, strict=True) if counts]
    centers = np.array([-rotation_of(pose).T @ pose[4:] for pose in poses]).reshape(-1, 3)
    off = centers - centers.mean(axis=0) if len(centers) else centers
    gradient = np.zeros((int(columns.starts[-1]), 1))
    for pose, by_center in zip(poses, off / max(float(np.sum(off**2)), 1e-300), strict=True):
        if (index := columns.index_of.get(address(pose))) is not None:
            gradient[columns.span(index), 0] = by_center @ _center_from_step(pose)
    return gradient


def _parts(
    equations: NormalEquations,
    columns: BlockColumns,
    anchors: Mapping[str, Array],
    refined_params: Mapping[int, Sequence[int]],
) -> Iterator[PartSteps]:
    """Yield the parts of the map that places of points depend on, by some of the columns of its equations."""
    reconstruction, size_m = equations.reconstruction, equations.size_m

    def start(block: Array) -> int | None:
        index = columns.index_of.get(address(block))
        return None if index is None else int(columns.starts[index])

    turn_and_shift = np.repeat([size_m, 1.0], 3)
    for frame_id, pose in zip(columns.frames.tolist(), columns.poses, strict=True):
        turn = np.column_stack([-2.0 * rotation_of(pose).T, np.zeros((3, 3))])  # Ceres turns by twice its step
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
        index = columns.index_of.get(address(camera.params))
        if index is not None and by_step.shape[1] != columns.starts[index + 1] - columns.starts[index]:
            raise ValueError(f"camera {camera_id} is adjusted in part: expected the numbers of these parameters")
        unit = np.full(num_params, size_m / camera.mean_focal_length())
        yield PartSteps("camera", camera_id, start(camera.params), by_step, unit)
    for anchor_id, position in anchors.items():
        yield PartSteps("anchor", anchor_id, start(position), np.eye(3), np.ones(3))


def _center_from_step(pose: Array) -> Array:
    """Return the (3, 6) derivative of the centre -R^T t by a step in Ceres' tangent space, which turns by twice it."""
    rotation = rotation_of(pose)
    return -rotation.T @ np.column_stack([2.0 * cross_matrices(pose[4:]), np.eye(3)])


def _pose_from_step(pose: Array) -> Array:
    """Return the (6, 6) derivatives, by a step in that space, of the rig's turn in its own frame and of its centre."""
    return np.vstack([np.eye(3, 6) * -2.0, _center_from_step(pose)])

"""Normal equations of a bundle adjustment with other residuals, after the elimination of the points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pycolmap
from scipy.sparse import bsr_array, csc_array, csr_array, diags_array
from scipy.spatial.transform import Rotation

from rangesfm.arrays import Array, Indices, Mask
from rangesfm.solver import num_columns, tangent_jacobian
from rangesfm.solver.linear_solver import normal_matrix, resized
from rangesfm.util.geometry.numerics import ROUNDING, UNDETERMINED
from rangesfm.util.geometry.similarity import similarity_motions
from rangesfm.util.geometry.trajectory import pose_of
from rangesfm.util.processes.threads import both

HALF_A_REVOLUTION = float(np.pi / np.sqrt(3.0))
"""Standard deviation of angles that are spread evenly over a revolution, radians."""


@dataclass(frozen=True)
class BlockColumns:
    """Variable blocks in the order of the columns: poses, rigs, cameras, anchors, others, points.

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
    ) -> BlockColumns:
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
        sizes = np.array([num_columns(problem, block) for _, block in variable], dtype=np.int64)
        kinds = [kind for kind, _ in variable]
        return cls._of_sizes(np.array(frames, dtype=np.int64), poses, [block for _, block in variable], kinds, sizes)

    @classmethod
    def _of_sizes(
        cls, frames: Indices, poses: list[Array], variable: list[Array], kinds: list[str], sizes: Indices
    ) -> BlockColumns:
        starts = np.concatenate([[0], np.cumsum(sizes, dtype=np.int64)])
        return cls(frames, poses, variable, kinds, starts, {address(block): i for i, block in enumerate(variable)})

    def subset(self, kept: Indices) -> BlockColumns:
        """Return the columns of some of the blocks, by their indices, ascending."""
        variable, kinds = [self.variable[i] for i in kept], [self.kinds[i] for i in kept]
        return self._of_sizes(self.frames, self.poses, variable, kinds, np.diff(self.starts)[kept])

    def of_blocks(self, kept: Indices) -> Indices:
        """Return the columns of some of the blocks, by their indices."""
        is_kept = np.zeros(len(self.variable), dtype=bool)
        is_kept[kept] = True
        return np.flatnonzero(np.repeat(is_kept, np.diff(self.starts)))

    @property
    def points(self) -> Indices:
        """Indices of the blocks that are points, which come last."""
        first = self.kinds.index("point") if "point" in self.kinds else len(self.kinds)
        return np.arange(first, len(self.kinds))

    def span(self, index: int) -> slice:
        return slice(int(self.starts[index]), int(self.starts[index + 1]))

    def covariance(self, block: Array, inverse_blocks: list[Array]) -> Array:
        """Return a block's part of the inverse; 0 if the block is constant or not in the problem."""
        index = self.index_of.get(address(block))
        size = 6 if len(block) == 7 else len(block)
        return np.zeros((size, size)) if index is None else inverse_blocks[index]

    def index_at(self, column: int) -> int:
        """Return the index in ``variable`` of the block that has a column."""
        return int(np.searchsorted(self.starts, column, side="right")) - 1

    def name(self, column: int) -> str:
        """Return a name for the block of a column, for messages."""
        index = self.index_at(column)
        return f"{self.kinds[index]} number {self.kinds[:index].count(self.kinds[index])}"


def address(block: Array) -> int:
    """Return a number that tells a block from all others."""
    return int(block.__array_interface__["data"][0])


@dataclass(frozen=True)
class NormalEquations:
    """Normal equations at a problem's current parameters, to first order, without points that only photos see.

    The Jacobian, which is larger, is not kept.

    Attributes:
        reconstruction: of the problem.
        columns: of the blocks that are left.
        of_photos: (size, size) of the reprojection errors. gradient: (size,) of half the sum of their squares, where
            the points follow.
        others: (n, size) Jacobian of all other residuals.
        free, free_of_photos: (size, k) bases of the motions of the world that change no residual, and none of the
            photos'.
        size_m: median distance from the middle of the frames to the points, or to the frames without points.
    """

    reconstruction: pycolmap.Reconstruction
    columns: BlockColumns
    of_photos: Array | csr_array
    gradient: Array
    others: csr_array
    free: Array
    free_of_photos: Array
    size_m: float

    @classmethod
    def of(
        cls,
        problem: Any,
        reconstruction: pycolmap.Reconstruction,
        num_reprojections: int,
        anchors: Sequence[Array] = (),
        others: Sequence[Array] = (),
    ) -> NormalEquations:
        """Linearise a problem.

        Args:
            problem: of an adjuster of ``reconstruction``, with any further residuals.
            num_reprojections: number of the adjuster's own residuals, which come first.
            anchors: (3,) blocks of points in the world.
            others: further blocks: biases, lever arms, a time shift.

        Raises:
            ValueError: the problem has blocks that are neither of the reconstruction nor given.
        """
        columns = BlockColumns.of(problem, reconstruction, anchors, others)
        jacobian, residuals = tangent_jacobian(problem, columns.variable), np.asarray(problem.evaluate_residuals())
        first = int(columns.starts[columns.points[0]]) if len(columns.points) else jacobian.shape[1]
        of_points = jacobian[:, first:]
        is_seen_otherwise = _has_entries(csr_array(of_points)[num_reprojections:])
        kept_blocks = np.setdiff1d(np.arange(len(columns.variable)), columns.points[~is_seen_otherwise])
        kept = columns.of_blocks(kept_blocks)
        rows = csr_array(jacobian[:, kept])
        seen, residuals = csr_array(rows[:num_reprojections]), residuals[:num_reprojections]
        points = csc_array(of_points[:, np.flatnonzero(np.repeat(~is_seen_otherwise, 3))][:num_reprojections])
        whitener = _whitener(points)
        own, explained = both(lambda: csr_array(seen.T) @ seen, lambda: _explained_by(points, seen, whitener))
        motions = _world_motions(columns)
        effects = np.stack([jacobian @ motions, abs(jacobian) @ np.abs(motions)])
        return cls(
            reconstruction,
            columns.subset(kept_blocks),
            own - explained,
            seen.T @ (residuals - points @ (whitener @ (whitener.T @ (points.T @ residuals)))),
            csr_array(rows[num_reprojections:]),
            _free_motions(motions, effects)[kept],
            _free_motions(motions, effects[:, :num_reprojections])[kept],
            _size_m(columns),
        )

    def with_loose_poses_held(self) -> NormalEquations:
        """Return the equations with each pose held by a trillionth of what its photos say of it.

        One that hangs loose, as by points that only its neighbour sees, too, is then known to be anywhere, and all
        others are as certain as before.
        """
        is_pose = np.repeat([kind == "pose" for kind in self.columns.kinds], np.diff(self.columns.starts))
        held = diags_array(ROUNDING * is_pose * self.of_photos.diagonal())
        return replace(self, of_photos=self.of_photos + held)

    def with_turns_bounded(self, residual_stddev: float) -> NormalEquations:
        """Return the equations with the knowledge that a turn of the map is anything up to half a revolution.

        Where residuals hardly determine a turn, as that about a straight path, its variance would otherwise be
        thousands of squared radians, beside which rounding leaves no digit of the variances of places. Each of n poses
        gets an n-th of the information.

        Args:
            residual_stddev: standard deviation of the residuals.
        """
        starts = self.columns.starts[:-1][np.array([kind == "pose" for kind in self.columns.kinds], dtype=bool)]
        information = np.zeros(len(self.gradient))
        # Ceres turns by twice its step.
        information[np.add.outer(starts, np.arange(3))] = (2 / HALF_A_REVOLUTION) ** 2 / max(len(starts), 1)
        return replace(self, of_photos=self.of_photos + diags_array(residual_stddev**2 * information))

    @property
    def seen_blocks(self) -> Indices:
        """Indices of the blocks on which the photos depend."""
        return np.unique(np.searchsorted(self.columns.starts, np.flatnonzero(self.of_photos.diagonal()), "right") - 1)


def _has_entries(of_points: csr_array) -> Mask:
    """Return a (num_points,) mask of points on which some residuals depend."""
    found = np.zeros(of_points.shape[1] // 3, dtype=bool)
    found[of_points.indices[of_points.data != 0] // 3] = True
    return found


def _whitener(points: csc_array) -> bsr_array:
    """Return W, square in blocks of 3, so that W @ W.T is the inverse of the points' own normal equations."""
    num_points = points.shape[1] // 3
    squares = (points.T @ points.tocsr()).tocoo()
    blocks = np.zeros((num_points, 3, 3))
    blocks[squares.row // 3, squares.row % 3, squares.col % 3] = squares.data
    strengths, directions = np.linalg.eigh(blocks)
    # A point near the horizon has no determined depth. All others stay as they are: what held them, too, would hold the
    # whole map a little, and results would depend on the choice of the coordinates that fix it.
    strengths = np.maximum(strengths, np.maximum(ROUNDING * strengths[:, 2:], 1e-300))
    whitener = directions / np.sqrt(strengths)[:, None, :]
    indices = np.arange(num_points)
    return bsr_array((whitener, indices, np.arange(num_points + 1)), shape=(3 * num_points, 3 * num_points))


def _explained_by(points: csc_array, kept: csr_array, whitener: bsr_array) -> Array | csr_array:
    """Return the part of the kept normal equations that the elimination of the points subtracts."""
    coupling = csr_array(points.T @ kept)
    coupling.resize(points.shape[1], -(-kept.shape[1] // 6) * 6)
    coupling = whitener.T @ coupling.tobsr((3, 6))  # blocks of poses and points multiply faster than numbers
    return resized(normal_matrix(coupling), kept.shape[1])


def _world_motions(columns: BlockColumns) -> Array:
    """Return (num_columns, 7) motions of everything by small turns, shifts and a change of scale of the world."""
    motions = np.zeros((int(columns.starts[-1]), 7))
    num = len(columns.variable) - len(columns.points)
    for i, (kind, block) in enumerate(zip(columns.kinds[:num], columns.variable[:num], strict=True)):
        rows = motions[columns.span(i)]
        if kind == "pose":
            rotation, translation = rotation_of(block), block[4:]
            center = -rotation.T @ translation
            rows[:3, :3] = -0.5 * rotation
            rows[3:, 3:] = -rotation @ np.column_stack([np.eye(3), center])
        elif kind == "sensor" and len(rows) == 6:
            rows[3:, 6] = block[4:]
        elif kind == "anchor":
            rows[:] = np.roll(similarity_motions(block[None])[0], -1, axis=1)
    points = np.array(columns.variable[num:]).reshape(-1, 3)
    motions[columns.starts[num] :] = np.roll(similarity_motions(points), -1, axis=2).reshape(-1, 7)
    return motions


def _free_motions(motions: Array, effects: Array) -> Array:
    """Return a basis (num_columns, k) of the motions of the world that change no residual.

    Of the effects of a motion's parts alone, rounding leaves a share of some 1e-15, a single weak range some 1e-5.

    Args:
        effects: (2, n, 7) changes of n residuals by the motions, and sums of the sizes of those by their parts.
    """
    alone = np.sqrt(np.square(effects[1]).sum(axis=0))
    moves = alone > UNDETERMINED * alone.max(initial=0.0)
    _, strengths, directions = np.linalg.svd(effects[0][:, moves] / alone[moves], full_matrices=False)
    return np.asarray(motions[:, moves] / alone[moves] @ directions[strengths < UNDETERMINED].T)


def _size_m(columns: BlockColumns) -> float:
    centers = np.array([-rotation_of(pose).T @ pose[4:] for pose in columns.poses])
    points = np.array([columns.variable[i] for i in columns.points]).reshape(-1, 3)
    seen = points if len(points) else centers
    return float(np.median(np.linalg.norm(seen - centers.mean(axis=0), axis=1))) or 1.0


def rotation_of(pose: Array) -> Array:
    """Return the (3, 3) rotation of [qx qy qz qw tx ty tz]."""
    return np.asarray(Rotation.from_quat(pose[:4]).as_matrix())

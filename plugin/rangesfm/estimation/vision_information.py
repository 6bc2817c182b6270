"""Information from the photos on the relative poses of neighbouring keyframes.

The points are eliminated, track by track, at the current map. What remains constrains the poses of the keyframes that
see a point *relative to the first of them*. Expressed in that keyframe's frame, it stays valid while the map bends: a
common turn or shift costs nothing, and neither does a common scale, which the points' depths follow.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pycolmap
from scipy import sparse

from rangesfm.arrays import Array, Indices, Mask
from rangesfm.colmap.pieces import seen_in
from rangesfm.errors import SolverError
from rangesfm.util.geometry.numerics import ROUNDING
from rangesfm.util.geometry.poses import Poses, relative_poses
from rangesfm.util.geometry.robust_statistics import RobustLoss
from rangesfm.util.geometry.rotations import cross_matrices
from rangesfm.util.geometry.trajectory import pose_of
from rangesfm.util.processes.threads import side_by_side

# A long track is cut into overlapping pieces of this length; distant keyframes are linked through those in between.
_MAX_PIECE = 8
_PIECE_STEP = _MAX_PIECE // 2
# More pieces per keyframe tell nothing new about its neighbours, so an evenly thinned share with more weight is used.
# Up to _ENOUGH_PIECES in all none are dropped, and more than _MAX_NUM_PIECES are never used.
_NUM_PIECES_OF_KEYFRAME = 40
_ENOUGH_PIECES, _MAX_NUM_PIECES = 8000, 20000
# Loss of an observation, whose residual is in standard deviations; at this width it has half its weight.
_LOSS = RobustLoss(3.0, is_bounded=False)
# Smallest plausible depth, as a share of the median depth: lenses are not sharp at less.
_MIN_DEPTH = 0.01
# Residual, in standard deviations, beyond which a feature says nothing of the photos' gradient: that of a camera out of
# its place is not linear. COLMAP's mapper leaves out features beyond 4 px, which is some 8 standard deviations.
_FARTHEST = 10.0
# Largest plausible ratio of depths of a point in two photos: features of so different sizes are not matched.
_MAX_DEPTH_RATIO = 10.0


@dataclass(frozen=True)
class Rays:
    """n observations of p points as rays, ordered by point and keyframe; they do not need a camera model.

    Attributes:
        frame, point: (n,) indices of keyframe and point.
        ray: (n, 2) camera coordinates x/z and y/z.
        root_information: (n,) focal length over the standard deviation of a pixel coordinate.
        cam_from_rig_rotation, cam_from_rig_translation: (n, 3, 3), (n, 3) camera in its rig.
        points: (p, 3) in the world.
        point_ids: (p,) ids in the model.
    """

    frame: Indices
    point: Indices
    ray: Array
    root_information: Array
    cam_from_rig_rotation: Array
    cam_from_rig_translation: Array
    points: Array
    point_ids: Indices

    def with_pixel_stddev(self, pixel_stddev: float) -> Rays:
        """Return a copy with another standard deviation of feature coordinates, in units of the present one."""
        return replace(self, root_information=self.root_information / pixel_stddev)

    def subset(self, rows: Indices) -> Rays:
        """Return some of the observations; all points stay, even those that are no longer seen."""
        of_each = ("frame", "point", "ray", "root_information", "cam_from_rig_rotation", "cam_from_rig_translation")
        return replace(self, **{name: getattr(self, name)[rows] for name in of_each})


@dataclass(frozen=True)
class Loop:
    """The measured pose of a keyframe relative to a keyframe of another pass, in whose surroundings it was found again.

    Attributes:
        reference, frame: ids of the frames: of the one whose surroundings are known, and of the one found in them.
        turn, shift: (3, 3), (3,) pose of ``frame`` in the frame of ``reference``.
        information: (6, 6) on the turn in the frame of ``frame`` and the shift.
    """

    reference: int
    frame: int
    turn: Array
    shift: Array
    information: Array


@dataclass(frozen=True)
class VisionInformation:
    """Gaussian information on u relative poses (6 numbers each: turn, shift), linearised at ``origin``.

    Attributes:
        origin: the poses of linearisation.
        reference, frame: (u,) pose of keyframe ``frame`` relative to keyframe ``reference``.
        turn, shift: (u, 3, 3), (u, 3) these poses at the origin, and of loops as they were measured.
        matrix: (6 u, 6 u) sparse information, in blocks of 6 by 6.
        from_optimum: (6 u,) relative poses at the origin, minus those at which the photos fit best.
        num_from_points: number of relative poses that are not loops, which come last.
    """

    origin: Poses
    reference: Indices
    frame: Indices
    turn: Array
    shift: Array
    matrix: sparse.bsr_array
    from_optimum: Array
    num_from_points: int

    def with_loops(self, loops: Sequence[Loop], frame_ids: Indices) -> VisionInformation:
        """Return a copy with further relative poses.

        Args:
            frame_ids: of the keyframes.
        """
        if not loops:
            return self
        place = {frame_id: k for k, frame_id in enumerate(frame_ids.tolist())}
        starts = np.arange(len(loops) + 1)
        size = 6 * len(loops)
        information = np.array([loop.information for loop in loops])
        further = sparse.bsr_array((information, starts[:-1], starts), shape=(size, size))
        return replace(
            self,
            reference=np.append(self.reference, [place[loop.reference] for loop in loops]),
            frame=np.append(self.frame, [place[loop.frame] for loop in loops]),
            turn=np.concatenate([self.turn, [loop.turn for loop in loops]]),
            shift=np.concatenate([self.shift, [loop.shift for loop in loops]]),
            matrix=sparse.block_diag([self.matrix, further], format="bsr"),
            from_optimum=np.append(self.from_optimum, np.zeros(size)),
        )


def model_rays(metric: pycolmap.Reconstruction, frame_ids: Indices) -> Rays:
    """Return all observations of 3-D points in these frames, with a standard deviation of one pixel.

    Raises:
        SolverError: there are no rays.
    """
    index_of_frame = {int(frame_id): index for index, frame_id in enumerate(frame_ids)}
    point_ids = np.array(sorted(metric.points3D.keys()), dtype=np.int64)
    columns: list[tuple[npt.NDArray[Any], ...]] = []
    for image_id in metric.reg_image_ids():
        image = metric.image(image_id)
        ids, xy = seen_in(image)
        if image.frame_id not in index_of_frame or not len(ids):
            continue
        camera = metric.camera(image.camera_id)
        rays = np.asarray(camera.cam_from_img(xy), dtype=np.float64)
        cam_from_rig = image.cam_from_world() * pose_of(metric.frame(image.frame_id)).inverse()
        n = len(ids)
        columns.append(
            (
                np.full(n, index_of_frame[image.frame_id]),
                np.searchsorted(point_ids, ids),
                rays,
                np.full(n, camera.mean_focal_length()),
                np.tile(cam_from_rig.rotation.matrix(), (n, 1, 1)),
                np.tile(cam_from_rig.translation, (n, 1)),
            )
        )
    if not columns:
        raise SolverError("no photo of the model sees any of its points")
    frame, point, ray, root_information, rotation, translation = (
        np.concatenate(column) for column in zip(*columns, strict=True)
    )
    points = np.array([metric.point3D(int(point_id)).xyz for point_id in point_ids])
    all_of_them = Rays(frame, point, ray, root_information, rotation, translation, points, point_ids)
    valid = np.isfinite(ray).all(axis=1)
    return all_of_them.subset(np.flatnonzero(valid)[np.lexsort((frame[valid], point[valid]))])


def project(rays: Rays, poses: Poses, points: Array) -> tuple[Array, Array, Array]:
    """Return (n, 3) points in the rig, (n, 3) in the camera, and (n, 2, 3) weighted derivatives of rays by these."""
    frame = rays.frame
    in_rig = np.einsum("nji,nj->ni", poses.world_from_rig[frame], points[rays.point] - poses.centers[frame])
    in_cam = np.einsum("nij,nj->ni", rays.cam_from_rig_rotation, in_rig)
    in_cam = in_cam + rays.cam_from_rig_translation
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse_depth = 1 / in_cam[:, 2]
    derivative = np.zeros((len(frame), 2, 3))
    derivative[:, 0, 0] = derivative[:, 1, 1] = inverse_depth
    derivative[:, :, 2] = -in_cam[:, :2] * inverse_depth[:, None] ** 2
    return in_rig, in_cam, derivative * rays.root_information[:, None, None]


def misplaced_points(rays: Rays, poses: Poses) -> Mask:
    """Return a (p,) mask of points in or behind a camera that sees them, or far nearer to it than to another.

    Mappers sometimes make such points from wrong matches. A residual depends on the point's position over its depth, so
    near zero depth a step of centimetres changes it without bound. One such point in ten thousand makes a solver take
    small steps only, which end anywhere and look like convergence.
    """
    depth = project(rays, poses, rays.points)[1][:, 2]
    farthest = np.zeros(len(rays.points))
    np.maximum.at(farthest, rays.point, depth)
    least = np.maximum(_MIN_DEPTH * np.median(np.abs(depth)), farthest[rays.point] / _MAX_DEPTH_RATIO)
    misplaced: Mask = np.zeros(len(rays.points), dtype=np.bool_)
    misplaced[rays.point[~(depth >= least)]] = True
    return misplaced


def ray_residuals(rays: Rays, in_cam: Array) -> Array:
    """Return the (n, 2) residuals in standard deviations; infinite behind the camera."""
    with np.errstate(divide="ignore", invalid="ignore"):
        residuals = (in_cam[:, :2] / in_cam[:, 2:] - rays.ray) * rays.root_information[:, None]
    return np.where(in_cam[:, 2:] > 0, residuals, np.inf)


def robust_root_weights(residuals: Array) -> Array:
    """Return the (n,) square roots of the robust weights of (n, 2) residuals in standard deviations."""
    return np.sqrt(_LOSS.weights(np.linalg.norm(residuals, axis=1)))


def costs_of_points(rays: Rays, poses: Poses, points: Array) -> Array:
    """Return the (p,) robust cost of each point; infinite for a point behind a camera that sees it."""
    residuals = ray_residuals(rays, project(rays, poses, points)[1])
    rho = _LOSS.rho(np.sum(residuals**2, axis=1))[0]
    return np.bincount(rays.point, rho, len(points)).astype(np.float64)


def steps_of_points(rays: Rays, to_point: Array, residuals: Array) -> Array:
    """Return the (p, 3) Gauss-Newton steps of all points.

    Args:
        to_point: (n, 2, 3) derivatives of the (n, 2) residuals by the points.
    """
    n, num_points = len(residuals), len(rays.points)
    adder = sparse.csr_array((np.ones(n), (rays.point, np.arange(n))), shape=(num_points, n))
    information = (adder @ np.einsum("nai,naj->nij", to_point, to_point).reshape(n, 9)).reshape(-1, 3, 3)
    slope = adder @ np.einsum("nai,na->ni", to_point, residuals)
    return -np.linalg.solve(_regular(information), slope[:, :, None])[:, :, 0]


def _regular(information: Array) -> Array:
    """Return (n, 3, 3) information on points with what rounding needs to invert it where a depth is open."""
    ridge = ROUNDING * np.trace(information, axis1=1, axis2=2) + 1e-200
    return np.asarray(information + ridge[:, None, None] * np.eye(3))


def vision_information(rays: Rays, poses: Poses) -> VisionInformation:
    """Eliminate the points of a map and return the information on its relative poses."""
    in_rig, in_cam, derivative = project(rays, poses, rays.points)
    root_weight = robust_root_weights(ray_residuals(rays, in_cam))
    to_rig = root_weight[:, None, None] * np.nan_to_num(derivative) @ rays.cam_from_rig_rotation
    pieces, share = _thinned(_pieces(rays.point), len(poses))
    n = len(poses)
    batches = [batch for rows in pieces for batch in np.array_split(rows, max(len(rows) // 500, 1))]
    added = side_by_side(lambda rows: _added(*_eliminate(rows, rays.frame, in_rig, to_rig, poses)), batches)
    key = np.unique(np.concatenate([some for some, _ in added]))
    values = np.zeros((len(key), 6, 6))
    for some, blocks in added:
        values[np.searchsorted(key, some)] += blocks
    reference, first, second = key // n**2, key // n % n, key % n
    pairs, place = np.unique(np.concatenate([reference * n + first, reference * n + second]), return_inverse=True)
    starts = np.searchsorted(place[: len(key)], np.arange(len(pairs) + 1))
    size = 6 * len(pairs)
    matrix = sparse.bsr_array((values / share, place[len(key) :], starts), shape=(size, size))
    turn, shift = relative_poses(poses, pairs // n, pairs % n)
    return VisionInformation(poses, pairs // n, pairs % n, turn, shift, matrix, np.zeros(size), len(pairs))


def photo_gradient(rays: Rays, poses: Poses) -> Array:
    """Return the (6 n,) gradient of half the photos' sum of squares by the poses, where the points follow them.

    The numbers of a pose are a turn in its own frame and a shift. In a refined map the ranges balance this gradient.
    """
    in_rig, in_cam, derivative = project(rays, poses, rays.points)
    residuals = ray_residuals(rays, in_cam)
    fits = (in_cam[:, 2] > 0) & (np.linalg.norm(residuals, axis=1) < _FARTHEST)
    residuals = np.where(fits[:, None], residuals, 0.0)
    to_rig = np.where(fits[:, None, None], derivative, 0.0) @ rays.cam_from_rig_rotation
    rig_from_world = np.swapaxes(poses.world_from_rig[rays.frame], 1, 2)
    to_point = to_rig @ rig_from_world
    step = steps_of_points(rays, to_point, residuals)
    residuals = residuals + (to_point @ step[rays.point, :, None])[:, :, 0]
    to_pose = np.concatenate([to_rig @ cross_matrices(in_rig), -to_point], axis=2)
    gradient = np.zeros((len(poses), 6))
    np.add.at(gradient, rays.frame, np.einsum("nai,na->ni", to_pose, residuals))
    return gradient.ravel()


def _added(key: Indices, blocks: Array) -> tuple[Indices, Array]:
    """Return the distinct keys, ascending, and the sum of the (n, 6, 6) blocks of each."""
    unique, where = np.unique(key, return_inverse=True)
    adder = sparse.csr_array((np.ones(len(key)), (where, np.arange(len(key)))), shape=(len(unique), len(key)))
    return unique, (adder @ blocks.reshape(-1, 36)).reshape(-1, 6, 6)


def _pieces(point: Indices) -> dict[int, Indices]:
    """Return the rows of the pieces of all tracks, (k, length) by length; observations are ordered by point."""
    starts = np.flatnonzero(np.diff(point, prepend=-1))
    lengths = np.diff(np.append(starts, len(point)))
    pieces: dict[int, Indices] = {}
    for length in range(2, _MAX_PIECE + 1):
        whole = starts[lengths == length]
        pieces[length] = whole[:, None] + np.arange(length)
    long = [
        start + min(first, length - _MAX_PIECE)
        for start, length in zip(starts, lengths, strict=True)
        if length > _MAX_PIECE
        for first in range(0, length - _MAX_PIECE + _PIECE_STEP, _PIECE_STEP)
    ]
    more = np.array(long, dtype=np.int64)[:, None] + np.arange(_MAX_PIECE)
    pieces[_MAX_PIECE] = np.concatenate([pieces[_MAX_PIECE], more])
    return pieces


def _thinned(pieces: dict[int, Indices], num_keyframes: int) -> tuple[Iterator[Indices], float]:
    """Return the pieces by length, evenly thinned if there are very many, and the share that is kept."""
    num = sum(len(rows) for rows in pieces.values())
    step = max(-(-num // min(max(_NUM_PIECES_OF_KEYFRAME * num_keyframes, _ENOUGH_PIECES), _MAX_NUM_PIECES)), 1)
    return (rows[::step] for rows in pieces.values() if len(rows)), 1 / step


def _eliminate(rows: Indices, frame: Indices, in_rig: Array, to_rig: Array, poses: Poses) -> tuple[Indices, Array]:
    """Compute the information on relative poses from pieces of one length.

    Args:
        rows: (k, m) observations of each piece.
        in_rig: (n, 3) points. to_rig: (n, 2, 3) weighted derivative of a ray by the point in the rig.

    Returns:
        (l,) keys (reference, first, second keyframe) and (l, 6, 6) blocks.
    """
    frames = frame[rows]
    reference = frames[:, 0]
    # Rotation from the reference's rig to each keyframe's.
    turn = np.einsum("kmji,kjl->kmil", poses.world_from_rig[frames], poses.world_from_rig[reference])
    to_pose = np.concatenate([to_rig[rows] @ cross_matrices(in_rig[rows]), -to_rig[rows] @ turn], axis=3)
    to_pose[frames == reference[:, None]] = 0.0
    to_point = to_rig[rows] @ turn
    information = np.einsum("kmai,kmaj->kij", to_point, to_point)
    coupling = np.einsum("kmai,kmaj->kmij", to_point, to_pose)
    inverse = np.linalg.inv(_regular(information))
    blocks = -np.einsum("kmia,kij,knjb->kmnab", coupling, inverse, coupling, optimize=True)
    own = np.arange(rows.shape[1])
    blocks[:, own, own] += np.einsum("kmai,kmaj->kmij", to_pose, to_pose)
    n = len(poses)
    keys = reference[:, None, None] * n**2 + frames[:, :, None] * n + frames[:, None, :]
    both_move = (frames != reference[:, None])[:, :, None] & (frames != reference[:, None])[:, None, :]
    return keys[both_move], blocks[both_move]

"""Points that people name, as functions of the state: anchors, cameras, and marks in photos."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pycolmap

from rangesfm.arrays import Array, Indices
from rangesfm.measurements.kind import Block, ByBlock, Linearization, MapState
from rangesfm.measurements.lengths.markers import images_by_name
from rangesfm.measurements.lengths.tape import Marker
from rangesfm.options import RefineOptions
from rangesfm.util.geometry.poses import Poses, frames_in_order, model_poses
from rangesfm.util.geometry.rotations import cross_matrices
from rangesfm.util.geometry.trajectory import Trajectory, pose_of


@dataclass(frozen=True)
class PlacedPoint:
    """A point at a state.

    Attributes:
        position_m: (3,). by_pose: (3, 6) derivatives by keyframes, by index, as in ``Linearization``.
        block: the block that is the point; empty if it is none.
    """

    position_m: Array
    by_pose: Mapping[int, Array]
    block: tuple[Block, ...] = ()


@dataclass(frozen=True)
class NamedPoints:
    """Points of a map by name. A name is that of a photo (its projection centre), else of a marker, else of an anchor.

    Attributes:
        cameras: for each photo the index of its keyframe, and its centre (3,) in the rig.
        rays: for each marker the (k,) indices of the keyframes that see it, and the (k, 3) origins and directions in
            their rigs.
        anchors: names of anchors with a position.
        markers: the markers, by name.
    """

    cameras: Mapping[str, tuple[int, Array]]
    rays: Mapping[str, tuple[Indices, Array, Array]]
    anchors: frozenset[str]
    markers: Mapping[str, Marker]

    @classmethod
    def in_model(
        cls,
        model: pycolmap.Reconstruction,
        frame_ids: Indices,
        markers: Mapping[str, Marker],
        anchors: Iterable[str] = (),
    ) -> NamedPoints:
        """Find the points of a model whose keyframes have these ids, in their order."""
        index = {frame_id: k for k, frame_id in enumerate(frame_ids.tolist())}
        images = images_by_name(model)
        cameras, views = {}, {}
        for name, image in images.items():
            cam_from_rig = image.cam_from_world() * pose_of(model.frame(image.frame_id)).inverse()
            rig_from_cam = cam_from_rig.inverse()
            cameras[name] = index[image.frame_id], np.asarray(rig_from_cam.translation)
            views[name] = model.camera(image.camera_id), np.asarray(rig_from_cam.rotation.matrix())
        rays = {}
        for name, marker in markers.items():
            seen = [k for k, photo in enumerate(marker.image_names) if photo in images]
            names = [marker.image_names[k] for k in seen]
            in_cam = [views[photo][0].cam_from_img(marker.pixels[k]) for k, photo in zip(seen, names, strict=True)]
            directions = np.array(
                [views[photo][1] @ [*np.ravel(at), 1.0] for photo, at in zip(names, in_cam, strict=True)]
            ).reshape(-1, 3)
            rays[name] = (
                np.array([cameras[photo][0] for photo in names], dtype=np.int64),
                np.array([cameras[photo][1] for photo in names]).reshape(-1, 3),
                directions / np.linalg.norm(directions, axis=1)[:, None],
            )
        return cls(cameras, rays, frozenset(anchors), markers)

    def __contains__(self, name: str) -> bool:
        return name in self.cameras or name in self.rays or name in self.anchors

    def at(self, name: str, state: MapState) -> PlacedPoint:
        """Return a point at a state; a marker is a block where it is estimated, else where the rays to it meet."""
        if name in self.cameras:
            frame, in_rig_m = self.cameras[name]
            rotation = state.poses.world_from_rig[frame]
            slopes = np.hstack([-rotation @ cross_matrices(in_rig_m), np.eye(3)])
            return PlacedPoint(state.poses.centers[frame] + rotation @ in_rig_m, {frame: slopes})
        for block in (("mark", name), ("anchor", name)):
            if block in state.blocks:
                return PlacedPoint(state.blocks[block], {}, (block,))
        return _where_rays_meet(*self.rays[name], state)


class MapToFit(NamedTuple):
    """A metric map at the start of its fit.

    Attributes:
        poses: of its frames, those of the trajectory first. points: named ones.
        trajectory: of the unscaled model, to which the measurements refer.
        options: of the fit.
    """

    poses: Poses
    points: NamedPoints
    trajectory: Trajectory
    options: RefineOptions

    @classmethod
    def of_model(
        cls,
        model: pycolmap.Reconstruction,
        trajectory: Trajectory,
        options: RefineOptions,
        markers: Mapping[str, Marker],
        anchors: Iterable[str],
    ) -> MapToFit:
        """Return a metric model with its points; others as of the map, and of ``NamedPoints.in_model``."""
        frame_ids = frames_in_order(model, trajectory.frame_ids)
        points = NamedPoints.in_model(model, frame_ids, markers, anchors)
        return cls(model_poses(model, frame_ids), points, trajectory, options)


def _where_rays_meet(frames: Indices, origins: Array, directions: Array, state: MapState) -> PlacedPoint:
    """Return the point with the least sum of squared distances from rays (k, 3), which keyframes carry along.

    With P the projections across the rays, it solves ``sum(P) x = sum(P o)``. Its derivative is that of this equation.
    """
    rotations, centers = state.poses.world_from_rig[frames], state.poses.centers[frames]
    from_rig = np.einsum("kij,kj->ki", rotations, origins)
    along = np.einsum("kij,kj->ki", rotations, directions)
    across = np.eye(3) - along[:, :, None] * along[:, None]
    inverse = np.linalg.inv(across.sum(axis=0))
    point = inverse @ np.einsum("kij,kj->i", across, centers + from_rig)
    to_point = point - centers - from_rig
    # With v from a ray's origin to the point, a change e of its direction d changes P v by -((d v) I + d v^T) e.
    by_direction = (
        np.einsum("ki,ki->k", along, to_point)[:, None, None] * np.eye(3) + along[:, :, None] * to_point[:, None]
    )
    by_turn = across @ -rotations @ cross_matrices(origins) + by_direction @ -rotations @ cross_matrices(directions)
    slopes = inverse @ np.concatenate([by_turn, across], axis=2)
    by_pose: dict[int, Array] = {}
    for frame, slope in zip(frames.tolist(), slopes, strict=True):
        by_pose[frame] = by_pose.get(frame, 0.0) + slope
    return PlacedPoint(point, by_pose)


def linearized(residuals: Sequence[Array], slopes: Sequence[Sequence[tuple[Array, PlacedPoint]]]) -> Linearization:
    """Return the linearization of g groups that depend on points.

    Args:
        residuals: (d,) of each group.
        slopes: for each group the points on which it depends, each with the (d, 3) derivatives by it.
    """
    num, size = len(residuals), len(residuals[0]) if residuals else 1
    by_pose = [
        _added((frame, by_point @ slope) for by_point, point in of for frame, slope in point.by_pose.items())
        for of in slopes
    ]
    most = max((len(of) for of in by_pose), default=0)
    pose, values = np.zeros((num, most), dtype=np.int64), np.zeros((num, size, most, 6))
    for row, by_frame in enumerate(by_pose):
        for column, (frame, slope) in enumerate(by_frame.items()):
            pose[row, column], values[row, :, column] = frame, slope
    blocks = tuple(dict.fromkeys(block for of in slopes for _, point in of for block in point.block))
    by_block = []
    for k in range(max((len(of) for of in slopes), default=0) if blocks else 0):
        index, of_block = np.full(num, -1, dtype=np.int64), np.zeros((num, size, 3))
        for row, of in enumerate(slopes):
            if k < len(of) and of[k][1].block:
                index[row], of_block[row] = blocks.index(of[k][1].block[0]), of[k][0]
        by_block.append(ByBlock(blocks, index, of_block))
    return Linearization(np.array(residuals).reshape(num, size), pose, values, tuple(by_block))


def _added(slopes: Iterable[tuple[int, Array]]) -> dict[int, Array]:
    total: dict[int, Array] = {}
    for frame, slope in slopes:
        total[frame] = total.get(frame, 0.0) + slope
    return total

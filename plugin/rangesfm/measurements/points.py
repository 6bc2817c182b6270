"""Points that people name, as functions of a map: photos, marks in photos, printed tags, anchors and 3-D points."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import pycolmap

from rangesfm.arrays import Array, Indices
from rangesfm.errors import InputError
from rangesfm.measurements.kind import ByBlock, Linearization, MapState
from rangesfm.measurements.lengths.tape import Marker
from rangesfm.util.geometry.map_errors import MapPoint, Part
from rangesfm.util.geometry.poses import frames_in_order, model_poses
from rangesfm.util.geometry.rotations import cross_matrices
from rangesfm.util.geometry.trajectory import pose_of

POINT_PREFIX = "point:"
"""Text before the number of a 3-D point of the model, as in ``point:1234``."""
NUM_CORNERS = 4
"""Number of corners of a printed tag; ``tag7`` is the mean of ``tag7.0`` to ``tag7.3``."""

_EXPECTED = "a photo that is in the map, a marker, a printed tag, an anchor with a position, or point: with an id"
# Largest distance of a mark from its reprojected marker, as a fraction of the photo's longer side. A mark farther off
# belongs to another point.
_MAX_REPROJECTION = 0.02
# Smallest angle between the rays to a marker.
_MIN_TRIANGULATION_ANGLE_DEG = 0.5
# Relative step of a numeric derivative of a projection; with it, rounding and curvature both stay below 1e-8.
_STEP = 1e-5
# Parts of a map that are parameters of a fit besides the poses.
_BLOCKS = ("mark", "anchor")


def images_by_name(model: pycolmap.Reconstruction) -> dict[str, pycolmap.Image]:
    """Return the model's photos with a pose, by name."""
    return {image.name: image for image in model.images.values() if image.has_pose}


@dataclass(frozen=True)
class View:
    """A photo in its rig.

    Attributes:
        keyframe: index of its keyframe. frame: that as a part of the map.
        sensor: the part that is its place in the rig; empty for the reference sensor, which is the rig's origin.
        camera: its camera.
        in_rig: (3,) its projection centre. rig_from_cam: (3, 3).
    """

    keyframe: int
    frame: Part
    sensor: tuple[Part, ...]
    camera: pycolmap.Camera
    in_rig: Array
    rig_from_cam: Array


@dataclass(frozen=True)
class Rays:
    """Rays of k views.

    Attributes:
        views: the views. in_cam: (k, 3) unit vectors in the cameras; NaN where a camera sees no such mark.
    """

    views: tuple[View, ...]
    in_cam: Array

    @cached_property
    def in_rigs(self) -> tuple[Indices, Array, Array]:
        """Keyframes (k,), origins (k, 3) and rotations rig_from_cam (k, 3, 3) of the views."""
        keyframes = np.array([view.keyframe for view in self.views], dtype=np.int64)
        origins = np.array([view.in_rig for view in self.views]).reshape(-1, 3)
        return keyframes, origins, np.array([view.rig_from_cam for view in self.views]).reshape(-1, 3, 3)

    @cached_property
    def pixel_by_point(self) -> Array:
        """(k, 2, 3) derivatives of pixels by a point in the camera, at the distance 1."""
        return np.array([_by_point(view.camera, at) for view, at in zip(self.views, self.in_cam, strict=True)])

    @cached_property
    def by_camera(self) -> list[Array]:
        """(3, p) derivatives of each direction in its camera by the parameters of the camera."""
        found = zip(self.views, self.in_cam, self.by_pixel, strict=True)
        return [-by_pixel @ _by_params(view.camera, at) for view, at, by_pixel in found]

    @cached_property
    def by_pixel(self) -> Array:
        """(k, 3, 2) derivatives of the directions in their cameras by the pixels."""
        return np.asarray(np.linalg.pinv(self.pixel_by_point))


@dataclass(frozen=True)
class NamedPoints:
    """Points of a map by name.

    A name is that of a photo (its projection centre), else of a marker, else of a printed tag (the mean of its
    corners), else of an anchor, else ``point:`` with the id of a 3-D point of the model.

    Attributes:
        model: the map. frame_ids: (n,) of its keyframes, as in the poses of a state.
        state: the map as it was when its points were named; its blocks are the anchors with a position.
        views: photos by name. markers: marks in photos by name. rays: those of the marks that are in photos of the map.
        pixel_stddev: standard deviation of a coordinate of a feature; NaN if it is not known.
    """

    model: pycolmap.Reconstruction
    frame_ids: Indices
    state: MapState
    views: Mapping[str, View]
    markers: Mapping[str, Marker]
    rays: Mapping[str, Rays]
    pixel_stddev: float

    @classmethod
    def in_model(
        cls,
        model: pycolmap.Reconstruction,
        markers: Mapping[str, Marker],
        anchors_m: Mapping[str, Array] = {},
        first_ids: Sequence[int] | Indices = (),
        pixel_stddev: float = np.nan,
    ) -> NamedPoints:
        """Find the points of a model.

        Args:
            anchors_m: (3,) positions by id. first_ids: keyframes that come first. Others as of the points.
        """
        frame_ids = frames_in_order(model, np.array(first_ids, dtype=np.int64))
        index = {frame_id: k for k, frame_id in enumerate(frame_ids.tolist())}
        blocks = {("anchor", name): at for name, at in anchors_m.items()}
        views = {name: _view(model, image, index) for name, image in images_by_name(model).items()}
        rays = {name: _rays_of_marks(marker, views) for name, marker in markers.items()}
        state = MapState(model_poses(model, frame_ids), blocks)
        return cls(model, frame_ids, state, views, markers, rays, pixel_stddev)

    def __contains__(self, name: str) -> bool:
        """Return whether it is a photo, a marker, or an anchor with a position."""
        return name in self.views or name in self.markers or ("anchor", name) in self.state.blocks

    def marked(self, names: Iterable[str]) -> dict[str, Marker]:
        """Return the markers among points, by name."""
        return {name: self.markers[name] for name in names if name in self.markers and name not in self.views}

    def find(self, name: str) -> MapPoint:
        """Return a point of the map.

        Raises:
            InputError: nothing has that name, or the marks of a marker determine no point.
        """
        if name in self.views or (name not in self.markers and ("anchor", name) in self.state.blocks):
            return self.at(name, self.state)
        if name in self.markers:
            return self.find_mark(name)
        if corners := [corner for k in range(NUM_CORNERS) if (corner := f"{name}.{k}") in self.markers]:
            return self._middle(name, corners)
        if name.startswith(POINT_PREFIX):
            number = name.removeprefix(POINT_PREFIX)
            if not (number.isdecimal() and self.model.exists_point3D(int(number))):
                raise InputError(f"{name!r} is not in the map, expected the id of one of its 3-D points")
            return self.point_of_model(int(number), self.pixel_stddev)
        known = [*self.views, *self.markers, *(anchor for _, anchor in self.state.blocks)]
        near = difflib.get_close_matches(name, known, 1)
        raise InputError(f"{name!r} is not in the map, expected {_EXPECTED}" + (f"; near: {near[0]}" if near else ""))

    def find_mark(self, name: str) -> MapPoint:
        """Return a marker of the map, the point that is nearest to the rays of its marks.

        Raises:
            InputError: the marks are too few, seen from one direction only, or not of one point.
        """
        marker, rays = self.markers[name], self.rays[name]

        def wrong(what: str, k: int = 0) -> InputError:
            return InputError(f"marker {name!r} {what}", marker.path, marker.lines[k])

        seen = [k for k, photo in enumerate(marker.image_names) if photo in self.views]
        if len(seen) < 2:
            raise wrong(f"is marked in {len(seen)} photos of the model, expected two or more")
        if not np.isfinite(rays.in_cam).all():
            raise wrong("has a mark outside its photo")
        origins, along, world_from_cam = _in_world(rays, self.state)
        from_one_direction = wrong("is seen from one direction only, expected photos from different places")
        if _widest_angle_deg(along) < _MIN_TRIANGULATION_ANGLE_DEG:
            raise from_one_direction
        found = self.mark_at(name, self.state)
        if _widest_angle_deg(found.position_m - origins) < _MIN_TRIANGULATION_ANGLE_DEG:
            raise from_one_direction
        in_cam = np.einsum("kji,kj->ki", world_from_cam, found.position_m - origins)
        for k, view, at in zip(seen, rays.views, in_cam, strict=True):
            if at[2] <= 0 or not np.isfinite(pixel := view.camera.img_from_cam(at[None])[0]).all():
                raise wrong("is behind this photo's camera by the other photos: is it the same point?", k)
            off_px = float(np.linalg.norm(pixel - marker.pixels[k]))
            if off_px > _MAX_REPROJECTION * max(view.camera.width, view.camera.height):
                raise wrong(
                    f"is {off_px:.0f} px from where the other photos put it: is it the same point, or does the path "
                    "drift?",
                    k,
                )
        return found

    def is_determined(self, name: str) -> bool:
        """Return whether the marks of a marker determine a point."""
        try:
            self.find_mark(name)
        except InputError:
            return False
        return True

    def is_shown(self, name: str) -> bool:
        """Return whether a point is marked in two photos or more.

        In a map of poses without points, which drifts, its marks must also meet: nothing tells that one of them is
        wrong.
        """
        of_map = name in self.rays and len(self.rays[name].views) >= 2
        return of_map and (self.model.num_points3D() > 0 or self.is_determined(name))

    def point_of_model(self, point_id: int, pixel_stddev: float) -> MapPoint:
        """Return a 3-D point of the model, which has the smallest reprojection errors.

        Args:
            pixel_stddev: of each coordinate in each photo.
        """
        point = self.model.point3D(point_id)
        names = (self.model.image(element.image_id).name for element in point.track.elements)
        rays = self._rays_through(point.xyz, [self.views[name] for name in names])
        origins, _, world_from_cam = _in_world(rays, self.state)
        away = np.linalg.norm(point.xyz - origins, axis=1)[:, None, None]
        by_point = rays.pixel_by_point @ np.swapaxes(world_from_cam, 1, 2) / away
        information = np.swapaxes(by_point, 1, 2) @ by_point
        by_origin = np.linalg.pinv(information.sum(axis=0), hermitian=True) @ information
        return _point_of_rays(rays, self.state, point.xyz, by_origin, away * by_origin, pixel_stddev)

    def _rays_through(self, at: Array, views: Sequence[View]) -> Rays:
        """Return the rays to a place (3,) from the views that have it in front of them."""
        to_rays = _in_world(Rays(tuple(views), np.zeros((len(views), 3))), self.state)
        in_cam = np.einsum("kji,kj->ki", to_rays[2], at - to_rays[0])
        is_in_front = in_cam[:, 2] > 0
        directions = in_cam[is_in_front] / np.linalg.norm(in_cam[is_in_front], axis=1)[:, None]
        return Rays(tuple(view for view, is_shown in zip(views, is_in_front, strict=True) if is_shown), directions)

    def _middle(self, name: str, corners: list[str]) -> MapPoint:
        if len(corners) < NUM_CORNERS:
            known = f"{len(corners)} of {NUM_CORNERS} corners"
            raise InputError(f"tag {name!r} has {known} in the map: give one of them, such as {corners[0]}")
        found = [self.find_mark(corner) for corner in corners]
        by_part = _added((part, by / NUM_CORNERS) for corner in found for part, by in corner.by_part.items())
        own_m2 = np.sum([corner.own_m2 for corner in found], axis=0) / NUM_CORNERS**2
        return MapPoint(np.mean([corner.position_m for corner in found], axis=0), by_part, own_m2)

    def at(self, name: str, state: MapState) -> MapPoint:
        """Return a photo, a marker or an anchor at a state of the map."""
        if (view := self.views.get(name)) is not None:
            world_from_rig = state.poses.world_from_rig[view.keyframe]
            position = state.poses.centers[view.keyframe] + world_from_rig @ view.in_rig
            nowhere = np.zeros(3)
            by_part = dict(_by_pose_of_view(view, world_from_rig, np.eye(3), nowhere, np.zeros((3, 3))))
            return MapPoint(position, by_part, np.zeros((3, 3)))
        if name in self.markers:
            return self.mark_at(name, state)
        return MapPoint(state.blocks["anchor", name], {("anchor", name): np.eye(3)}, np.zeros((3, 3)))

    def mark_at(self, name: str, state: MapState) -> MapPoint:
        """Return a marker at a state: the block that it is, else the point with the least squared distances from rays.

        With P the projections across the rays, it solves ``sum(P) x = sum(P o)``. Its derivative is that of this
        equation.
        """
        if ("mark", name) in state.blocks:
            return MapPoint(state.blocks["mark", name], {("mark", name): np.eye(3)}, np.zeros((3, 3)))
        rays = self.rays[name]
        origins, along, _ = _in_world(rays, state)
        across = np.eye(3) - along[:, :, None] * along[:, None]
        inverse = np.linalg.inv(across.sum(axis=0))
        position = inverse @ np.einsum("kij,kj->i", across, origins)
        away = position - origins
        # With v from a ray's origin to the point, a change e of its direction d changes P v by -((d v) I + d v^T) e.
        by_direction = np.einsum("ki,ki->k", along, away)[:, None, None] * np.eye(3) + along[:, :, None] * away[:, None]
        stddev_px = self.markers[name].stddev_px
        return _point_of_rays(rays, state, position, inverse @ across, inverse @ by_direction, stddev_px)

    def linearized(
        self, state: MapState, residuals: Sequence[Array], slopes: Sequence[Sequence[tuple[Array, MapPoint]]]
    ) -> Linearization:
        """Return the linearization of g groups that depend on points, with cameras and their places in rigs held.

        Args:
            state: at which the points are. residuals: (d,) of each group.
            slopes: for each group the points on which it depends, each with the (d, 3) derivatives by it.
        """
        num, size = len(residuals), len(residuals[0]) if residuals else 1
        of_groups = [
            _added((part, by_point @ by) for by_point, point in of for part, by in point.by_part.items())
            for of in slopes
        ]
        by_keyframe = [[*self._by_keyframe(of, state)] for of in of_groups]
        most = max(map(len, by_keyframe), default=0)
        pose, by_pose = np.zeros((num, most), dtype=np.int64), np.zeros((num, size, most, 6))
        for row, of in enumerate(by_keyframe):
            for column, (keyframe, slope) in enumerate(of):
                pose[row, column], by_pose[row, :, column] = keyframe, slope
        by_block = [[((kind, str(id_)), by) for (kind, id_), by in of.items() if kind in _BLOCKS] for of in of_groups]
        blocks = tuple(dict.fromkeys(block for of in by_block for block, _ in of))
        columns = []
        for k in range(max(map(len, by_block), default=0)):
            index, values = np.full(num, -1, dtype=np.int64), np.zeros((num, size, 3))
            for row, of_row in enumerate(by_block):
                if k < len(of_row):
                    index[row], values[row] = blocks.index(of_row[k][0]), of_row[k][1]
            columns.append(ByBlock(blocks, index, values))
        return Linearization(np.array(residuals).reshape(num, size), pose, by_pose, tuple(columns))

    def _by_keyframe(self, by_part: Mapping[Part, Array], state: MapState) -> Iterator[tuple[int, Array]]:
        """Yield the keyframes among parts by index, each with derivatives by a turn in its own frame and a shift."""
        for (kind, id_), by in by_part.items():
            if kind == "frame":
                keyframe = self._index[int(id_)]
                # A turn about the rig's own axes is a turn about those of the world, turned by its rotation.
                yield keyframe, np.hstack([by[:, :3] @ state.poses.world_from_rig[keyframe], by[:, 3:]])

    @cached_property
    def _index(self) -> dict[int, int]:
        return {frame_id: k for k, frame_id in enumerate(self.frame_ids.tolist())}


def variance_along(start: Array, end: Array, covariance: Array) -> float:
    """Return the variance of the length between two places (3,) by the sum (3, 3) of their covariances."""
    along = (end - start) / max(float(np.linalg.norm(end - start)), 1e-12)
    return float(along @ covariance @ along)


def _added(slopes: Iterable[tuple[Part, Array]]) -> dict[Part, Array]:
    total: dict[Part, Array] = {}
    for part, slope in slopes:
        total[part] = total.get(part, 0.0) + slope
    return total


def _view(model: pycolmap.Reconstruction, image: pycolmap.Image, index: Mapping[int, int]) -> View:
    rig_from_cam = (image.cam_from_world() * pose_of(model.frame(image.frame_id)).inverse()).inverse()
    return View(
        index[image.frame_id],
        ("frame", image.frame_id),
        () if image.is_ref_in_frame() else (("sensor", image.camera_id),),
        model.camera(image.camera_id),
        np.array(rig_from_cam.translation),
        np.array(rig_from_cam.rotation.matrix()),
    )


def _rays_of_marks(marker: Marker, views: Mapping[str, View]) -> Rays:
    """Return the rays of the marks that are in photos of a map."""
    seen = [(views[name], at) for name, at in zip(marker.image_names, marker.pixels, strict=True) if name in views]
    in_image = np.array([np.ravel(view.camera.cam_from_img(at[None])) for view, at in seen]).reshape(-1, 2)
    in_cam = np.column_stack([in_image, np.ones(len(seen))])
    return Rays(tuple(view for view, _ in seen), in_cam / np.linalg.norm(in_cam, axis=1)[:, None])


def _in_world(rays: Rays, state: MapState) -> tuple[Array, Array, Array]:
    """Return origins and directions (k, 3) of rays, and the rotations world_from_cam (k, 3, 3)."""
    keyframes, in_rig, rig_from_cam = rays.in_rigs
    rotations = state.poses.world_from_rig[keyframes]
    world_from_cam = rotations @ rig_from_cam
    origins = state.poses.centers[keyframes] + np.einsum("kij,kj->ki", rotations, in_rig)
    return origins, np.einsum("kij,kj->ki", world_from_cam, rays.in_cam), world_from_cam


def _point_of_rays(
    rays: Rays, state: MapState, position: Array, by_origin: Array, by_direction: Array, stddev_px: float
) -> MapPoint:
    """Return a point that depends on rays.

    Args:
        by_origin, by_direction: (k, 3, 3) derivatives by the rays' origins and directions in the world.
        stddev_px: standard deviation of each coordinate of the marks.
    """
    world_from_rig = state.poses.world_from_rig
    slopes, own = list[tuple[Part, Array]](), np.zeros((3, 3))
    for k, view in enumerate(rays.views):
        rotation = world_from_rig[view.keyframe]
        slopes += _by_pose_of_view(view, rotation, by_origin[k], rays.in_cam[k], by_direction[k])
        by_in_cam = by_direction[k] @ rotation @ view.rig_from_cam
        slopes.append((("camera", view.camera.camera_id), by_in_cam @ rays.by_camera[k]))
        by_pixel = by_in_cam @ rays.by_pixel[k]
        own += by_pixel @ by_pixel.T
    return MapPoint(position, _added(slopes), stddev_px**2 * own)


def _by_pose_of_view(
    view: View, world_from_rig: Array, by_origin: Array, in_cam: Array, by_direction: Array
) -> Iterator[tuple[Part, Array]]:
    """Yield the (3, 6) derivatives of a point by the poses on which a view depends, as those of ``PartErrors``.

    Args:
        in_cam: (3,) direction of the ray. by_origin, by_direction: (3, 3) derivatives as of ``_point_of_rays``.
    """
    world_from_cam = world_from_rig @ view.rig_from_cam
    turn = by_origin @ cross_matrices(world_from_rig @ view.in_rig)
    turn += by_direction @ cross_matrices(world_from_cam @ in_cam)
    yield view.frame, np.hstack([-turn, by_origin])
    for sensor in view.sensor:
        of_origin, of_direction = by_origin @ world_from_cam, by_direction @ world_from_cam
        turn = of_origin @ cross_matrices(view.rig_from_cam.T @ view.in_rig) + of_direction @ cross_matrices(in_cam)
        yield sensor, np.hstack([turn, -of_origin])


def _widest_angle_deg(rays: Array) -> float:
    """Return the largest angle between two of (k, 3) vectors."""
    rays = rays / np.linalg.norm(rays, axis=1)[:, None]
    return float(np.rad2deg(np.arccos(np.clip(rays @ rays.T, -1, 1)).max()))


def _by_point(camera: pycolmap.Camera, in_cam: Array) -> Array:
    """Return the derivative (2, 3) of a pixel by the point in the camera."""
    step = _STEP * float(np.linalg.norm(in_cam))
    moved = in_cam + step * np.vstack([np.eye(3), -np.eye(3)])
    pixels = np.asarray(camera.img_from_cam(moved), dtype=np.float64)
    return (pixels[:3] - pixels[3:]).T / (2 * step)


def _by_params(camera: pycolmap.Camera, in_cam: Array) -> Array:
    """Return the derivative (2, p) of a pixel by the parameters of the camera."""
    slopes = np.zeros((2, len(camera.params)))
    for k, value in enumerate(camera.params.tolist()):
        step, pixels = _STEP * max(1.0, abs(value)), []
        for sign in (1, -1):
            other = pycolmap.Camera(camera.todict())
            other.params[k] = value + sign * step
            pixels.append(np.asarray(other.img_from_cam(in_cam[None]), dtype=np.float64)[0])
        slopes[:, k] = (pixels[0] - pixels[1]) / (2 * step)
    return slopes

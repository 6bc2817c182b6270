"""Points of a metric map by name, each with how it depends on the parts of the map that err."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import pycolmap
from scipy.sparse import csr_array

from rangesfm.arrays import Array
from rangesfm.errors import InputError
from rangesfm.measurements.lengths.markers import images_by_name, triangulate_marker
from rangesfm.measurements.lengths.tape import Marker
from rangesfm.util.geometry.map_errors import MapPointErrors, Part
from rangesfm.util.geometry.rotations import cross_matrices
from rangesfm.util.geometry.trajectory import Trajectory, pose_of

POINT_PREFIX = "point:"
"""Text before the number of a 3-D point of the model, as in ``point:1234``."""
NUM_CORNERS = 4
"""Number of corners of a printed tag; ``tag7`` is the mean of ``tag7.0`` to ``tag7.3``."""

_EXPECTED = "a photo that is in the map, a marker, a printed tag, an anchor with a position, or point: with an id"
# Relative step of a numeric derivative of a projection; with it, rounding and curvature both stay below 1e-8.
_STEP = 1e-5


@dataclass(frozen=True)
class MapPoint:
    """A point of a metric map.

    Attributes:
        name: as it was asked for.
        position_m: (3,) in the world of the map.
        errors: how it errs.
    """

    name: str
    position_m: Array
    errors: MapPointErrors


@dataclass(frozen=True)
class MapPoints:
    """All points of a metric map that have a name.

    Attributes:
        model: in metres.
        anchors_m: (3,) positions of anchors by id, in the world of the model.
        markers: marks in photos by name.
        pixel_stddev: standard deviation of a coordinate of a feature; NaN if it is not known.
    """

    model: pycolmap.Reconstruction
    anchors_m: Mapping[str, Array]
    markers: Mapping[str, Marker]
    pixel_stddev: float

    def find(self, name: str) -> MapPoint:
        """Return the photo of that name (its projection centre), else the marker, the tag, the anchor or the point.

        Raises:
            InputError: nothing has that name, or the marks of a marker determine no point.
        """
        if name in self._images:
            image = self._images[name]
            return MapPoint(name, image.projection_center(), self._errors_of_photo(image))
        if name in self.markers:
            return self.find_marker(name)
        if corners := [corner for k in range(NUM_CORNERS) if (corner := f"{name}.{k}") in self.markers]:
            return self._middle(name, corners)
        if name in self.anchors_m:
            shift: Mapping[Part, Array] = {("anchor", name): np.eye(3)}
            return MapPoint(name, self.anchors_m[name], MapPointErrors(shift, np.zeros((3, 3))))
        if name.startswith(POINT_PREFIX):
            return self._point(name)
        known = [*self._images, *self.markers, *self.anchors_m]
        near = difflib.get_close_matches(name, known, 1)
        raise InputError(f"{name!r} is not in the map, expected {_EXPECTED}" + (f"; near: {near[0]}" if near else ""))

    @cached_property
    def _images(self) -> dict[str, pycolmap.Image]:
        return images_by_name(self.model)

    def _errors_of_photo(self, image: pycolmap.Image) -> MapPointErrors:
        view = _View(self.model, image)
        from_rig_m = image.projection_center() - view.rig_center_m
        by_part: dict[Part, Array] = {view.frame: np.hstack([-cross_matrices(from_rig_m), np.eye(3)])}
        if view.sensor is not None:
            world_from_cam = view.world_from_rig @ view.cam_from_rig.rotation.matrix().T
            by_sensor = np.hstack([cross_matrices(view.cam_from_rig.translation), np.eye(3)])
            by_part[view.sensor] = -world_from_cam @ by_sensor
        return MapPointErrors(by_part, np.zeros((3, 3)))

    def find_marker(self, name: str) -> MapPoint:
        """Return the marker of that name; errors as for ``triangulate_marker``."""
        marker = self.markers[name]
        at = triangulate_marker(name, marker, self._images)
        images = [self._images[photo] for photo in marker.image_names if photo in self._images]
        # Triangulation counts the distances from the rays, which grow with the depth for the same error in pixels.
        return MapPoint(name, at, _errors_of_seen(self.model, images, at, marker.stddev_px, by_distance=True))

    def _middle(self, name: str, corners: list[str]) -> MapPoint:
        if len(corners) < NUM_CORNERS:
            known = f"{len(corners)} of {NUM_CORNERS} corners"
            raise InputError(f"tag {name!r} has {known} in the map: give one of them, such as {corners[0]}")
        found = [self.find_marker(corner) for corner in corners]
        parts = dict.fromkeys(part for corner in found for part in corner.errors.by_part)
        by_part = {
            part: np.sum([of.errors.by_part[part] for of in found if part in of.errors.by_part], axis=0) / NUM_CORNERS
            for part in parts
        }
        own_m2 = np.sum([of.errors.own_m2 for of in found], axis=0) / NUM_CORNERS**2
        return MapPoint(name, np.mean([of.position_m for of in found], axis=0), MapPointErrors(by_part, own_m2))

    def _point(self, name: str) -> MapPoint:
        number = name.removeprefix(POINT_PREFIX)
        if not (number.isdecimal() and self.model.exists_point3D(int(number))):
            raise InputError(f"{name!r} is not in the map, expected the id of one of its 3-D points")
        point = self.model.point3D(int(number))
        images = [self.model.image(element.image_id) for element in point.track.elements]
        return MapPoint(name, point.xyz, _errors_of_seen(self.model, images, point.xyz, self.pixel_stddev))


def by_pose(point: MapPoint, path: Trajectory) -> csr_array:
    """Return the (3, 6 n) derivatives of a point by the poses of a path: a turn in their own frame and a shift.

    Other parts of the map are held fixed.
    """
    row_of = {frame_id: row for row, frame_id in enumerate(path.frame_ids.tolist())}
    slopes = np.zeros((3, len(path), 6))
    for (kind, number), by in point.errors.by_part.items():
        if kind == "frame" and (row := row_of.get(number)) is not None:
            # A turn about the camera's own axes is a turn about those of the world, turned by its rotation.
            slopes[:, row, :3] = by[:, :3] @ path.world_from_cam[row]
            slopes[:, row, 3:] = by[:, 3:]
    return csr_array(slopes.reshape(3, -1))


class _View:
    """A photo and the parts of the map that its pose depends on."""

    def __init__(self, model: pycolmap.Reconstruction, image: pycolmap.Image) -> None:
        rig_from_world = pose_of(model.frame(image.frame_id))
        self.camera = model.camera(image.camera_id)
        self.cam_from_rig = image.cam_from_world() * rig_from_world.inverse()
        self.world_from_rig = rig_from_world.rotation.matrix().T
        self.rig_center_m: Array = -self.world_from_rig @ rig_from_world.translation
        self.frame: Part = ("frame", image.frame_id)
        self.sensor: Part | None = None if image.is_ref_in_frame() else ("sensor", image.camera_id)

    def slopes(self, at_m: Array) -> tuple[Array, dict[Part, Array], Array] | None:
        """Return how the pixel of a point moves.

        Returns:
            (2, 3) by the point, (2, d) by each part, and (2, 2) pixels by metres across the ray, in two directions;
            None if the point is not in front of the camera.
        """
        from_rig_m = at_m - self.rig_center_m
        in_rig = self.world_from_rig.T @ from_rig_m
        turn = self.cam_from_rig.rotation.matrix()
        in_cam = turn @ in_rig + self.cam_from_rig.translation
        if in_cam[2] <= 0:
            return None
        by_in_cam = _by_point(self.camera, in_cam)
        by_point = by_in_cam @ turn @ self.world_from_rig.T
        by_part: dict[Part, Array] = {self.frame: np.hstack([by_point @ cross_matrices(from_rig_m), -by_point])}
        if self.sensor is not None:
            by_part[self.sensor] = np.hstack([-by_in_cam @ cross_matrices(turn @ in_rig), by_in_cam])
        by_part[("camera", self.camera.camera_id)] = _by_params(self.camera, in_cam)
        across_ray = np.linalg.svd(in_cam[None])[2][1:].T
        return by_point, by_part, by_in_cam @ across_ray


def _errors_of_seen(
    model: pycolmap.Reconstruction,
    images: list[pycolmap.Image],
    at_m: Array,
    pixel_stddev: float,
    *,
    by_distance: bool = False,
) -> MapPointErrors:
    """Return how a point that is found from photos errs.

    Args:
        model: metric model.
        images: photos that see the point.
        at_m: (3,) its position.
        pixel_stddev: of each coordinate in each photo.
        by_distance: whether the point has the least squared distance from the rays, and not in pixels.
    """
    information, noise = np.zeros((3, 3)), np.zeros((3, 3))
    pulls: dict[Part, Array] = {}
    for view in (_View(model, image) for image in images):
        if (slopes := view.slopes(at_m)) is None:
            continue
        by_point, by_part, across_ray = slopes
        weighted = by_point.T @ (np.linalg.inv(across_ray @ across_ray.T) if by_distance else np.eye(2))
        information += weighted @ by_point
        noise += weighted @ weighted.T
        for part, slope in by_part.items():
            pulls[part] = pulls.get(part, 0.0) + weighted @ slope
    inverse = np.linalg.pinv(information, hermitian=True)
    own_m2 = pixel_stddev**2 * inverse @ noise @ inverse
    return MapPointErrors({part: -inverse @ pull for part, pull in pulls.items()}, own_m2)


def _by_point(camera: pycolmap.Camera, in_cam: Array) -> Array:
    """Return the derivative (2, 3) of a pixel by the point in the camera."""
    step = _STEP * float(np.linalg.norm(in_cam))
    moved = in_cam + step * np.vstack([np.eye(3), -np.eye(3)])
    pixels = np.asarray(camera.img_from_cam(moved), dtype=np.float64)
    return (pixels[:3] - pixels[3:]).T / (2 * step)


def _by_params(camera: pycolmap.Camera, in_cam: Array) -> Array:
    """Return the derivative (2, k) of a pixel by the parameters of the camera."""
    slopes = np.zeros((2, len(camera.params)))
    for k, value in enumerate(camera.params.tolist()):
        step, pixels = _STEP * max(1.0, abs(value)), []
        for sign in (1, -1):
            other = pycolmap.Camera(camera.todict())
            other.params[k] = value + sign * step
            pixels.append(np.asarray(other.img_from_cam(in_cam[None]), dtype=np.float64)[0])
        slopes[:, k] = (pixels[0] - pixels[1]) / (2 * step)
    return slopes

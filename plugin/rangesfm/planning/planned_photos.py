"""Photos of a planned survey: how far the map will bend, before and after the ranges straighten it.

Points are scattered in front of the camera. They are eliminated as in the keyframe graph of the refinement, and the
remaining information connects neighbouring keyframes.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Annotated

import numpy as np
import numpy.typing as npt
import pycolmap
from pydantic import AfterValidator, Field

from rangesfm.arrays import Array, Indices, Mask
from rangesfm.errors import GeometryError
from rangesfm.estimation.vision_information import Rays, VisionInformation, vision_information
from rangesfm.measurements.lengths.tape import Marker
from rangesfm.measurements.points import NamedPoints
from rangesfm.measurements.positions.control_points import ControlPoint, ControlPoints, locate_points
from rangesfm.measurements.positions.known_positions import KnownPositions
from rangesfm.option_model import Key, Options
from rangesfm.util.geometry.poses import Poses
from rangesfm.util.geometry.trajectory import Trajectory

MAX_NUM_PHOTOS = 2000
"""Largest number of photos; more would take minutes, and with fewer photos the path bends in the same way."""
# Height of a photo over its width.
_HEIGHT = 2 / 3
# Number of points in the computation, where each may stand for several; smallest number per photo; number of times that
# a point which no other photo sees is drawn again.
_NUM_COMPUTED, _LEAST_COMPUTED, _NUM_ROUNDS = 20_000, 40, 5
# A point is found again later if it is seen from a direction within 30 degrees, at a distance within a factor of 2.
_SAME_LOOK, _SAME_SIZE = np.cos(np.deg2rad(30.0)), 2.0


def ascending(ends: tuple[float, float]) -> tuple[float, float]:
    if not ends[0] < ends[1]:
        raise ValueError("are not ascending")
    return ends


_Distance = Annotated[float, Field(ge=0.01, le=1e4)]


class PlannedPhotos(Options, table="photos"):
    """Field of view and features of the camera; without this table the map is assumed to be rigid."""

    field_of_view_deg: Annotated[float, Field(ge=5, le=170)] = 65.0
    """Horizontal field of view."""
    seen_m: Annotated[
        Annotated[tuple[_Distance, _Distance], Field(strict=False), AfterValidator(ascending)],
        Key(expected="a list of 2 distances, the larger one last"),
    ] = (1.5, 8.0)
    """Distances of the nearest and the farthest points that the camera sees, in metres."""
    num_points: Annotated[int, Field(ge=8, le=100_000)] = 200
    """Number of points of the map in each photo."""
    num_photos_of_point: Annotated[int, Field(ge=2, le=1000)] = 8
    """Largest number of successive photos in which a point is found."""
    closes_loops: bool = False
    """True if a point is found again later, from about the same direction and distance."""
    feature_stddev: Annotated[float, Field(ge=1e-6, le=0.1)] = 0.0005
    """Standard deviation of each coordinate of a feature, as a fraction of a photo's width."""

    @property
    def _half_width(self) -> float:
        """Half the width of what a photo shows, at a depth of 1."""
        return float(np.tan(np.deg2rad(self.field_of_view_deg / 2)))

    def information(self, path: Trajectory) -> VisionInformation:
        """Return the information of the photos about the keyframes' poses, given the path.

        Raises:
            GeometryError: no two photos see the same point.
        """
        observations = self.observations(path)
        if not len(observations.point):
            raise GeometryError("[photos] no two photos see the same point: expected a larger seen_m or photo_rate_hz")
        return vision_information(observations, Poses(path.world_from_cam, path.centers))

    def observations(self, path: Trajectory) -> Rays:
        """Simulate observations, without errors, of points that fill each photo of a path.

        The points are uniform over the photo and over the logarithm of depth. They are few, so that each may stand for
        several.
        """
        rng = np.random.default_rng(0)
        num = min(self.num_points, max(_NUM_COMPUTED // len(path), _LEAST_COMPUTED))
        wanted = np.full(len(path), num)
        points: list[Array] = []
        seen_by: list[Indices] = []
        for frame in range(len(path)):
            for _ in range(_NUM_ROUNDS):
                if not wanted[frame]:
                    break
                new = self._scattered(path, frame, int(wanted[frame]), rng)
                for point, by in zip(new, self._photos_of(path, frame, new), strict=True):
                    by = by[wanted[by] > 0]
                    if len(by) > 1 and by[0] == frame:
                        wanted[by] -= 1
                        points.append(point)
                        seen_by.append(by)
        return self._as_rays(path, np.array(points).reshape(-1, 3), seen_by, self.num_points / num)

    def marks_of(self, path: Trajectory, points: Sequence[ControlPoint]) -> KnownPositions:
        """Return points as a run finds them in the map, from marks in evenly chosen photos that show them.

        Each is marked in up to ``num_photos_of_point`` photos, as exactly as features are found. Points that no two
        photos show from different directions are left out.
        """
        width_px = 1 / self.feature_stddev
        camera = pycolmap.Camera(
            camera_id=1,
            model="SIMPLE_PINHOLE",
            width=round(width_px),
            height=round(_HEIGHT * width_px),
            params=[width_px / (2 * self._half_width), width_px / 2, _HEIGHT * width_px / 2],
        )
        model, markers = pycolmap.Reconstruction(), dict[str, Marker]()
        model.add_camera_with_trivial_rig(camera)
        numbered = replace(path, frame_ids=np.arange(1, len(path) + 1))
        for photo, name in enumerate(path.image_names):
            rotation = path.world_from_cam[photo].T
            cam_from_world = pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), -rotation @ path.centers[photo])
            image = pycolmap.Image(name=name, camera_id=1, image_id=photo + 1)
            model.add_image_with_trivial_frame(image, cam_from_world)
        for point in points:
            in_cam = np.einsum("nji,nj->ni", path.world_from_cam, point.position_m - path.centers)
            shown = np.flatnonzero(self._shows(in_cam))
            num = min(len(shown), self.num_photos_of_point)
            photos = shown[np.linspace(0, len(shown) - 1, num).astype(np.int64)]
            pixels = np.array([camera.img_from_cam(in_cam[photo]) for photo in photos.tolist()]).reshape(-1, 2)
            names = tuple(path.image_names[photo] for photo in photos.tolist())
            markers[point.name] = Marker(names, pixels, (0,) * max(len(photos), 1))
        found = NamedPoints.in_model(model, markers)
        shown_points = tuple(point for point in points if found.is_determined(point.name))
        return locate_points(ControlPoints(shown_points, markers), model, numbered)

    def aside(self, path: Trajectory, photos: Indices) -> Array:
        """Return points (2 k, 3) at a middle distance, half-way to the left and right edge of each of k photos.

        A point straight ahead is seen from one direction only while the camera walks towards it.
        """
        ahead_m = float(np.sqrt(self.seen_m[0] * self.seen_m[1]))
        right, forward = path.world_from_cam[photos, :, 0], path.world_from_cam[photos, :, 2]
        sides = [forward + side * self._half_width / 2 * right for side in (-1, 1)]
        return np.vstack([path.centers[photos] + ahead_m * side for side in sides])

    def num_showing(self, path: Trajectory, places_m: Array) -> Indices:
        """Return how many photos of a path show each of the points (k, 3)."""
        off = places_m[:, None] - path.centers
        in_cam = np.einsum("nji,knj->kni", path.world_from_cam, off).reshape(-1, 3)
        return np.asarray(self._shows(in_cam).reshape(len(places_m), -1).sum(axis=1), dtype=np.int64)

    def _shows(self, in_cam: Array) -> Mask:
        """Return whether photos show points (n, 3) in the axes of their cameras."""
        distance = np.linalg.norm(in_cam, axis=1)
        return np.asarray(self._is_in_view(in_cam) & (distance >= self.seen_m[0]) & (distance <= self.seen_m[1]))

    def _is_in_view(self, in_cam: Array) -> Mask:
        """Return whether points (..., 3) in the axes of a camera are before it and within its field of view."""
        x, y, depth = np.moveaxis(in_cam, -1, 0)
        return np.asarray((np.abs(x) < self._half_width * depth) & (np.abs(y) < _HEIGHT * self._half_width * depth))

    def _scattered(self, path: Trajectory, frame: int, num: int, rng: np.random.Generator) -> Array:
        near, far = self.seen_m
        depths = near * (far / near) ** rng.random(num)
        across = self._half_width * rng.uniform(-1, 1, (num, 2)) * [1.0, _HEIGHT]
        in_cam = depths[:, None] * np.column_stack([across, np.ones(num)])
        return np.asarray(path.centers[frame] + in_cam @ path.world_from_cam[frame].T)

    def _photos_of(self, path: Trajectory, frame: int, points: Array) -> Iterator[Indices]:
        """Yield, for each of the points (k, 3) first seen in photo ``frame``, the photos that find it, in order."""
        photos = np.arange(frame, len(path) if self.closes_loops else min(frame + self.num_photos_of_point, len(path)))
        off = points[:, None] - path.centers[photos]
        in_cam = np.einsum("nji,knj->kni", path.world_from_cam[photos], off)
        distance, found = np.linalg.norm(off, axis=2), self._is_in_view(in_cam)
        looks_alike = np.einsum("kni,ki->kn", off, off[:, 0]) > _SAME_LOOK * distance * distance[:, :1]
        looks_alike &= np.abs(np.log(distance / distance[:, :1])) < np.log(_SAME_SIZE)
        is_first_run = np.logical_and.accumulate(found, axis=1)
        found &= is_first_run | (looks_alike if self.closes_loops else False)
        for row in found:
            yield photos[row & _in_runs(row, self.num_photos_of_point)]

    def _as_rays(self, path: Trajectory, points: Array, seen_by: list[Indices], num_alike: float) -> Rays:
        point = np.repeat(np.arange(len(points)), [len(by) for by in seen_by])
        frame = np.concatenate([*seen_by, np.zeros(0, dtype=np.int64)]).astype(np.int64)
        in_cam = np.einsum("nji,nj->ni", path.world_from_cam[frame], points[point] - path.centers[frame])
        root_information = np.sqrt(num_alike) / (self.feature_stddev * 2 * self._half_width)
        return Rays(
            frame,
            point,
            in_cam[:, :2] / in_cam[:, 2:],
            np.full(len(frame), root_information),
            np.tile(np.eye(3), (len(frame), 1, 1)),
            np.zeros((len(frame), 3)),
            points,
            np.arange(len(points)),
        )


def _in_runs(found: npt.NDArray[np.bool_], longest: int) -> npt.NDArray[np.bool_]:
    """Return which photos are among the first ``longest`` of an uninterrupted run of photos that find a point."""
    index = np.arange(len(found))
    since = index - np.maximum.accumulate(np.where(found, -1, index))
    return since <= longest

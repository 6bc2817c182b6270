"""Markers of people in photos, found in a model as points with the errors of their marks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import pycolmap

from rangesfm.arrays import Array
from rangesfm.errors import InputError
from rangesfm.measurements.lengths.tape import Marker, Tape

# Largest distance of a mark from its reprojected marker, as a fraction of the photo's longer side. A mark farther off
# belongs to another point.
_MAX_REPROJECTION = 0.02
# Smallest angle between the rays to a marker.
_MIN_TRIANGULATION_ANGLE_DEG = 0.5


def images_by_name(model: pycolmap.Reconstruction) -> dict[str, pycolmap.Image]:
    """Return the model's photos with a pose, by name."""
    return {image.name: image for image in model.images.values() if image.has_pose}


def triangulate_markers(tape: Tape, model: pycolmap.Reconstruction) -> dict[str, Array]:
    """Return the position (3,) of each marker that is an end of a length, by name; errors like ``locate_distances``."""
    images, wanted = images_by_name(model), tape.end_markers
    return {name: triangulate_marker(name, marker, images) for name, marker in wanted.items()}


def triangulate_marker(name: str, marker: Marker, images: Mapping[str, pycolmap.Image]) -> Array:
    """Return the position of a marker (3,) in the model's world, from the photos that are in the model.

    It is the point that is nearest to the rays of the marks.

    Raises:
        InputError: the marks are too few, seen from one direction only, or not of one point.
    """

    def wrong(what: str, k: int = 0) -> InputError:
        return InputError(f"marker {name!r} {what}", marker.path, marker.lines[k])

    seen = [k for k, image_name in enumerate(marker.image_names) if image_name in images]
    if len(seen) < 2:
        raise wrong(f"is marked in {len(seen)} photos of the model, expected two or more")
    views = [images[marker.image_names[k]] for k in seen]
    in_cam = [_camera(view).cam_from_img(marker.pixels[k]) for k, view in zip(seen, views, strict=True)]
    if any(at is None for at in in_cam):
        raise wrong("has a mark outside its photo")
    rays = np.array([[*np.ravel(at), 1.0] for at in in_cam if at is not None])
    rays /= np.linalg.norm(rays, axis=1)[:, None]
    # Relative to the first camera, because linear triangulation far from the origin loses half of its digits.
    origin = views[0].projection_center()
    relative = pycolmap.triangulate_multi_view_point([_cam_from_world_at(origin, view) for view in views], rays)
    point = None if relative is None else np.ravel(relative) + origin
    if point is None or _widest_angle_deg(point, views) < _MIN_TRIANGULATION_ANGLE_DEG:
        raise wrong("is seen from one direction only, expected photos from different places")
    for k, view in zip(seen, views, strict=True):
        camera, seen_at = _camera(view), view.project_point(point)
        if seen_at is None:
            raise wrong("is behind this photo's camera by the other photos: is it the same point?", k)
        off_px = float(np.linalg.norm(seen_at - marker.pixels[k]))
        if off_px > _MAX_REPROJECTION * max(camera.width, camera.height):
            raise wrong(
                f"is {off_px:.0f} px from where the other photos put it: is it the same point, or does the path drift?",
                k,
            )
    return point


def mark_covariance(marker: Marker, point: Array, images: Mapping[str, pycolmap.Image]) -> Array:
    """Return the covariance (3, 3) of a marker's position due to the errors of its marks, in the model's unit."""
    if marker.stddev_px == 0:
        return np.zeros((3, 3))
    information = np.zeros((3, 3))
    for view in (images[name] for name in marker.image_names if name in images):
        step = 1e-4 * float(np.linalg.norm(point - view.projection_center()))
        moved = [view.project_point(point + by) for by in step * np.vstack([np.eye(3), -np.eye(3)])]
        if all(at is not None for at in moved):
            plus, minus = np.array(moved, dtype=np.float64).reshape(2, 3, 2)
            slopes = (plus - minus) / (2 * step)
            information += slopes @ slopes.T / marker.stddev_px**2
    return np.asarray(np.linalg.pinv(information, hermitian=True))


def variance_along(start: Array, end: Array, covariance: Array) -> float:
    """Return the variance of the length between two places (3,) by the sum (3, 3) of their covariances."""
    along = (end - start) / max(float(np.linalg.norm(end - start)), 1e-12)
    return float(along @ covariance @ along)


def locatable(tape: Tape, model: pycolmap.Reconstruction) -> Tape:
    """Return the tape without tags that have a corner which cannot be triangulated.

    Markers set by hand are kept, so that the user is told what is wrong with them.
    """
    images, lost = images_by_name(model), set[str]()
    for name, marker in tape.found_markers.items():
        try:
            triangulate_marker(name, marker, images)
        except InputError:
            lost.add(name)
    kept = (taped for taped in tape.distances if not (taped.is_printed and lost.intersection(taped.ends)))
    return replace(tape, distances=tuple(kept))


def _cam_from_world_at(origin: Array, image: pycolmap.Image) -> Array:
    """Return cam_from_world (3, 4) for a world whose origin is moved to ``origin``."""
    pose = image.cam_from_world().matrix()
    pose[:, 3] += pose[:, :3] @ origin
    return pose


def _camera(image: pycolmap.Image) -> pycolmap.Camera:
    camera = image.camera
    if camera is None:
        raise ValueError(f"image {image.name} has no camera")
    return camera


def _widest_angle_deg(point: Array, views: Sequence[pycolmap.Image]) -> float:
    rays = np.array([view.projection_center() for view in views]) - point
    rays /= np.linalg.norm(rays, axis=1)[:, None]
    return float(np.rad2deg(np.arccos(np.clip(rays @ rays.T, -1, 1)).max()))

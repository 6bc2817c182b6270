"""Cameras that somebody calibrated: as OpenCV, Kalibr and ROS describe them, and for photos of several sizes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rangesfm.errors import InputError
from rangesfm.options import CameraOptions

if TYPE_CHECKING:
    import pycolmap

Size = tuple[int, int]

# To OpenCV, and so to Kalibr and ROS, the centre of the first pixel is (0, 0); to COLMAP it is (0.5, 0.5).
_CORNER_PX = 0.5
# COLMAP's model and how many parameters it has beside fx, fy, cx, cy.
_MODELS = {
    "none": ("PINHOLE", 0),
    "radtan": ("OPENCV", 4),
    "plumb_bob": ("OPENCV", 4),
    "rational_polynomial": ("FULL_OPENCV", 8),
    "equidistant": ("OPENCV_FISHEYE", 4),
    "fisheye": ("OPENCV_FISHEYE", 4),
}


def colmap_camera(
    distortion: str, pinhole: Iterable[float], coefficients: Iterable[float], path: Path
) -> tuple[str, tuple[float, ...]]:
    """COLMAP's name of the model and its parameters; InputError, with the path, if COLMAP has no such model.

    Args:
        distortion: the model's name in Kalibr or ROS.
        pinhole: fx, fy, cx, cy in pixels.
    """
    if distortion not in _MODELS:
        raise InputError(f"distortion_model is '{distortion}', expected one of {', '.join(_MODELS)}", path)
    model, num = _MODELS[distortion]
    given = [*map(float, coefficients)]
    if model == "OPENCV" and any(given[num:]):  # a third radial coefficient
        model, num = "FULL_OPENCV", 8
    fx, fy, cx, cy = map(float, pinhole)
    return model, (fx, fy, cx + _CORNER_PX, cy + _CORNER_PX, *[*given, *[0.0] * num][:num])


def calibrated_cameras(model: str, params: Sequence[float], sizes: Iterable[Size]) -> dict[Size, pycolmap.Camera]:
    """The given camera for each size (pixels) of photos that it can have: the most common, and the same rescaled."""
    import pycolmap  # slow to load, and of no use to who only looks for cameras in files

    counted = Counter(sizes)
    own, _ = max(counted.items(), key=lambda item: (item[1], item[0]))
    given = pycolmap.Camera.create_from_model_name(pycolmap.INVALID_CAMERA_ID, model, 1.0, *own)
    given.params = list(params)
    given.has_prior_focal_length = True
    cameras = {}
    for width, height in counted:
        if abs(width * own[1] - height * own[0]) <= max(own):  # the same shape, but for a rounded pixel
            cameras[width, height] = pycolmap.Camera(given.todict())
            cameras[width, height].rescale(width, height)
    return cameras


def cameras_as_given(
    options: CameraOptions, camera_of_photo: Iterable[tuple[str, pycolmap.Camera]]
) -> dict[int, tuple[CameraOptions, pycolmap.Camera]]:
    """By id, those whose parameters are known: the table that they are in, and the camera with just these.

    Args:
        camera_of_photo: each photo's name and camera.
    """
    found: dict[int, tuple[CameraOptions, pycolmap.Camera]] = {}
    sizes: dict[int, list[Size]] = {}  # of each table's photos
    for name, camera in camera_of_photo:
        table, _ = found.setdefault(camera.camera_id, (options.of_photo(name), camera))
        sizes.setdefault(id(table), []).append((camera.width, camera.height))
    given = {}
    for camera_id, (table, camera) in found.items():
        if table.model is not None and table.params is not None:
            same_size = calibrated_cameras(table.model, table.params, sizes[id(table)]).get(
                (camera.width, camera.height)
            )
            if same_size is not None and same_size.model == camera.model:
                given[camera_id] = table, same_size
    return given

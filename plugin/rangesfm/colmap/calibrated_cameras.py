"""Calibrated cameras: conversion from OpenCV, Kalibr and ROS, and scaling to photos of several sizes."""

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

# The centre of the first pixel is (0, 0) in OpenCV, Kalibr and ROS, and (0.5, 0.5) in COLMAP.
_CORNER_PX = 0.5
# COLMAP's model for each distortion model, and its number of parameters after fx, fy, cx, cy.
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
) -> CameraOptions:
    """Return a calibrated camera as COLMAP's model with its parameters.

    Args:
        distortion: the distortion model's name in Kalibr or ROS.
        pinhole: fx, fy, cx, cy in pixels, in OpenCV's convention.
        path: the file that they are from, for messages.

    Raises:
        InputError: COLMAP has no such model, or a parameter is out of bounds.
    """
    if distortion not in _MODELS:
        raise InputError(f"distortion_model is '{distortion}', expected one of {', '.join(_MODELS)}", path)
    model, num = _MODELS[distortion]
    given = [*map(float, coefficients)]
    if model == "OPENCV" and any(given[num:]):  # there is a third radial coefficient
        model, num = "FULL_OPENCV", 8
    fx, fy, cx, cy = map(float, pinhole)
    params = (fx, fy, cx + _CORNER_PX, cy + _CORNER_PX, *[*given, *[0.0] * num][:num])
    return CameraOptions(model=model, params=params)


def calibrated_cameras(model: str, params: Sequence[float], sizes: Iterable[Size]) -> dict[Size, pycolmap.Camera]:
    """Return the given camera for each photo size (width and height in pixels) that it fits.

    The parameters belong to the most common size. Sizes of the same shape get a rescaled camera, other sizes none.
    """
    import pycolmap  # imported here because it is slow to load, and is not needed for reading calibration files

    counted = Counter(sizes)
    own, _ = max(counted.items(), key=lambda item: (item[1], item[0]))
    given = pycolmap.Camera.create_from_model_name(pycolmap.INVALID_CAMERA_ID, model, 1.0, *own)
    given.params = list(params)
    given.has_prior_focal_length = True
    cameras = {}
    for width, height in counted:
        if abs(width * own[1] - height * own[0]) <= max(own):  # the same shape, up to a rounded pixel
            cameras[width, height] = pycolmap.Camera(given.todict())
            cameras[width, height].rescale(width, height)
    return cameras


def cameras_as_given(
    options: CameraOptions, camera_of_photo: Iterable[tuple[str, pycolmap.Camera]]
) -> dict[int, tuple[CameraOptions, pycolmap.Camera]]:
    """Return, by camera id, each camera whose parameters the user gave: its table and the camera with those parameters.

    Args:
        camera_of_photo: each photo's name and camera.
    """
    found: dict[int, tuple[CameraOptions, pycolmap.Camera]] = {}
    sizes: dict[int, list[Size]] = {}  # sizes of each table's photos, by the table's identity
    for name, camera in camera_of_photo:
        table, _ = found.setdefault(camera.camera_id, (options.of_photo(name), camera))
        sizes.setdefault(id(table), []).append((camera.width, camera.height))
    given = {}
    for camera_id, (table, camera) in found.items():
        if table.model and table.params:
            same_size = calibrated_cameras(table.model, table.params, sizes[id(table)]).get(
                (camera.width, camera.height)
            )
            if same_size is not None and same_size.model == camera.model:
                given[camera_id] = table, same_size
    return given

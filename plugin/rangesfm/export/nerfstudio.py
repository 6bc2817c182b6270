"""Cameras as nerfstudio reads them: ``transforms.json`` with the map's points beside it.

nerfstudio's cameras look along their -z with y up, and its worlds have z up. Its own loader centres and shrinks
what it reads unless it is told not to (``--auto-scale-poses False --center-method none --orientation-method none``).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from rangesfm.arrays import Array
from rangesfm.errors import InputError
from rangesfm.export.metric_map import MetricMap, distortion_params
from rangesfm.export.ply import write_points
from rangesfm.files.json_files import write_json

_POINTS_NAME = "transforms_points.ply"
# By COLMAP's camera model: nerfstudio's name, and what the parameters after focal lengths and principal point are.
_DISTORTION = {
    "SIMPLE_PINHOLE": ("OPENCV", ()),
    "PINHOLE": ("OPENCV", ()),
    "SIMPLE_RADIAL": ("OPENCV", ("k1",)),
    "RADIAL": ("OPENCV", ("k1", "k2")),
    "OPENCV": ("OPENCV", ("k1", "k2", "p1", "p2")),
    "FULL_OPENCV": ("OPENCV", ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")),
    "SIMPLE_RADIAL_FISHEYE": ("OPENCV_FISHEYE", ("k1",)),
    "RADIAL_FISHEYE": ("OPENCV_FISHEYE", ("k1", "k2")),
    "OPENCV_FISHEYE": ("OPENCV_FISHEYE", ("k1", "k2", "k3", "k4")),
}
_FLIP_Y_AND_Z = np.diag([1.0, -1.0, -1.0, 1.0])


def write_nerfstudio(map_: MetricMap, folder: Path) -> Path:
    """Write ``transforms.json`` and its points; photos are referred to as ``images/NAME``.

    Raises:
        InputError: a camera model that nerfstudio does not know.
    """
    points = write_points(map_.reconstruction, folder / _POINTS_NAME)
    images = sorted((i for i in map_.reconstruction.images.values() if i.has_pose), key=lambda image: image.name)
    content = {
        "applied_transform": np.eye(4)[:3].tolist(),
        "ply_file_path": points.name,
        "frames": [_frame(map_.reconstruction.cameras[image.camera_id], image) for image in images],
    }
    path = folder / "transforms.json"
    write_json(content, path)
    return path


def _frame(camera: pycolmap.Camera, image: pycolmap.Image) -> dict[str, Any]:
    return {
        "file_path": f"images/{image.name}",
        "transform_matrix": _world_from_opengl(image).tolist(),
        **_intrinsics(camera),
    }


def _world_from_opengl(image: pycolmap.Image) -> Array:
    world_from_cam = np.eye(4)
    world_from_cam[:3] = image.cam_from_world().inverse().matrix()
    turned: Array = world_from_cam @ _FLIP_Y_AND_Z
    return turned


def _intrinsics(camera: pycolmap.Camera) -> dict[str, Any]:
    name = camera.model.name
    if name not in _DISTORTION:
        raise InputError(f"nerfstudio does not know the camera model {name}, expected one of: {', '.join(_DISTORTION)}")
    kind, names = _DISTORTION[name]
    return {
        "camera_model": kind,
        "w": camera.width,
        "h": camera.height,
        "fl_x": camera.focal_length_x,
        "fl_y": camera.focal_length_y,
        "cx": camera.principal_point_x,
        "cy": camera.principal_point_y,
        **dict(zip(names, distortion_params(camera), strict=True)),
    }

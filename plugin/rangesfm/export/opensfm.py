"""The map as OpenSfM (and so OpenDroneMap) keeps it: ``reconstruction.json``.

OpenSfM measures in photos in units of their longer side, from the photo's middle, and turns by rotation vectors.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pycolmap
from scipy.spatial.transform import Rotation

from rangesfm.errors import InputError
from rangesfm.export.metric_map import MetricMap, distortion_params
from rangesfm.files.json_files import write_json

# By COLMAP's camera model: OpenSfM's projection, and the names of the distortion parameters.
_PROJECTIONS = {
    "SIMPLE_PINHOLE": ("brown", ()),
    "PINHOLE": ("brown", ()),
    "SIMPLE_RADIAL": ("brown", ("k1",)),
    "RADIAL": ("brown", ("k1", "k2")),
    "OPENCV": ("brown", ("k1", "k2", "p1", "p2")),
    "OPENCV_FISHEYE": ("fisheye_opencv", ("k1", "k2", "k3", "k4")),
}
_ALL_DISTORTION = {"brown": ("k1", "k2", "k3", "p1", "p2"), "fisheye_opencv": ("k1", "k2", "k3", "k4")}


def write_opensfm(map_: MetricMap, path: Path) -> Path:
    """Write one reconstruction with its cameras, shots and points; ``reference_lla`` where the map is georeferenced.

    Raises:
        InputError: a camera model that OpenSfM does not know.
    """
    model = map_.reconstruction
    images = sorted((image for image in model.images.values() if image.has_pose), key=lambda image: image.name)
    reconstruction: dict[str, Any] = {
        "cameras": {str(i): _camera(model.cameras[i]) for i in sorted({image.camera_id for image in images})},
        "shots": {image.name: _shot(image, map_) for image in images},
        "points": {str(i): _point(model.point3D(i)) for i in sorted(model.point3D_ids())},
    }
    if map_.georeference is not None:
        origin = map_.georeference
        reconstruction["reference_lla"] = {
            "latitude": origin.lat_deg,
            "longitude": origin.lon_deg,
            "altitude": origin.height_m,
        }
    write_json([reconstruction], path)
    return path


def _camera(camera: pycolmap.Camera) -> dict[str, Any]:
    name = camera.model.name
    if name not in _PROJECTIONS:
        raise InputError(f"OpenSfM does not know the camera model {name}, expected one of: {', '.join(_PROJECTIONS)}")
    projection, names = _PROJECTIONS[name]
    size = max(camera.width, camera.height)
    return {
        "projection_type": projection,
        "width": camera.width,
        "height": camera.height,
        "focal_x": camera.focal_length_x / size,
        "focal_y": camera.focal_length_y / size,
        "c_x": (camera.principal_point_x - camera.width / 2) / size,
        "c_y": (camera.principal_point_y - camera.height / 2) / size,
        **dict.fromkeys(_ALL_DISTORTION[projection], 0.0),
        **dict(zip(names, distortion_params(camera), strict=True)),
    }


def _shot(image: pycolmap.Image, map_: MetricMap) -> dict[str, Any]:
    cam_from_world = image.cam_from_world()
    shot = {
        "camera": str(image.camera_id),
        "rotation": Rotation.from_matrix(cam_from_world.rotation.matrix()).as_rotvec().tolist(),
        "translation": cam_from_world.translation.tolist(),
        "orientation": 1,
    }
    time = None if map_.timestamps_s is None else map_.timestamps_s.get(image.name)
    return shot if time is None else {**shot, "capture_time": time}


def _point(point: pycolmap.Point3D) -> dict[str, Any]:
    return {"color": [float(channel) for channel in point.color], "coordinates": point.xyz.tolist()}

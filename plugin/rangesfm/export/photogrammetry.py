"""Cameras and map as other photogrammetry programs have them: nerfstudio, OpenSfM, the Open Photogrammetry Format."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from scipy.spatial.transform import Rotation

from rangesfm.arrays import Array
from rangesfm.errors import InputError
from rangesfm.export.metric_map import MetricMap, distortion_params
from rangesfm.export.ply import write_points
from rangesfm.files.atomic import new_folder
from rangesfm.files.records import write_json

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


_NUM_CONSTRAINTS = 10
_MIN_TRACK_LENGTH = 3
# Of marks that a feature detector made; a person's click is of 1.
_MARK_ACCURACY = 1.0


def write_opf(map_: MetricMap, folder: Path) -> Path:
    """Write ``camera_list.json``, ``input_control_points.json`` and ``constraints.json`` into ``folder``.

    Raises:
        InputError: the map has no two points that three photos see, or its scale's stddev is not known.
    """
    model, stddev = map_.reconstruction, map_.relative_scale_stddev
    if stddev is None:
        raise InputError("the format 'opf' needs the stddev of the scale, which is not known of this model")
    pairs = _distant_pairs(model)
    point_ids = [point_id for pair in pairs for point_id in pair]
    files = {
        "camera_list.json": _file("camera-list", cameras=_cameras(model)),
        "input_control_points.json": _file(
            "input-control-points", gcps=[], mtps=[_tie_point(model, point_id) for point_id in point_ids]
        ),
        "constraints.json": _file(
            "constraints",
            scale_constraints=[_constraint(model, number, pair, stddev) for number, pair in enumerate(pairs)],
            orientation_constraints=[],
        ),
    }
    with new_folder(folder) as temporary:
        for name, content in files.items():
            write_json(content, temporary / name)
    return folder


def _file(kind: str, **content: Any) -> dict[str, Any]:
    return {"format": f"application/opf-{kind}+json", "version": "1.0", **content}


def _distant_pairs(model: pycolmap.Reconstruction) -> list[tuple[int, int]]:
    """Pairs of points that many photos see, far from each other; each point in one pair only."""
    seen = sorted(
        (i for i, point in model.points3D.items() if point.track.length() >= _MIN_TRACK_LENGTH),
        key=lambda i: (-model.point3D(i).track.length(), i),
    )[: 20 * _NUM_CONSTRAINTS]
    if len(seen) < 2:
        raise InputError("the format 'opf' needs two points that three photos see, and the map has none")
    places = np.array([model.point3D(i).xyz for i in seen])
    pairs: list[tuple[int, int]] = []
    left = np.ones(len(seen), dtype=bool)
    while left.sum() >= 2 and len(pairs) < _NUM_CONSTRAINTS:
        first = int(np.argmax(left))
        left[first] = False
        second = int(np.argmax(np.where(left, np.linalg.norm(places - places[first], axis=1), -1.0)))
        left[second] = False
        pairs.append((seen[first], seen[second]))
    return pairs


def _cameras(model: pycolmap.Reconstruction) -> list[dict[str, Any]]:
    return [
        {"id": _uid(image.name), "uri": image.name} for image in sorted(model.images.values(), key=lambda i: i.name)
    ]


def _uid(name: str) -> int:
    """64 bits that depend on the photo's name alone."""
    return int.from_bytes(hashlib.blake2b(name.encode(), digest_size=8).digest(), "big")


def _tie_point(model: pycolmap.Reconstruction, point_id: int) -> dict[str, Any]:
    marks = []
    for element in model.point3D(point_id).track.elements:
        image = model.image(element.image_id)
        at = image.points2D[element.point2D_idx].xy
        marks.append({"camera_id": _uid(image.name), "position_px": at.tolist(), "accuracy": _MARK_ACCURACY})
    return {"id": f"point{point_id}", "marks": marks, "is_checkpoint": False}


def _constraint(
    model: pycolmap.Reconstruction, number: int, pair: tuple[int, int], relative_stddev: float
) -> dict[str, Any]:
    first, second = (model.point3D(point_id).xyz for point_id in pair)
    distance = float(np.linalg.norm(first - second))
    return {
        "id": f"distance{number}",
        "id_from": f"point{pair[0]}",
        "id_to": f"point{pair[1]}",
        "distance": distance,
        "sigma": distance * relative_stddev,
    }

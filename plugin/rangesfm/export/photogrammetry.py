"""Export of cameras and map to nerfstudio, OpenSfM and the Open Photogrammetry Format (OPF)."""

from __future__ import annotations

import hashlib
import json
import math
import shutil
import uuid
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from scipy.spatial.transform import Rotation

from rangesfm.errors import InputError
from rangesfm.export.metric_map import MetricMap, colored_points, photo_files, registered_images, require_space
from rangesfm.export.ply import write_points
from rangesfm.util.files.atomic import new_folder
from rangesfm.util.files.folders import real_path
from rangesfm.util.files.records import write_json

NERFSTUDIO_IMAGES = "images"
"""Folder of the photos beside transforms.json."""
_POINTS_NAME = "transforms_points.ply"
_FLIP_Y_AND_Z = np.diag([1.0, -1.0, -1.0, 1.0])
# The camera models of COLMAP that each program supports, with the program's own name for each.
_PERSPECTIVE = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV")
_FISHEYE = ("SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "OPENCV_FISHEYE")
_NERFSTUDIO = dict.fromkeys(_PERSPECTIVE, "OPENCV") | dict.fromkeys(_FISHEYE, "OPENCV_FISHEYE")
_OPENSFM = dict.fromkeys(_PERSPECTIVE, "brown") | {"OPENCV_FISHEYE": "fisheye_opencv"}
_ALL_OF_OPENSFM = {"brown": ("k1", "k2", "k3", "p1", "p2"), "fisheye_opencv": ("k1", "k2", "k3", "k4")}
_NUM_CONSTRAINTS = 10
_MIN_TRACK_LENGTH = 3
# OPF's accuracy of a mark. Marks of a feature detector get the value of a mark that a person clicked, 1.
_MARK_ACCURACY = 1.0


def _distortion(camera: pycolmap.Camera, program: str, known: Mapping[str, str]) -> tuple[str, dict[str, float]]:
    """Return a program's name of the camera model, and the distortion coefficients by the program's parameter names.

    Raises:
        InputError: the program does not support the camera model.
    """
    name = camera.model.name
    if name not in known:
        raise InputError(f"{program} does not know the camera model {name}, expected one of: {', '.join(known)}")
    # COLMAP's models with a single coefficient call it k.
    names = ["k1" if parameter == "k" else parameter for parameter in camera.params_info.split(", ")]
    distortion = {names[index]: float(camera.params[index]) for index in camera.extra_params_idxs()}
    return known[name], distortion


def write_nerfstudio(map_: MetricMap, folder: Path) -> Path:
    """Write ``transforms.json``, its points and, where their folder is known, copies of the photos in ``images``.

    nerfstudio reads the camera model at the top level only, and takes a missing one for perspective. Other camera
    parameters at the top level hold for all photos; so with several cameras, each photo has its own parameters.

    Cameras of nerfstudio look along their -z axis with y up, and z is up in its world. Its loader centres and rescales
    the poses unless it is told not to (``--auto-scale-poses False --center-method none --orientation-method none``).

    Raises:
        InputError: nerfstudio does not support a camera model, or some photos are from fisheye cameras and some not, or
            a photo is missing.
        OSError: the disk is too full for the photos.
    """
    model, images = map_.reconstruction, registered_images(map_.reconstruction)
    cameras = {i: _intrinsics(model.cameras[i]) for i in sorted({image.camera_id for image in images})}
    kinds = {camera.pop("camera_model") for camera in cameras.values()}
    if len(kinds) > 1:
        raise InputError("nerfstudio has one camera model for all photos, but only some of these are fisheye photos")
    common = next(iter(cameras.values())) if len(cameras) == 1 else {}
    if map_.images_path is not None and real_path(map_.images_path) != real_path(folder / NERFSTUDIO_IMAGES):
        files = photo_files(map_, map_.images_path)
        with new_folder(folder / NERFSTUDIO_IMAGES) as copies:
            require_space(copies, files.values())
            for name, file in files.items():  # they are no links, so that editing a copy cannot change a photo
                (copies / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(file, copies / name)
    frames = []
    for image in images:
        world_from_cam = np.vstack([image.cam_from_world().inverse().matrix(), [0, 0, 0, 1]])
        matrix = (world_from_cam @ _FLIP_Y_AND_Z).tolist()
        own = {} if common else cameras[image.camera_id]
        frames.append({"file_path": f"{NERFSTUDIO_IMAGES}/{image.name}", "transform_matrix": matrix, **own})
    content = {
        **({"camera_model": kinds.pop()} if kinds else {}),
        **common,
        "applied_transform": np.eye(4)[:3].tolist(),
        "ply_file_path": write_points(model, folder / _POINTS_NAME).name,
        "frames": frames,
    }
    write_json(content, folder / "transforms.json")
    return folder / "transforms.json"


def _intrinsics(camera: pycolmap.Camera) -> dict[str, Any]:
    kind, distortion = _distortion(camera, "nerfstudio", _NERFSTUDIO)
    return {
        "camera_model": kind,
        "w": camera.width,
        "h": camera.height,
        "fl_x": camera.focal_length_x,
        "fl_y": camera.focal_length_y,
        "cx": camera.principal_point_x,
        "cy": camera.principal_point_y,
        **distortion,
    }


def write_opensfm(map_: MetricMap, path: Path) -> Path:
    """Write one reconstruction with its cameras, shots and points, and ``reference_lla`` if the map is georeferenced.

    The image coordinates of OpenSfM (and OpenDroneMap) have their origin in the middle of a photo, and the longer side
    of the photo as unit. Its rotations are rotation vectors.

    Raises:
        InputError: OpenSfM does not support a camera model.
    """
    model, origin = map_.reconstruction, map_.georeference
    images, (places, colors) = registered_images(model), colored_points(model)
    reconstruction: dict[str, Any] = {
        "cameras": {str(i): _camera(model.cameras[i]) for i in sorted({image.camera_id for image in images})},
        "shots": {image.name: _shot(image, map_) for image in images},
        "points": {
            str(i): {"color": list(map(float, color)), "coordinates": at}
            for i, at, color in zip(sorted(model.point3D_ids()), places.tolist(), colors)
        },
    }
    if origin is not None:
        place = {"latitude": origin.lat_deg, "longitude": origin.lon_deg, "altitude": origin.height_m}
        reconstruction["reference_lla"] = place
    write_json([reconstruction], path)
    return path


def _camera(camera: pycolmap.Camera) -> dict[str, Any]:
    projection, distortion = _distortion(camera, "OpenSfM", _OPENSFM)
    size = max(camera.width, camera.height)
    return {
        "projection_type": projection,
        "width": camera.width,
        "height": camera.height,
        "focal_x": camera.focal_length_x / size,
        "focal_y": camera.focal_length_y / size,
        "c_x": (camera.principal_point_x - camera.width / 2) / size,
        "c_y": (camera.principal_point_y - camera.height / 2) / size,
        **dict.fromkeys(_ALL_OF_OPENSFM[projection], 0.0),
        **distortion,
    }


def _shot(image: pycolmap.Image, map_: MetricMap) -> dict[str, Any]:
    cam_from_world = image.cam_from_world()
    time = map_.timestamps_s.get(image.name)
    return {
        "camera": str(image.camera_id),
        "rotation": Rotation.from_matrix(cam_from_world.rotation.matrix()).as_rotvec().tolist(),
        "translation": cam_from_world.translation.tolist(),
        "orientation": 1,
        **({} if time is None else {"capture_time": time}),
    }


def write_opf(map_: MetricMap, folder: Path) -> Path:
    """Write ``project.opf`` and its ``camera_list.json``, ``input_control_points.json`` and ``constraints.json``.

    Pairs of points that many photos see become manual tie points with their marks. The distance of each pair becomes a
    scale constraint with the uncertainty of the scale, so that a program that maps the same photos gets this scale.

    Raises:
        InputError: the map has no two points that three photos see, or the stddev of its scale is not known.
    """
    model, stddev = map_.reconstruction, map_.relative_scale_stddev
    if not math.isfinite(stddev):
        raise InputError("the format 'opf' needs the stddev of the scale, which is not known for this model")
    names = sorted(image.name for image in model.images.values())
    pairs = _distant_pairs(model)
    point_ids = [point_id for pair in pairs for point_id in pair]
    files = {
        "camera_list.json": _file("camera-list", cameras=[{"id": _uid(name), "uri": name} for name in names]),
        "input_control_points.json": _file(
            "input-control-points", gcps=[], mtps=[_tie_point(model, point_id) for point_id in point_ids]
        ),
        "constraints.json": _file(
            "constraints",
            scale_constraints=[_constraint(model, number, pair, stddev) for number, pair in enumerate(pairs)],
            orientation_constraints=[],
        ),
    }
    files["project.opf"] = _project(files)
    with new_folder(folder) as temporary:
        for name, content in files.items():
            write_json(content, temporary / name)
    return folder


def _project(files: Mapping[str, Any]) -> dict[str, Any]:
    """Return the content of the file that lists the other files. Its ids are hashes of their content."""
    items = []
    for name, content in files.items():
        kind, resource = name.removesuffix(".json"), {"format": content["format"], "uri": name}
        identity = str(uuid.uuid5(uuid.NAMESPACE_URL, json.dumps(content)))
        items.append({"id": identity, "type": kind, "name": kind, "resources": [resource], "sources": []})
    identity = str(uuid.uuid5(uuid.NAMESPACE_URL, json.dumps(items)))
    return _file("project", id=identity, name="rangesfm", description="scale of a metric map, in metres", items=items)


def _file(kind: str, **content: Any) -> dict[str, Any]:
    return {"format": f"application/opf-{kind}+json", "version": "1.0", **content}


def _distant_pairs(model: pycolmap.Reconstruction) -> list[tuple[int, int]]:
    """Return up to 10 pairs of ids of points that many photos see and that are far apart; no point is in two pairs."""
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


def _uid(name: str) -> int:
    """Return a 64 bit number that depends only on the name of the photo."""
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

"""COLMAP models off the disk, read with care."""

from __future__ import annotations

import errno
import tempfile
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap

from rangesfm.colmap.model_records import MAX_COORDINATE, MODEL_FILES, check_map, read_records
from rangesfm.errors import InputError
from rangesfm.files.atomic import is_plain_name

_EXPECTED = "expected cameras, images and points3D files that COLMAP wrote"
# Text files round quaternions, and some programs write a few digits only.
_MAX_QUATERNION_ERROR = 1e-2
_UNIT_LENGTH_ERROR = 1e-9
_MAX_IMAGE_SIZE = 1_000_000


def read_model(path: Path) -> pycolmap.Reconstruction:
    """A COLMAP model, binary or text.

    Raises:
        InputError: there is none, or its files are damaged: COLMAP takes much of them for granted, and what it does
            with the rest later, in its own code, is not for a user to meet.
    """
    if not any((path / f"cameras{ending}").is_file() for ending in (".bin", ".txt")):
        nested = f"; is it {path / '0'}?" if (path / "0").is_dir() else ""
        raise InputError(f"not a COLMAP model, {_EXPECTED}{nested}", path)
    records = {name: read_records(path / name) for name in MODEL_FILES if (path / name).is_file()}
    try:
        model = pycolmap.Reconstruction(path)
    except (OSError, ValueError, RuntimeError, LookupError, MemoryError) as error:
        raise InputError(f"not a readable COLMAP model, {_EXPECTED}", path) from error
    _check_names(model, path)
    _check_cameras(model, path)
    _check_poses(model, path)
    if "images.bin" in records and "points3D.bin" in records:
        check_map(records["images.bin"], records["points3D.bin"])
    else:
        _check_map_of_text(model, path)
    return model


def write_binary_model(model: pycolmap.Reconstruction, folder: Path) -> None:
    """Write a model's files into a folder that is there.

    Raises:
        OSError: a file ends before its records do, as on a full disk: COLMAP does not look.
    """
    model.write_binary(folder)
    try:
        for name in MODEL_FILES:
            read_records(folder / name)
    except InputError as error:
        raise OSError(errno.ENOSPC, f"cannot write {name} to the end; is the disk full?", str(folder.parent)) from error


def _check_names(model: pycolmap.Reconstruction, path: Path) -> None:
    names: Counter[str] = Counter()
    for image_id, image in model.images.items():
        try:
            name = str(image.name)
        except UnicodeDecodeError:
            name = ""
        if not is_plain_name(name):
            raise InputError(f"image {image_id} has no name of printable text", path)
        names[name] += 1
    repeated = next((name for name, num in names.items() if num > 1), None)
    if repeated is not None:
        raise InputError(f"{names[repeated]} images are called {repeated}, expected each name once", path)


def _check_cameras(model: pycolmap.Reconstruction, path: Path) -> None:
    for camera_id, camera in model.cameras.items():
        if not (1 <= camera.width <= _MAX_IMAGE_SIZE and 1 <= camera.height <= _MAX_IMAGE_SIZE):
            raise InputError(f"camera {camera_id} has photos of {camera.width} x {camera.height} pixels", path)
        params, focal_lengths = camera.params, camera.params[camera.focal_length_idxs()]
        if not (np.all(np.abs(params) <= MAX_COORDINATE) and np.all(focal_lengths > 0)):
            raise InputError(f"the parameters of camera {camera_id} are not those of a camera", path)


def _check_poses(model: pycolmap.Reconstruction, path: Path) -> None:
    """Check all poses, and make the quaternions of unit length, which everything later takes them for."""
    for rig_id, rig in model.rigs.items():
        for sensor_id, sensor_from_rig in rig.non_ref_sensors.items():
            if sensor_from_rig is not None:
                what = f"the pose of sensor {sensor_id.id} in rig {rig_id}"
                rig.set_sensor_from_rig(sensor_id, _checked(sensor_from_rig, what, path))
    for frame_id in model.reg_frame_ids():
        frame = model.frame(frame_id)
        image_ids = [data_id.id for data_id in frame.image_ids]
        if not image_ids or not all(map(model.exists_image, image_ids)):
            raise InputError(f"frame {frame_id} has a pose and no image, or one that is not there", path)
        what = f"the pose of {min(model.image(image_id).name for image_id in image_ids)}"
        frame.rig_from_world = _checked(frame.rig_from_world, what, path)


def _checked(pose: pycolmap.Rigid3d | None, what: str, path: Path) -> pycolmap.Rigid3d:
    assert pose is not None
    params = np.array(pose.params)
    if not np.all(np.abs(params) <= MAX_COORDINATE):
        raise InputError(f"{what} is not finite", path)
    length = float(np.linalg.norm(params[:4]))
    if abs(length - 1) > _MAX_QUATERNION_ERROR:
        raise InputError(f"{what} has a quaternion of length {length:.4g}, expected 1", path)
    if abs(length - 1) <= _UNIT_LENGTH_ERROR:
        return pose
    return pycolmap.Rigid3d(pycolmap.Rotation3d(params[:4] / length), params[4:])


def _check_map_of_text(model: pycolmap.Reconstruction, path: Path) -> None:
    with tempfile.TemporaryDirectory() as folder:
        write_binary_model(model, Path(folder))
        images, points = (read_records(Path(folder) / name) for name in ("images.bin", "points3D.bin"))
    check_map(replace(images, path=path), replace(points, path=path))

"""Reading of COLMAP models, with the checks that COLMAP itself does not make, and of trajectories as models."""

from __future__ import annotations

import errno
import math
import shutil
import struct
import tempfile
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pycolmap

from rangesfm.colmap.model_faults import NUM_CAMERA_PARAMS, refuse_fault
from rangesfm.errors import InputError
from rangesfm.util.files.atomic import is_plain_name
from rangesfm.util.files.contents import open_regular, stand_in
from rangesfm.util.files.text_tables import read_text
from rangesfm.util.geometry.moments import ByPhoto
from rangesfm.util.geometry.reference import QUATERNION_TOLERANCE, read_reference

MAX_COORDINATE = 1e12
"""Largest accepted coordinate of points and poses, in any unit; its square is still exact enough as a double."""

_NO_POINT = 2**64 - 1
_COUNT_BYTES = 8
_FEATURE = np.dtype([("xy", "<f8", 2), ("point_id", "<u8")])
_ELEMENT = np.dtype([("image_id", "<u4"), ("feature", "<u4")])
_POINT = np.dtype([("point_id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("length", "<u8")])
_NEEDED = ("cameras", "images", "points3D")
# Columns before the photo's name on a line of images.txt: id, quaternion (4), translation (3), camera.
_NUM_BEFORE_NAME = 9
_PHOTO_LINE = "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"
_BLANK = "\u2423"  # in the place of a blank in a photo's name
_EXPECTED = "expected cameras, images and points3D files that COLMAP wrote"
# Up to this difference of its length from 1 a quaternion is left as it is.
_UNIT_LENGTH_ERROR = 1e-9
_MAX_IMAGE_SIZE = 1_000_000


@dataclass(frozen=True)
class Records:
    """n records of a binary file, each a head and then groups of fields; all groups of a file have one length.

    Attributes:
        start, groups_start, end: n byte offsets in ``data``, where each record, its groups and its end are.
    """

    path: Path
    data: bytes
    start: list[int]
    groups_start: list[int]
    end: list[int]

    def heads(self, dtype: np.dtype[np.void]) -> npt.NDArray[np.void]:
        """Return the beginning of each record (n,), decoded as ``dtype``."""
        size = dtype.itemsize
        return np.frombuffer(b"".join([self.data[place : place + size] for place in self.start]), dtype)

    def groups(self, dtype: np.dtype[np.void]) -> npt.NDArray[np.void]:
        """Return the groups of all records, one after the other, decoded as ``dtype``."""
        joined = b"".join([self.data[start:end] for start, end in zip(self.groups_start, self.end, strict=True)])
        return np.frombuffer(joined, dtype)

    def each(self) -> list[bytes]:
        """Return the bytes of each record (n,)."""
        return [self.data[start:end] for start, end in zip(self.start, self.end, strict=True)]

    def num_groups(self, dtype: np.dtype[np.void]) -> npt.NDArray[np.int64]:
        """Return the number of groups of each record (n,)."""
        return (np.array(self.end, np.int64) - np.array(self.groups_start, np.int64)) // dtype.itemsize


def read_records(path: Path) -> Records:
    """Read the records of one of MODEL_FILES.

    Raises:
        InputError: the file ends before the number of records that it announces. COLMAP would go on reading, and with
            a damaged count run for minutes and fill the memory.
    """
    start, groups_start, end = list[int](), list[int](), [_COUNT_BYTES]
    try:
        with open_regular(path) as file:
            data = file.read()
        if what := stand_in(path, data):
            raise InputError(what, path)
        for _ in range(_number(data, 0, "Q")):
            start.append(end[-1])
            groups, stop = _WALKS[path.name](data, start[-1])
            if stop > len(data):
                raise ValueError("it ends before")
            groups_start.append(groups)
            end.append(stop)
    except (OSError, ValueError, struct.error) as error:
        raise InputError("is damaged or cut off: it announces more than it holds", path) from error
    return Records(path, data, start, groups_start, end[1:])


def check_map(images: Records, points: Records) -> None:
    """Check the points of a model and their features, which COLMAP does not check completely.

    Raises:
        InputError: a coordinate is not finite or too large, or the two files disagree on where the points are seen.
    """
    heads, features = points.heads(_POINT), images.groups(_FEATURE)
    usable = np.all(np.abs(heads["xyz"]) <= MAX_COORDINATE, axis=1)
    if not usable.all():
        first = heads[~usable][0]
        place = ", ".join(f"{value:g}" for value in first["xyz"].tolist())
        raise InputError(f"point {first['point_id']} is at ({place}), expected finite coordinates", points.path)
    if not np.all(np.abs(features["xy"]) <= MAX_COORDINATE):
        raise InputError("a feature has no finite pixel coordinates", images.path)
    if len(np.unique(heads["point_id"])) < len(heads):
        raise InputError("two points have the same id", points.path)
    num_features = images.num_groups(_FEATURE)
    image_id = np.repeat(images.heads(np.dtype([("image_id", "<u4")]))["image_id"], num_features)
    index = np.arange(len(features)) - np.repeat(np.cumsum(num_features) - num_features, num_features)
    is_of_point = features["point_id"] != _NO_POINT
    elements = points.groups(_ELEMENT)
    said_by_features = _sorted_by_place(image_id[is_of_point], index[is_of_point], features["point_id"][is_of_point])
    said_by_tracks = _sorted_by_place(
        elements["image_id"], elements["feature"], np.repeat(heads["point_id"], points.num_groups(_ELEMENT))
    )
    if not np.array_equal(said_by_features, said_by_tracks):
        raise InputError("the tracks of the points do not agree with the features of the images", points.path)


def _sorted_by_place(
    image_id: npt.NDArray[np.uint32], feature: npt.NDArray[np.integer], point_id: npt.NDArray[np.uint64]
) -> npt.NDArray[np.uint64]:
    """Return, for each feature in order, a number for its photo and index, and the id of its point (n, 2)."""
    place = image_id.astype(np.uint64) << np.uint64(32) | feature.astype(np.uint64)
    order = np.lexsort((point_id, place))
    return np.column_stack([place[order], point_id[order]])


def _number(data: bytes, place: int, code: str) -> int:
    """Return the little-endian integer at an offset, given its struct code."""
    return int(struct.unpack_from(f"<{code}", data, place)[0])


def _camera(data: bytes, start: int) -> tuple[int, int]:
    params = start + 24
    return params, params + 8 * NUM_CAMERA_PARAMS.get(_number(data, start + 4, "i"), 0)


def _rig(data: bytes, start: int) -> tuple[int, int]:
    num_sensors, end = _number(data, start + 4, "I"), start + 8
    for sensor in range(num_sensors):
        end += 8 if not sensor else 9 + 56 * (_number(data, end + 8, "B") > 0)  # all but the first may have a pose
    return start + 8, end


def _with_groups(num_before: int, code: str, size: int, data: bytes, start: int) -> tuple[int, int]:
    """Step over a head of ``num_before`` bytes, the number of groups with this struct code, and groups of one size."""
    groups = start + num_before + struct.calcsize(f"<{code}")
    return groups, groups + size * _number(data, start + num_before, code)


def _image(data: bytes, start: int) -> tuple[int, int]:
    name_end = data.index(b"\0", start + 64)
    return _with_groups(name_end + 1 - start, "Q", _FEATURE.itemsize, data, start)


# Functions that step over the record at an offset of a file's content, and return where its groups begin and end.
_WALKS: dict[str, Callable[[bytes, int], tuple[int, int]]] = {
    "cameras.bin": _camera,
    "rigs.bin": _rig,
    "frames.bin": partial(_with_groups, 64, "I", 16),
    "images.bin": _image,
    "points3D.bin": partial(_with_groups, 43, "Q", _ELEMENT.itemsize),
}
MODEL_FILES = tuple(_WALKS)
"""Names of COLMAP's binary model files; each file is a count followed by that many records."""


def read_model(path: Path) -> pycolmap.Reconstruction:
    """Read a COLMAP model, binary or text.

    Raises:
        InputError: there is no model, or its files are damaged. COLMAP does not check much of them itself, and would
            fail later with an error in its own code.
    """
    is_text = _require_whole(path)
    records = {name: read_records(path / name) for name in MODEL_FILES if (path / name).is_file()}
    try:
        model = _read_text_model(path) if is_text else pycolmap.Reconstruction(path)
    except (OSError, ValueError, RuntimeError, LookupError, MemoryError) as error:
        refuse_fault(path, ".txt" if is_text else ".bin", lambda file: records[file.name].each())
        raise InputError(f"not a readable COLMAP model, {_EXPECTED}", path) from error
    _check_names(model, path)
    _check_cameras(model, path)
    _check_poses(model, path)
    if "images.bin" in records and "points3D.bin" in records:
        check_map(records["images.bin"], records["points3D.bin"])
    else:
        _check_map_of_text(model, path)
    return model


def _require_whole(path: Path) -> bool:
    """Refuse a model with missing files, and return whether it is one of text files.

    Of binary and text files in one folder the more complete set counts, and the binary set if both are as complete.
    """
    here = {ending: [name for name in _NEEDED if (path / f"{name}{ending}").is_file()] for ending in (".bin", ".txt")}
    ending = max(here, key=lambda ending: len(here[ending]))
    missing = [name + ending for name in _NEEDED if name not in here[ending]]
    if not here[ending]:
        nested = f"; is it {path / '0'}?" if (path / "0").is_dir() else ""
        raise InputError(f"not a COLMAP model, {_EXPECTED}{nested}", path)
    if missing:
        raise InputError(f"not a whole COLMAP model, there is no {missing[0]}; {_EXPECTED}", path)
    return ending == ".txt"


def _read_text_model(path: Path) -> pycolmap.Reconstruction:
    """Read a model of text files.

    COLMAP needs a line of features for each photo, even if it is empty, and reads names up to a blank only.

    Raises:
        InputError: a line of images.txt is neither of a photo nor of features.
    """
    lines = _lines_for_colmap(path / "images.txt")
    if lines is None:
        return pycolmap.Reconstruction(path)
    with tempfile.TemporaryDirectory() as folder:
        for file in path.glob("*.txt"):
            shutil.copy(file, folder)
        Path(folder, "images.txt").write_text("\n".join(lines), "utf-8", "surrogateescape", "\n")
        model = pycolmap.Reconstruction(folder)
    for image in model.images.values():
        image.name = image.name.replace(_BLANK, " ")
    return model


def _lines_for_colmap(path: Path) -> list[str] | None:
    """Return the lines of images.txt as COLMAP can read them; None if they are so already.

    A photo without a line of features gets an empty one, and blanks in its name are replaced.
    """
    given = read_text(path, errors="surrogateescape").removesuffix("\n").split("\n")
    lines, is_whole, of_features = list[str](), True, False
    for number, line in enumerate(given, 1):
        words = line.split(maxsplit=_NUM_BEFORE_NAME)
        is_photo = len(words) > _NUM_BEFORE_NAME and words[0].isdigit() and not _are_features(line)
        if of_features and (is_photo or line.startswith("#")):
            lines.append("")
            is_whole = False
        if is_photo:
            if not all(map(_is_finite, words[1:-1])):
                raise InputError(f"is no line of a photo, expected {_PHOTO_LINE}", path, number)
            if " " in (name := words[-1].strip()):
                line = " ".join([*words[:-1], name.replace(" ", _BLANK)])
                is_whole = False
        elif line.strip() and not line.startswith("#") and not (of_features and _are_features(line)):
            expected = "x, y and the id of a point for each feature" if of_features else _PHOTO_LINE
            raise InputError(f"is cut off or damaged, expected {expected}", path, number)
        of_features = is_photo
        lines.append(line)
    return None if is_whole and not of_features else [*lines, "", ""]


def _are_features(line: str) -> bool:
    """Return whether a line holds features: x, y and the id of a point for each."""
    words = line.split()
    return len(words) % 3 == 0 and all(map(_is_finite, words))


def _is_finite(word: str) -> bool:
    try:
        return math.isfinite(float(word))
    except ValueError:
        return False


def write_binary_model(model: pycolmap.Reconstruction, folder: Path) -> None:
    """Write a model's files into a folder.

    Raises:
        OSError: a file is incomplete, as on a full disk, which COLMAP does not notice.
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
            raise InputError(f"the name of image {image_id} is not printable text", path)
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
            raise InputError(f"camera {camera_id} has impossible parameters", path)


def _check_poses(model: pycolmap.Reconstruction, path: Path) -> None:
    """Check all poses, and normalize their quaternions, because all later code assumes unit length."""
    for rig_id, rig in model.rigs.items():
        for sensor_id, sensor_from_rig in rig.non_ref_sensors.items():
            if sensor_from_rig is not None:
                what = f"the pose of sensor {sensor_id.id} in rig {rig_id}"
                rig.set_sensor_from_rig(sensor_id, _checked(sensor_from_rig, what, path))
    for frame_id in model.reg_frame_ids():
        frame = model.frame(frame_id)
        image_ids = [data_id.id for data_id in frame.image_ids]
        if not image_ids or not all(map(model.exists_image, image_ids)):
            raise InputError(f"frame {frame_id} has a pose but no image, or names an image that does not exist", path)
        what = f"the pose of {min(model.image(image_id).name for image_id in image_ids)}"
        frame.rig_from_world = _checked(frame.rig_from_world, what, path)


def _checked(pose: pycolmap.Rigid3d | None, what: str, path: Path) -> pycolmap.Rigid3d:
    assert pose is not None
    params = np.array(pose.params)
    if not np.all(np.abs(params) <= MAX_COORDINATE):
        raise InputError(f"{what} is not finite", path)
    length = float(np.linalg.norm(params[:4]))
    if abs(length - 1) > QUATERNION_TOLERANCE:
        raise InputError(f"{what} has a quaternion of length {length:.4g}, expected 1", path)
    if abs(length - 1) <= _UNIT_LENGTH_ERROR:
        return pose
    return pycolmap.Rigid3d(pycolmap.Rotation3d(params[:4] / length), params[4:])


def _check_map_of_text(model: pycolmap.Reconstruction, path: Path) -> None:
    with tempfile.TemporaryDirectory() as folder:
        write_binary_model(model, Path(folder))
        images, points = (read_records(Path(folder) / name) for name in ("images.bin", "points3D.bin"))
    check_map(replace(images, path=path), replace(points, path=path))


def model_of_trajectory(path: Path) -> pycolmap.Reconstruction:
    """Return the poses of a file as a model without points: a TUM trajectory, or the CSV of ``read_reference``.

    The poses are world from camera, in any unit. Poses by time get photos that are named after the time in seconds.

    Raises:
        InputError: the file is not valid, or has no rotations.
    """
    poses = read_reference(path)
    if poses.world_from_cam is None:
        raise InputError("has positions without rotations, expected timestamp tx ty tz qx qy qz qw", path)
    by_time = [f"{time:.6f}.png" for time in poses.moments.timestamp_s.tolist()]
    names = poses.moments.image_name if isinstance(poses.moments, ByPhoto) else by_time
    model = pycolmap.Reconstruction()
    # Poses have no pixels; the camera is only there because a model has one.
    model.add_camera_with_trivial_rig(pycolmap.Camera.create_from_model_name(1, "SIMPLE_PINHOLE", 1000.0, 1000, 1000))
    for number, (name, turn, place) in enumerate(zip(names, poses.world_from_cam, poses.positions_m, strict=True), 1):
        cam_from_world = pycolmap.Rigid3d(pycolmap.Rotation3d(turn), place).inverse()
        model.add_image_with_trivial_frame(pycolmap.Image(name=name, camera_id=1, image_id=number), cam_from_world)
    return model

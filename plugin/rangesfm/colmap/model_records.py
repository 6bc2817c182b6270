"""COLMAP's binary model files, record by record: whether they hold what they announce, and agree with each other."""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pycolmap

from rangesfm.errors import InputError

MAX_COORDINATE = 1e12
"""Of points and poses, in any unit: twice across the solar system in metres. Squares of it are still exact enough."""

NUM_CAMERA_PARAMS = {
    int(model): len(pycolmap.Camera.create_from_model_id(1, model, 1.0, 1, 1).params)
    for name, model in pycolmap.CameraModelId.__members__.items()
    if name != "INVALID"
}

_NO_POINT = 2**64 - 1
_FEATURE = np.dtype([("xy", "<f8", 2), ("point_id", "<u8")])
_ELEMENT = np.dtype([("image_id", "<u4"), ("feature", "<u4")])
_POINT = np.dtype([("point_id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("length", "<u8")])


@dataclass(frozen=True)
class Records:
    """n records of a file, each a head and as many groups of fields of one length as it announces.

    Attributes:
        path: the file.
        data: its content.
        start, groups_start, end: n places in ``data``.
    """

    path: Path
    data: bytes
    start: list[int]
    groups_start: list[int]
    end: list[int]

    def heads(self, dtype: np.dtype[np.void]) -> npt.NDArray[np.void]:
        """(n,) the beginning of each record."""
        size = dtype.itemsize
        return np.frombuffer(b"".join([self.data[place : place + size] for place in self.start]), dtype)

    def groups(self, dtype: np.dtype[np.void]) -> npt.NDArray[np.void]:
        """The groups of all records, one after the other."""
        joined = b"".join([self.data[start:end] for start, end in zip(self.groups_start, self.end, strict=True)])
        return np.frombuffer(joined, dtype)

    def num_groups(self, dtype: np.dtype[np.void]) -> npt.NDArray[np.int64]:
        """(n,) of each record."""
        return (np.array(self.end, np.int64) - np.array(self.groups_start, np.int64)) // dtype.itemsize


def read_records(path: Path) -> Records:
    """The records of one of MODEL_FILES.

    Raises:
        InputError: the file ends before the records that it announces. COLMAP goes on reading then, and may take
            any count for granted: it runs for minutes and fills the memory.
    """
    try:
        cursor = _Cursor(path.read_bytes())
        start, groups_start = [], []
        for _ in range(cursor.number("Q")):
            start.append(cursor.place)
            groups_start.append(_WALKS[path.name](cursor))
    except (OSError, ValueError, struct.error) as error:
        raise InputError("is damaged or cut off: it announces more than it holds", path) from error
    return Records(path, cursor.data, start, groups_start, [*start[1:], cursor.place][: len(start)])


def check_map(images: Records, points: Records) -> None:
    """Check what is many in a model, its points and their features, which COLMAP in part takes for granted.

    Raises:
        InputError: a coordinate is no usable number, or the two files do not agree on where the points are seen.
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
        raise InputError("two points have one id", points.path)
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
        raise InputError("the tracks are not those of the features in images.bin", points.path)


def _sorted_by_place(
    image_id: npt.NDArray[np.uint32], feature: npt.NDArray[np.integer], point_id: npt.NDArray[np.uint64]
) -> npt.NDArray[np.uint64]:
    """(n, 2) each feature's place in the model, and its point."""
    place = image_id.astype(np.uint64) << np.uint64(32) | feature.astype(np.uint64)
    order = np.lexsort((point_id, place))
    return np.column_stack([place[order], point_id[order]])


class _Cursor:
    """Steps through the records of a binary file, and fails beyond its end."""

    def __init__(self, data: bytes):
        self.data = data
        self.place = 0

    def number(self, code: str) -> int:
        """The next integer, little-endian, by its struct code."""
        (value,) = struct.unpack_from(f"<{code}", self.data, self.place)
        self.place += struct.calcsize(f"<{code}")
        return int(value)

    def skip(self, num_bytes: int) -> None:
        self.place += num_bytes
        if self.place > len(self.data):
            raise struct.error

    def skip_text(self) -> None:
        """Up to and with the zero byte that ends it."""
        end = self.data.find(b"\0", self.place)
        self.skip(end + 1 - self.place if end >= 0 else len(self.data))

    def skip_groups(self, num: int, num_bytes: int) -> int:
        """Skip so many groups of one length; where they begin."""
        start = self.place
        self.skip(num * num_bytes)
        return start


def _walk_camera(cursor: _Cursor) -> int:
    cursor.skip(4)
    model = cursor.number("i")
    return cursor.skip_groups(1, 16 + 8 * NUM_CAMERA_PARAMS.get(model, 0))


def _walk_rig(cursor: _Cursor) -> int:
    cursor.skip(4)
    num_sensors = cursor.number("I")
    start = cursor.skip_groups(1, 8 if num_sensors else 0)
    for _ in range(num_sensors - 1):
        cursor.skip(8)
        cursor.skip(56 if cursor.number("B") else 0)
    return start


def _walk_frame(cursor: _Cursor) -> int:
    cursor.skip(64)
    return cursor.skip_groups(cursor.number("I"), 16)


def _walk_image(cursor: _Cursor) -> int:
    cursor.skip(64)
    cursor.skip_text()
    return cursor.skip_groups(cursor.number("Q"), _FEATURE.itemsize)


def _walk_point(cursor: _Cursor) -> int:
    cursor.skip(43)
    return cursor.skip_groups(cursor.number("Q"), _ELEMENT.itemsize)


# Each steps over a record and tells where the groups begin with which it ends.
_WALKS: dict[str, Callable[[_Cursor], int]] = {
    "cameras.bin": _walk_camera,
    "rigs.bin": _walk_rig,
    "frames.bin": _walk_frame,
    "images.bin": _walk_image,
    "points3D.bin": _walk_point,
}
MODEL_FILES = tuple(_WALKS)
"""COLMAP's binary files, each a count and so many records."""

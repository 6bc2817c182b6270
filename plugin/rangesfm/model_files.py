"""COLMAP models off the disk, read with care."""

from __future__ import annotations

import mmap
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pycolmap

from rangesfm.errors import InputError

_EXPECTED = "expected cameras, images and points3D files that COLMAP wrote"


def read_model(path: Path) -> pycolmap.Reconstruction:
    """A COLMAP model, binary or text.

    Raises:
        InputError: there is none, or its files are damaged.
    """
    if not any((path / f"cameras{ending}").is_file() for ending in (".bin", ".txt")):
        nested = f"; is it {path / '0'}?" if (path / "0").is_dir() else ""
        raise InputError(f"not a COLMAP model, {_EXPECTED}{nested}", path)
    for name, walk in _WALKS.items():
        _check_length(path / name, walk)
    try:
        model = pycolmap.Reconstruction(path)
    except (OSError, ValueError, RuntimeError, LookupError, MemoryError) as error:
        raise InputError(f"not a readable COLMAP model, {_EXPECTED}", path) from error
    for image in model.images.values():
        if image.has_pose and not np.isfinite(image.cam_from_world().matrix()).all():
            raise InputError(f"the pose of {image.name} is not finite", path)
    return model


class _Cursor:
    """Steps through the records of a binary file, and fails beyond its end."""

    def __init__(self, data: mmap.mmap):
        self._data = data
        self._place = 0

    def number(self, code: str) -> int:
        """The next integer, little-endian, by its struct code."""
        (value,) = struct.unpack_from(f"<{code}", self._data, self._place)
        self._place += struct.calcsize(f"<{code}")
        return int(value)

    def skip(self, num_bytes: int) -> None:
        self._place += num_bytes
        if self._place > len(self._data):
            raise struct.error

    def skip_text(self) -> None:
        """Up to and with the zero byte that ends it."""
        end = self._data.find(b"\0", self._place)
        self.skip(end + 1 - self._place if end >= 0 else len(self._data))


def _check_length(path: Path, walk: Callable[[_Cursor], None]) -> None:
    """Refuse a binary file that ends before the records that it announces.

    COLMAP goes on reading then, and may take any count for granted: it runs for minutes and fills the memory.
    """
    if not path.is_file():
        return
    try:
        with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            cursor = _Cursor(data)
            for _ in range(cursor.number("Q")):
                walk(cursor)
    except (OSError, OverflowError, ValueError, struct.error) as error:
        raise InputError("is damaged or cut off: it announces more than it holds", path) from error


def _walk_camera(cursor: _Cursor) -> None:
    cursor.skip(4)
    model = cursor.number("i")
    cursor.skip(16 + 8 * _NUM_PARAMS.get(model, 0))


def _walk_rig(cursor: _Cursor) -> None:
    cursor.skip(4)
    num_sensors = cursor.number("I")
    cursor.skip(8 if num_sensors else 0)
    for _ in range(num_sensors - 1):
        cursor.skip(8)
        cursor.skip(56 if cursor.number("B") else 0)


def _walk_frame(cursor: _Cursor) -> None:
    cursor.skip(64)
    cursor.skip(16 * cursor.number("I"))


def _walk_image(cursor: _Cursor) -> None:
    cursor.skip(64)
    cursor.skip_text()
    cursor.skip(24 * cursor.number("Q"))


def _walk_point(cursor: _Cursor) -> None:
    cursor.skip(43)
    cursor.skip(8 * cursor.number("Q"))


_NUM_PARAMS = {
    int(model): len(pycolmap.Camera.create_from_model_id(1, model, 1.0, 1, 1).params)
    for name, model in pycolmap.CameraModelId.__members__.items()
    if name != "INVALID"
}

# COLMAP's binary files, each a count and so many records.
_WALKS = {
    "cameras.bin": _walk_camera,
    "rigs.bin": _walk_rig,
    "frames.bin": _walk_frame,
    "images.bin": _walk_image,
    "points3D.bin": _walk_point,
}

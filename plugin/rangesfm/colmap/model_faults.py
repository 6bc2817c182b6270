"""What is wrong with a COLMAP model that cannot be read: the file, its line or record, what was found and expected.

COLMAP only says which check of its own failed. Here the files are gone through once more, row by row: a row is a line
of a text file or a record of a binary one.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import pycolmap

from rangesfm.errors import InputError, printable
from rangesfm.util.files.text_tables import read_text, repeated

_MODELS = {name: int(model) for name, model in pycolmap.CameraModelId.__members__.items() if name != "INVALID"}
NUM_CAMERA_PARAMS = {
    model: len(pycolmap.Camera.create_from_model_id(1, pycolmap.CameraModelId(model), 1.0, 1, 1).params)
    for model in _MODELS.values()
}
"""Number of parameters by camera model."""

_STEMS = ("cameras", "rigs", "frames", "images", "points3D")
_MARKS = (b"\xef\xbb\xbf", b"\xff\xfe", b"\xfe\xff")
_CAMERA, _RIG, _FRAME, _IMAGE, _POINT = _STEMS
_EXPECTED = {
    _CAMERA: "CAMERA_ID MODEL WIDTH HEIGHT and the model's parameters",
    _RIG: "RIG_ID NUM_SENSORS and the sensors",
    _FRAME: "FRAME_ID RIG_ID QW QX QY QZ TX TY TZ NUM_DATA_IDS and SENSOR_TYPE SENSOR_ID DATA_ID of each",
    _IMAGE: "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME",
    _POINT: "POINT3D_ID X Y Z R G B ERROR and IMAGE_ID POINT2D_IDX of each photo",
}
_ONE = {_CAMERA: "camera", _RIG: "rig", _FRAME: "frame", _IMAGE: "image", _POINT: "point"}
_CAMERA_SENSOR = int(pycolmap.SensorType.CAMERA)


@dataclass(frozen=True)
class _Row:
    """One row of a file.

    Attributes:
        number: of the line or record, from 1. own_id: its id.
        names: ids that it names, each with the file that must have it.
        num_features: of a photo.
        features: of a point: photo and number of the feature.
    """

    number: int
    own_id: int
    names: tuple[tuple[str, int], ...] = ()
    num_features: int = 0
    features: tuple[tuple[int, int], ...] = ()


def refuse_fault(path: Path, ending: str, records_of: Callable[[Path], Sequence[bytes]]) -> None:
    """Raise InputError for the first fault in a model's files; without one that is known here, return.

    Args:
        path: folder of the model.
        ending: ".txt" or ".bin".
        records_of: returns the records of a binary file.
    """
    files = {stem: path / f"{stem}{ending}" for stem in _STEMS if (path / f"{stem}{ending}").is_file()}
    if (_RIG in files) != (_FRAME in files):
        has, lacks = (_RIG, _FRAME) if _RIG in files else (_FRAME, _RIG)
        raise InputError(f"there is {has}{ending} without {lacks}{ending}: expected both or none", path)
    rows: dict[str, list[_Row]] = {}
    for stem, file in files.items():
        rows[stem] = [
            *(_rows_of_text(stem, file) if ending == ".txt" else _rows_of_records(stem, file, records_of(file)))
        ]
    ids = {stem: {row.own_id for row in those} for stem, those in rows.items()}
    for stem, those in rows.items():
        if again := repeated(row.own_id for row in those):
            row, first = (those[k] for k in again)
            raise _error(files[stem], row, f"{_ONE[stem]} {row.own_id} is in {_place(files[stem], first)} already")
    for stem, those in rows.items():
        for row in those:
            for other, id_ in row.names:
                if id_ not in ids.get(other, {id_}):
                    what = f"{_ONE[stem]} {row.own_id} names {_ONE[other]} {id_}, which is not in {files[other].name}"
                    raise _error(files[stem], row, what)
    num_features = {row.own_id: row.num_features for row in rows.get(_IMAGE, [])}
    for row in rows.get(_POINT, []):
        for image_id, feature in row.features:
            if feature >= num_features[image_id]:
                has = f"which has {num_features[image_id]} features"
                raise _error(
                    files[_POINT], row, f"point {row.own_id} names feature {feature} of image {image_id}, {has}"
                )
    in_frames = {id_ for row in rows.get(_FRAME, []) for other, id_ in row.names if other == _IMAGE}
    if lost := [row for row in rows.get(_IMAGE, []) if _FRAME in files and row.own_id not in in_frames]:
        raise _error(files[_IMAGE], lost[0], f"image {lost[0].own_id} is in no frame of {files[_FRAME].name}")


def _place(path: Path, row: _Row) -> str:
    return f"{'line' if path.suffix == '.txt' else 'record'} {row.number}"


def _error(path: Path, row: _Row, what: str) -> InputError:
    if path.suffix == ".txt":
        return InputError(what, path, row.number)
    return InputError(f"{_place(path, row)}: {what}", path)


def _rows_of_text(stem: str, path: Path) -> Iterator[_Row]:
    """Yield the rows of a text file.

    Raises:
        InputError: a line is no row of this file.
    """
    with path.open("rb") as file:
        if file.read(3).startswith(_MARKS):
            raise InputError("begins with a byte order mark, expected UTF-8 without one", path, 1)
    lines = read_text(path, errors="surrogateescape").split("\n")
    numbered = iter([(number, line) for number, line in enumerate(lines, 1) if not line.startswith("#")])
    for number, line in numbered:
        if not line.strip():
            continue
        words = line.split(maxsplit=9) if stem == _IMAGE else line.split()
        features = next(numbered, (0, ""))[1].split() if stem == _IMAGE else []
        try:
            own_id, names, seen = _READ[stem](words)
        except (ValueError, IndexError, KeyError):
            raise InputError(f"is '{printable(line)[:60]}', expected {_EXPECTED[stem]}", path, number) from None
        yield _Row(number, own_id, tuple(names), len(features) // 3, tuple(seen))


_Content = tuple[int, Sequence[tuple[str, int]], Sequence[tuple[int, int]]]
"""Id of a row, what it names, and for a point its features."""


def _require_finite(words: Sequence[str]) -> None:
    if not all(math.isfinite(float(word)) for word in words):
        raise ValueError


def _camera(words: Sequence[str]) -> _Content:
    model = _MODELS[words[1]]
    if int(words[2]) < 1 or int(words[3]) < 1 or len([*map(float, words[4:])]) != NUM_CAMERA_PARAMS[model]:
        raise ValueError
    return int(words[0]), [], []


def _rig(words: Sequence[str]) -> _Content:
    sensors, rest = [words[2:4]] if int(words[1]) else [], words[4:]
    for _ in range(int(words[1]) - 1):
        sensors.append(rest[:2])
        rest = rest[3 + 7 * int(rest[2]) :]
    if rest:
        raise ValueError
    return int(words[0]), [(_CAMERA, int(id_)) for kind, id_ in sensors if kind == "CAMERA"], []


def _frame(words: Sequence[str]) -> _Content:
    _require_finite(words[2:9])
    data = words[10:]
    if len(data) != 3 * int(words[9]):
        raise ValueError
    images = [(_IMAGE, int(id_)) for kind, id_ in zip(data[::3], data[2::3]) if kind == "CAMERA"]
    return int(words[0]), [(_RIG, int(words[1])), *images], []


def _image(words: Sequence[str]) -> _Content:
    _require_finite(words[1:8])
    return int(words[0]), [(_CAMERA, int(words[8]))], []


def _point(words: Sequence[str]) -> _Content:
    _require_finite(words[1:8])
    track = [*map(int, words[8:])]
    if len(words) < 8 or len(track) % 2:
        raise ValueError
    return int(words[0]), [(_IMAGE, id_) for id_ in track[::2]], [*zip(track[::2], track[1::2])]


_READ: Mapping[str, Callable[[Sequence[str]], _Content]] = {
    _CAMERA: _camera,
    _RIG: _rig,
    _FRAME: _frame,
    _IMAGE: _image,
    _POINT: _point,
}


def _rows_of_records(stem: str, path: Path, records: Sequence[bytes]) -> Iterator[_Row]:
    """Yield the rows of a binary file, given its whole records.

    Raises:
        InputError: a camera has no known model.
    """
    for number, record in enumerate(records, 1):
        own_id = struct.unpack_from("<Q" if stem == _POINT else "<I", record)[0]
        names, features, num_features = list[tuple[str, int]](), list[tuple[int, int]](), 0
        if stem == _CAMERA and (model := struct.unpack_from("<i", record, 4)[0]) not in NUM_CAMERA_PARAMS:
            raise InputError(
                f"record {number}: camera {own_id} has the model {model}, which COLMAP does not know", path
            )
        if stem == _RIG and len(record) > 8:
            kind, id_ = struct.unpack_from("<iI", record, 8)
            names = [(_CAMERA, id_)] if kind == _CAMERA_SENSOR else []
        elif stem == _FRAME:
            data = struct.iter_unpack("<iIQ", record[68:])
            names = [(_RIG, struct.unpack_from("<I", record, 4)[0])]
            names += [(_IMAGE, id_) for kind, _, id_ in data if kind == _CAMERA_SENSOR]
        elif stem == _IMAGE:
            names = [(_CAMERA, struct.unpack_from("<I", record, 60)[0])]
            num_features = struct.unpack_from("<Q", record, record.index(b"\0", 64) + 1)[0]
        elif stem == _POINT:
            features = [*struct.iter_unpack("<II", record[51:])]
            names = [(_IMAGE, image_id) for image_id, _ in features]
        yield _Row(number, own_id, tuple(names), num_features, tuple(features))

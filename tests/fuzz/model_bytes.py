"""COLMAP's binary model files as records of fields, so that any field, record or track can be spoilt."""

from __future__ import annotations

import math
import random
import struct
from collections.abc import Callable
from dataclasses import dataclass

from tests.fuzz.mutation import mutated

from rangesfm.colmap.model_faults import NUM_CAMERA_PARAMS

TEXT = "text"
_EXTREMES: dict[str, tuple[float | bytes, ...]] = {
    "d": (math.nan, math.inf, -math.inf, 0.0, -1.0, 1e308, -1e-308, 1e7, 1e160),
    "Q": (0, 1, 2**63, 2**64 - 1, 2**32, 10**6),
    "I": (0, 1, 2**31, 2**32 - 1, 10**6),
    "i": (-1, 0, 3, 99, 2**31 - 1, -(2**31)),
    "B": (0, 1, 255),
    TEXT: (b"", b"../../up.jpg", b"/abs.jpg", b"a\nb.jpg", b"\xff\xfe", b"<b>.jpg", b"x" * 5000, b" ", b"\x1b[31m"),
}


@dataclass
class Field:
    """A number by its struct code, or a text that ends with a zero byte; ``name`` says what it means."""

    name: str
    code: str
    value: float | bytes

    def pack(self) -> bytes:
        if isinstance(self.value, bytes):
            return self.value + b"\0"
        return struct.pack(f"<{self.code}", self.value if self.code == "d" else int(self.value))


@dataclass
class ModelFile:
    """A model file: ``count`` records; each ends with groups of fields, which are its track or its features.

    Attributes:
        count: the number of records as written, which may be wrong.
        records: the fields of each record, without its groups.
        groups: the groups of each record; the record's last field says how many there are.
    """

    count: int
    records: list[list[Field]]
    groups: list[list[list[Field]]]

    def pack(self) -> bytes:
        fields = [
            field
            for record, groups in zip(self.records, self.groups, strict=True)
            for field in (*record, *(field for group in groups for field in group))
        ]
        return struct.pack("<Q", self.count) + b"".join(field.pack() for field in fields)


def parse(name: str, data: bytes) -> ModelFile:
    """Parse one of the files of an undamaged model."""
    cursor = _Cursor(data)
    count = int(cursor.take("count", "Q").value)
    records, groups = [], []
    for _ in range(count):
        record, its_groups = _PARSERS[name](cursor)
        records.append(record)
        groups.append(its_groups)
    return ModelFile(count, records, groups)


def spoilt(name: str, data: bytes, rng: random.Random, max_size: int) -> bytes:
    """Return a model file with up to four changes of its fields and records, or of its bytes, as ``mutated`` does."""
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        try:
            file = parse(name, data)
            rng.choice(_SPOILERS)(file, rng)
            spoilt_data = file.pack()
        except (struct.error, ValueError, IndexError, KeyError, OverflowError):  # an earlier change cannot be parsed
            spoilt_data = mutated(data, rng, max_size)
        data = spoilt_data if rng.random() < 0.8 else mutated(data, rng, max_size)
    return data[:max_size]


class _Cursor:
    def __init__(self, data: bytes):
        self._data = data
        self._place = 0

    def take(self, name: str, code: str) -> Field:
        if code == TEXT:
            end = self._data.index(b"\0", self._place)
            value: float | bytes = self._data[self._place : end]
            self._place = end + 1
        else:
            (value,) = struct.unpack_from(f"<{code}", self._data, self._place)
            self._place += struct.calcsize(f"<{code}")
        return Field(name, code, value)

    def take_all(self, names: str, codes: str) -> list[Field]:
        return [self.take(name, code) for name, code in zip(names.split(), codes, strict=True)]


_Record = tuple[list[Field], list[list[Field]]]
_POSE = "qw qx qy qz tx ty tz"


def _camera(cursor: _Cursor) -> _Record:
    record = cursor.take_all("camera_id model width height", "IiQQ")
    return [*record, *(cursor.take("param", "d") for _ in range(NUM_CAMERA_PARAMS[int(record[1].value)]))], []


def _rig(cursor: _Cursor) -> _Record:
    record = cursor.take_all("rig_id num_sensors", "II")
    num_sensors = int(record[1].value)
    record += cursor.take_all("sensor_type camera_id", "iI") if num_sensors else []
    groups = []
    for _ in range(num_sensors - 1):
        group = cursor.take_all("sensor_type camera_id has_pose", "iIB")
        groups.append(group + (cursor.take_all(_POSE, "d" * 7) if group[-1].value else []))
    return record, groups


def _frame(cursor: _Cursor) -> _Record:
    record = cursor.take_all(f"frame_id rig_id {_POSE} num_data", "II" + "d" * 7 + "I")
    return record, [cursor.take_all("sensor_type camera_id image_id", "iIQ") for _ in range(int(record[-1].value))]


def _image(cursor: _Cursor) -> _Record:
    record = cursor.take_all(f"image_id {_POSE} camera_id", "I" + "d" * 7 + "I")
    record += [cursor.take("name", TEXT), cursor.take("num_features", "Q")]
    return record, [cursor.take_all("x y point3d_id", "ddQ") for _ in range(int(record[-1].value))]


def _point(cursor: _Cursor) -> _Record:
    record = cursor.take_all("point3d_id x y z r g b error track_length", "QdddBBBdQ")
    return record, [cursor.take_all("image_id feature", "II") for _ in range(int(record[-1].value))]


_PARSERS: dict[str, Callable[[_Cursor], _Record]] = {
    "cameras.bin": _camera,
    "rigs.bin": _rig,
    "frames.bin": _frame,
    "images.bin": _image,
    "points3D.bin": _point,
}


PARSED = tuple(_PARSERS)


def _any_fields(file: ModelFile, rng: random.Random) -> list[Field]:
    number = rng.randrange(len(file.records))
    choices = [file.records[number], *file.groups[number][:50]]
    return rng.choice(choices)


def _set_extreme(file: ModelFile, rng: random.Random) -> None:
    field = rng.choice(_any_fields(file, rng))
    field.value = rng.choice(_EXTREMES[field.code])


def _shift(file: ModelFile, rng: random.Random) -> None:
    """Change a number by a little."""
    field = rng.choice(_any_fields(file, rng))
    if isinstance(field.value, bytes):
        field.value = field.value[:-1]
    elif field.code == "d":
        field.value = field.value * rng.choice((-1.0, 1.001, 1e3, 1e-3))
    else:
        field.value = max(0, int(field.value) + rng.choice((-1, 1))) % 256


def _copy_from_another(file: ModelFile, rng: random.Random) -> None:
    """Copy an id from another record, so that it occurs twice or refers to something else."""
    fields, others = _any_fields(file, rng), _any_fields(file, rng)
    same = [(field, other) for field in fields for other in others if field.name == other.name]
    if same:
        field, other = rng.choice(same)
        field.value = other.value


def _remove_record(file: ModelFile, rng: random.Random) -> None:
    number = rng.randrange(len(file.records))
    del file.records[number], file.groups[number]
    file.count -= 1


def _double_record(file: ModelFile, rng: random.Random) -> None:
    number = rng.randrange(len(file.records))
    file.records.append(file.records[number])
    file.groups.append(file.groups[number])
    file.count += 1


def _remove_groups(file: ModelFile, rng: random.Random) -> None:
    number = rng.randrange(len(file.records))
    if file.groups[number]:
        keep = rng.choice((0, 0, 1, len(file.groups[number]) - 1))
        del file.groups[number][keep:]
        file.records[number][-1].value = keep


def _remove_all(file: ModelFile, rng: random.Random) -> None:
    file.records, file.groups, file.count = [], [], 0


def _lie_about_count(file: ModelFile, rng: random.Random) -> None:
    file.count = rng.choice((0, 1, max(0, file.count - 1), file.count + 1, 2**31, 2**63, 2**64 - 1))


_SPOILERS: tuple[Callable[[ModelFile, random.Random], None], ...] = (
    *(_set_extreme, _set_extreme, _set_extreme, _shift, _shift, _copy_from_another, _copy_from_another),
    *(_remove_record, _double_record, _remove_groups, _remove_groups, _remove_all, _lie_about_count),
)

"""Times of the photos: from a CSV file, from EXIF, or from file names that are times."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timedelta, timezone
from pathlib import Path
from types import MappingProxyType
from typing import Final

import numpy as np

from rangesfm.arrays import Array
from rangesfm.errors import InputError
from rangesfm.options import TIME_S
from rangesfm.sfm.photo_files import exif_tags
from rangesfm.sfm.photo_list import read_photo_list
from rangesfm.util.files.atomic import is_plain_name
from rangesfm.util.files.clock_times import are_seconds_since_1970
from rangesfm.util.files.contents import AnyPath
from rangesfm.util.files.folders import IMAGE_EXTENSIONS, OTHER_PHOTOS, natural_order, walk
from rangesfm.util.files.photo_names import photos_meant
from rangesfm.util.files.text_tables import NO_NAMES, TextTable

_FINEST_RESOLUTION_S = 1e-3
_DATE_TIME_ORIGINAL, _SUB_SEC_TIME_ORIGINAL, _OFFSET_TIME_ORIGINAL = 0x9003, 0x9291, 0x9011
_UNITS_PER_SECOND = (1, 10**3, 10**6, 10**9)
_NO_FRAMES: Final[Mapping[str, Sequence[str]]] = MappingProxyType({})
_MIN_DECIMALS = 3  # a number with fewer decimals, as in scan_1.2, is more likely a version than seconds


_Stamp = tuple[float, float]
"""Time of a photo and the resolution of that time, seconds."""


@dataclass(frozen=True)
class ImageTimes:
    """Photos in the order in which they were taken.

    Attributes:
        image_names: n names, relative to the folder of the photos, with forward slashes.
        timestamps_s: (n,) seconds on the camera's clock, strictly increasing.
        resolution_s: the finest step of that clock as written down, at least 0.001.
        source: "csv", "rate", "exif" or "file_names".
        num_left_out: photos that have no time, or the same time as another photo.
        notes: warnings for the user, one line each.
        assumed: lines about how the times were read.
    """

    image_names: tuple[str, ...]
    timestamps_s: Array
    resolution_s: float
    source: str
    num_left_out: int = 0
    notes: tuple[str, ...] = ()
    assumed: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.image_names)

    def subset(self, names: Sequence[str]) -> ImageTimes:
        """Return the times of the photos with these names."""
        rows = np.flatnonzero(np.isin(self.image_names, names))
        kept = tuple(self.image_names[row] for row in rows)
        return replace(self, image_names=kept, timestamps_s=self.timestamps_s[rows])

    def by_name(self) -> dict[str, float]:
        """Return the time of each photo in seconds, by name."""
        return dict(zip(self.image_names, self.timestamps_s.tolist(), strict=True))


def list_images(folder: AnyPath) -> tuple[str, ...]:
    """Return the sorted names of all photos in a folder and its subfolders, including linked ones but not hidden ones.

    Raises:
        InputError: the folder does not exist or has no photo, or a photo's name cannot be written into a table.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError("is a file, expected a folder of photos" if folder.exists() else "no such folder", folder)
    names = [
        (parent / name).relative_to(folder).as_posix()
        for parent, _, files in walk(folder)
        for name in files
        if name.lower().endswith(IMAGE_EXTENSIONS)
    ]
    if not names:
        others = [name for _, _, files in walk(folder) for name in files if name.lower().endswith(OTHER_PHOTOS)]
        there = f"; convert {others[0]} and its like to JPEG" if others else ""
        raise InputError(f"no photos ({' '.join(e[1:] for e in IMAGE_EXTENSIONS)}) in this folder{there}", folder)
    for name in names:
        if not is_plain_name(name):
            raise InputError(f"the name of the photo '{name}' is not printable UTF-8 text: rename it", folder)
    return tuple(sorted(names))


def find_image_times(
    folder: AnyPath,
    names: Sequence[str],
    csv_path: AnyPath | None = None,
    frames: Mapping[str, Sequence[str]] = _NO_FRAMES,
    *,
    rate_hz: float | None = None,
    columns: Mapping[str, str] = NO_NAMES,
    unit: str | None = None,
) -> ImageTimes:
    """Find the times of the photos ``names`` in ``folder``.

    They are from the CSV file if given, else by the fixed rate if given, else from EXIF or the names, whichever gives
    more than half of the photos a time.

    Args:
        rate_hz: fixed rate at which the photos were taken; ``names`` are then all of them.
        frames, columns, unit: as for ``read_image_times_csv``.

    Raises:
        InputError: none of these gives times, or the CSV file is not valid.
    """
    if csv_path is not None:
        return read_image_times_csv(csv_path, names, frames, columns=columns, unit=unit)
    if rate_hz is not None:
        return times_at_rate(names, rate_hz)
    if 2 * len(stamps := _stamps_by_exif(Path(folder), names)) > len(names):
        return _in_time_order(stamps, names, "exif")
    if 2 * len(stamps := _stamps_by_names(names)) > len(names):
        return _in_time_order(stamps, names, "file_names")
    raise InputError(
        f"no time for {names[0]}: expected a CSV file image_name,timestamp_s, or EXIF DateTimeOriginal in the photos, "
        "or file names that are times (like 1403715273262142976.png), or a fixed rate of the photos (--image_rate_hz)",
        folder,
    )


def times_at_rate(names: Sequence[str], rate_hz: float) -> ImageTimes:
    """Return times of photos that were taken at a fixed rate, the first one at 0.

    Args:
        names: all photos that were taken; the order is that of the numbers in their names.
    """
    ordered = sorted(names, key=natural_order)
    note = f"image times are by the given rate of {rate_hz:g} photos a second, from {ordered[0]} to {ordered[-1]}"
    return ImageTimes(tuple(ordered), np.arange(len(ordered)) / rate_hz, _FINEST_RESOLUTION_S, "rate", assumed=(note,))


def read_image_times_csv(
    path: AnyPath,
    names: Sequence[str] | None = None,
    frames: Mapping[str, Sequence[str]] = _NO_FRAMES,
    *,
    columns: Mapping[str, str] = NO_NAMES,
    unit: str | None = None,
) -> ImageTimes:
    """Read ``image_name,timestamp_s``, or another table with names of photos and times.

    Where photos are known, names in the table are matched with them by ``photos_meant``.

    Args:
        names: the existing photos; None: the names in the file are not checked.
        frames: groups of photos taken at once, each by the name of the photo among ``names`` that stands for it and
            belongs to it. A group gets the time of its first photo that has one. Without ``names``, only groups get
            times.
        columns, unit: as for ``read_photo_list``.

    Raises:
        InputError: with the line: a column is missing, a cell is not a time in seconds, a photo does not exist while
            one of ``names`` has no time, or a photo or a time appears twice.
    """
    table, times, resolutions_s = read_photo_list(path, columns=columns, unit=unit)
    frame_of = {photo: first for first, photos in frames.items() for photo in photos}
    image_names = photos_meant(table.text("image_name"), {*(names or ()), *frame_of})
    _refuse_repetitions(table, image_names, times.tolist(), frame_of)
    known, unknown = {*(names or ()), *frame_of} or set(image_names), list[int]()
    if names is not None:
        unknown = [row for row, name in enumerate(image_names) if name not in known]
        timed = set(image_names)
        # If every photo has a time, the unknown names belong to photos that were removed. If one has none, an unknown
        # name is probably misspelt.
        if unknown and not all({name, *frames.get(name, ())} & timed for name in names):
            raise table.error(unknown[0], "image_name", f"the name of a photo in the folder, like '{names[0]}'")
    stamps = {
        name: (time, resolution)
        for name, time, resolution in zip(image_names, times.tolist(), resolutions_s.tolist(), strict=True)
        if name in known
    }
    stamps = {name: stamp for name, stamp in stamps.items() if name not in frame_of} | {
        first: stamps[own[0]] for first, photos in frames.items() if (own := [p for p in photos if p in stamps])
    }
    if not stamps:
        raise InputError(f"none of the photos has a time, the first is {min(known)}", path)
    ordered = _in_time_order(stamps, names or tuple(stamps), "csv")
    notes = []
    if unknown:
        num = f"{len(unknown)} of the {len(image_names)}"
        notes.append(f"{num} names in {table.path.name} belong to no photo in the folder")
    return replace(ordered, notes=(*notes, *ordered.notes), assumed=table.told)


def _stamps_by_exif(folder: Path, names: Sequence[str]) -> dict[str, _Stamp]:
    """Return times by EXIF DateTimeOriginal, its fraction SubSecTimeOriginal and its zone OffsetTimeOriginal.

    The times are seconds since 1970 in UTC. Photos without a zone take the zone of a photo that has one. If none has,
    UTC is assumed, which shifts all times alike.
    """
    exifs = {
        name: {tag: text.strip("\0 ") for tag, text in exif_tags(folder / name).items() if isinstance(text, str)}
        for name in names
    }
    offsets = [_utc_offset(exif) for exif in exifs.values()]
    offset = next((known for known in offsets if known is not None), timedelta(0))
    return {name: stamp for name, exif in exifs.items() if (stamp := _exif_stamp(exif, offset)) is not None}


def _stamps_by_names(names: Sequence[str]) -> dict[str, _Stamp]:
    """Return times by names that end in one: ``1403715273262142976.png``, ``cam0/1305032180.405639.jpg``.

    A whole number is a time if, in s, ms, us or ns since 1970, it lies between 2001 and 2096. Smaller numbers are taken
    for frame numbers, which do not give a time. A number with three or more decimals is in seconds from any origin.
    """
    return {name: stamp for name in names if (stamp := _name_stamp(name)) is not None}


def _in_time_order(stamps: Mapping[str, _Stamp], names: Sequence[str], source: str) -> ImageTimes:
    """Sort the photos by time; of photos with the same time, keep the first by name."""
    ordered = sorted(stamps, key=lambda name: (stamps[name][0], name))
    kept = [n for i, n in enumerate(ordered) if i == 0 or stamps[n][0] > stamps[ordered[i - 1]][0]]
    resolution_s = max(min(resolution_s for _, resolution_s in stamps.values()), _FINEST_RESOLUTION_S)
    notes = []
    if missing := [name for name in names if name not in stamps]:
        notes.append(f"{len(missing)} of {len(names)} photos have no time and are left out, the first is {missing[0]}")
    if repeated := sorted(set(ordered) - set(kept)):
        is_of_one = len({os.path.dirname(name) for name in ordered}) == 1
        notes.append(
            f"{len(repeated)} of {len(names)} photos have the same time as another and are left out, "
            f"the first is {repeated[0]}{'' if is_of_one else ' (cameras of a rig need --rig_config_path)'}"
        )
    if resolution_s >= 1.0:
        notes.append("image times are whole seconds: at walking pace that is up to half a metre of path")
    return ImageTimes(
        image_names=tuple(kept),
        timestamps_s=np.array([stamps[name][0] for name in kept], dtype=np.float64),
        resolution_s=resolution_s,
        source=source,
        num_left_out=len(names) - len(kept),
        notes=tuple(notes),
    )


def _refuse_repetitions(
    table: TextTable, image_names: Sequence[str], times: Sequence[float], frame_of: Mapping[str, str]
) -> None:
    row_of_name: dict[str, int] = {}
    row_of_time: dict[float, int] = {}
    for row, (name, time) in enumerate(zip(image_names, times, strict=True)):
        if (first := row_of_name.setdefault(name, row)) != row:
            message = f"{name} is in line {table.line[first]} already, expected one row per photo"
            raise InputError(message, table.path, int(table.line[row]))
        first = row_of_time.setdefault(time, row)
        if first != row and frame_of.get(name, name) != frame_of.get(image_names[first], image_names[first]):
            message = f"{name} has the same time as {image_names[first]} in line {table.line[first]}, expected another"
            raise InputError(message, table.path, int(table.line[row]))


def _resolution(text: str) -> float:
    """Return the value of one unit in the last decimal place of a number as written."""
    return float(10.0 ** -len(text.partition(".")[2]))


def _exif_stamp(exif: Mapping[int, str], default_offset: timedelta) -> _Stamp | None:
    try:
        local = datetime.strptime(exif.get(_DATE_TIME_ORIGINAL, ""), "%Y:%m:%d %H:%M:%S")
    except ValueError:  # a camera whose clock was never set writes zeros or blanks
        return None
    known = _utc_offset(exif)
    offset = default_offset if known is None else known
    # Numbers are subtracted here, because Python has no date before the year 1.
    seconds = local.replace(tzinfo=timezone.utc).timestamp() - offset.total_seconds()
    if not TIME_S.hold(seconds):
        return None
    digits = exif.get(_SUB_SEC_TIME_ORIGINAL, "")
    fraction = f"0.{digits}" if digits.isdecimal() and digits.isascii() else "0"
    return seconds + float(fraction), _resolution(fraction)


def _utc_offset(exif: Mapping[int, str]) -> timedelta | None:
    found = re.fullmatch(r"([+-])(\d\d):(\d\d)", exif.get(_OFFSET_TIME_ORIGINAL, ""))
    if found is None:
        return None
    offset = timedelta(hours=int(found[2]), minutes=int(found[3]))
    return -offset if found[1] == "-" else offset


def _name_stamp(name: str) -> _Stamp | None:
    number = re.search(r"(?<!\d)(\d{1,30})(\.\d+)?$", os.path.splitext(name)[0])
    if number is None:
        return None
    whole, decimals = int(number[1]), (number[2] or ".")[1:]
    if len(decimals) >= _MIN_DECIMALS:
        return (float(number[0]), _resolution(number[0])) if TIME_S.hold(float(number[0])) else None
    for units_per_second in _UNITS_PER_SECOND:
        if not decimals and are_seconds_since_1970(whole / units_per_second):
            return whole / units_per_second, 1 / units_per_second
    return None

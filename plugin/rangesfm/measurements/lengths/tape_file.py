"""Files of measured lengths, and of marks in photos."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from rangesfm.errors import InputError
from rangesfm.measurements.lengths.measured_lists import LENGTHS, MARKS
from rangesfm.measurements.lengths.metashape import is_metashape_file, read_metashape_markers
from rangesfm.measurements.lengths.tape import CHECK, CLICKED_STDDEV_PX, CONTROL, Mark, Marker, Tape, TapedDistance
from rangesfm.measurements.ranges.readers.lists import metres
from rangesfm.options import LENGTH_M, PIXEL, STDDEV_M
from rangesfm.util.files.contents import AnyPath
from rangesfm.util.files.photo_names import photos_meant
from rangesfm.util.files.text_tables import TextTable, read_head, repeated

# Standard deviation of a length measured with care by a steel tape.
DEFAULT_STDDEV_M = 0.01


def read_tape(path: AnyPath) -> Tape:
    """Read ``from,to,distance_m[,stddev_m,kind]``, or another table of these.

    A length without a kind is a control length. Without a standard deviation it gets DEFAULT_STDDEV_M.

    Raises:
        InputError: the file is not valid; the error gives the line.
    """
    table = LENGTHS.read(Path(path))
    return Tape(_distances(table), distances_path=Path(path), notes=table.told)


def _distances(table: TextTable) -> tuple[TapedDistance, ...]:
    if not len(table):
        raise InputError("holds no distance, expected one per line", table.path)
    starts, ends = table.text("from"), table.text("to")
    kinds = [kind.lower() for kind in table.text("kind", empty=CONTROL)]
    for row, (start, end, kind) in enumerate(zip(starts, ends, kinds, strict=True)):
        if start == end:
            raise table.error(row, "to", "another end than 'from'")
        if kind not in (CONTROL, CHECK):
            raise table.error(row, "kind", f"{CONTROL} or {CHECK}")
    lengths = metres(table, "distance", LENGTH_M)
    stddevs = metres(table, "stddev", STDDEV_M, DEFAULT_STDDEV_M)
    rows = zip(starts, ends, lengths.tolist(), stddevs.tolist(), kinds, table.line.tolist(), strict=True)
    return tuple(TapedDistance((a, b), length, stddev, kind, line) for a, b, length, stddev, kind, line in rows)


def read_markers(path: AnyPath, stddev_px: float = CLICKED_STDDEV_PX) -> dict[str, Marker]:
    """Read ``marker,image_name,x_px,y_px``, another table of marks in photos, or Metashape's markers (XML).

    Args:
        path: the file.
        stddev_px: standard deviation of each coordinate.

    Raises:
        InputError: the file is not valid; the error gives the line.
    """
    if is_metashape_file(read_head(path)):
        return markers_of_marks(read_metashape_markers(Path(path)).seen, Path(path), stddev_px)
    table = MARKS.read(Path(path))
    pixels = np.column_stack([table.numbers(axis, bounds=PIXEL) for axis in ("x", "y")])
    seen: dict[str, list[Mark]] = {}
    rows = zip(table.text("image_name"), pixels.tolist(), table.line.tolist(), strict=True)
    for name, mark in zip(table.text("marker"), rows, strict=True):
        seen.setdefault(name, []).append(mark)
    return markers_of_marks(seen, Path(path), stddev_px)


def markers_of_marks(
    seen: Mapping[str, Sequence[Mark]], path: Path, stddev_px: float = CLICKED_STDDEV_PX
) -> dict[str, Marker]:
    """Return markers by name, given the marks of each that a file holds.

    Raises:
        InputError: a marker is twice in one photo; the error gives the line.
    """
    markers = {}
    for name, marks in seen.items():
        photos, pixels, lines = zip(*marks, strict=True)
        if again := repeated(photos):
            raise InputError(f"marker {name} is twice in {photos[again[0]]}, expected once", path, lines[again[0]])
        markers[name] = Marker(photos, np.array(pixels), lines, stddev_px, path)
    return markers


def markers_of_photos(markers: Mapping[str, Marker], photos: Collection[str]) -> dict[str, Marker]:
    """Return markers with the names of their photos as these are, by ``photos_meant``."""
    listed = [*dict.fromkeys(name for marker in markers.values() for name in marker.image_names)]
    meant = dict(zip(listed, photos_meant(listed, photos), strict=True))
    return {
        name: replace(marker, image_names=tuple(meant[photo] for photo in marker.image_names))
        for name, marker in markers.items()
    }

"""The table of the photos' times: the canonical CSV, or any table with names of photos and times."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from rangesfm.arrays import Array
from rangesfm.errors import InputError, printable
from rangesfm.measurements.ranges.readers.columns import read_timestamps
from rangesfm.measurements.ranges.readers.guess import Guess, find_time, is_range, is_rising, named_photos
from rangesfm.measurements.ranges.readers.layout import Layout
from rangesfm.measurements.ranges.readers.lists import (
    Choice,
    ListRows,
    UnclearListError,
    columns_by_user,
    columns_flag,
    layout_of_list,
    read_canonical_rows,
    read_rows,
)
from rangesfm.measurements.ranges.readers.times import SECONDS_PER_UNIT
from rangesfm.options import TIME_S
from rangesfm.util.files.contents import AnyPath
from rangesfm.util.files.text_tables import NO_NAMES, is_plain_table, read_head

QUANTITIES = ("image_name", "timestamp", "date", "nanoseconds")
_CANONICAL = {"image_name": "image_name", "timestamp": "timestamp_s"}
_EXPECTED = f"expected a table with {','.join(_CANONICAL.values())}"
# Largest plausible time between two photos; without a name, a time that may also be in a finer unit is asked for.
_SLOWEST_S = 120.0
_DECIMALS = re.compile(r"(?:^[-+]?\d*|:\d\d)[.,](\d+)", re.ASCII)


def read_photo_list(
    path: AnyPath, *, columns: Mapping[str, str] = NO_NAMES, unit: str | None = None
) -> tuple[ListRows, Array, Array]:
    """Read ``image_name,timestamp_s``, or another table with names of photos and times.

    Args:
        columns: name of the column of each quantity (QUANTITIES), or its number in a table without names; empty:
            recognized.
        unit: unit of the times as in [ranges] timestamp_unit; None: by the column's name or the values.

    Returns:
        The rows; their times (n,) in seconds; and the value (n,) of one unit in the last place of each time as written.

    Raises:
        UnclearListError: the columns or the unit are not known for sure; the advice says what to type.
        InputError: a cell is not a time or a name. The error gives the line.
    """
    path = Path(path)
    if not columns and unit is None and is_canonical_photo_list(read_head(path)):
        rows = read_canonical_rows(path, _CANONICAL, [*_CANONICAL.values()])
        return _with_resolution(rows, rows.table.numbers("timestamp_s", bounds=TIME_S), "s")
    layout = layout_of_list(path, "photos and times", _EXPECTED)
    needed = ("image_name", "timestamp")
    taken = columns_by_user(columns, QUANTITIES, needed, layout, path) if columns else find_photo_columns(path, layout)
    if taken is None:
        found = printable(", ".join(layout.units))
        raise InputError(f"no columns with photos and times; found {found}; {_EXPECTED}", path)
    rows, notes = read_rows(path, layout, taken, of=()), list[str]()

    def ask(units: Sequence[str], why: str) -> InputError:
        choices = [Choice(f"if they are {one}", ("--image_times_unit", one)) for one in units]
        return UnclearListError("photo times", path, layout, [f"the times have {why}"], choices)

    times_s, unit = read_timestamps(rows.table, taken, layout.units, unit, notes, ask, slowest_s=_SLOWEST_S)
    more = tuple(f"{path.name}: {note}" for note in notes)
    return _with_resolution(replace(rows, notes=(*rows.notes, *more)), times_s, unit)


def is_canonical_photo_list(head: str) -> bool:
    """Return whether a file with this beginning has the columns of the canonical CSV, and no decimal commas."""
    return is_plain_table(head, [*_CANONICAL.values()])


def find_photo_columns(path: Path, layout: Layout) -> dict[str, str] | None:
    """Return the name of the column of each quantity; None if the table is not one of photo times.

    Raises:
        UnclearListError: it may be one, but the columns are not known for sure.
    """
    photos = [column for column in layout.columns if column.names_photos] or named_photos(layout)
    others = [column for column in layout.columns if column not in photos and column.kind != "nothing"]
    if not photos or any(map(is_range, others)):
        return None
    guess = Guess()
    if layout.has_names:
        find_time(others, guess)
    doubts = []
    if len({tuple(map(os.path.basename, column.cells)) for column in photos}) > 1:
        doubts.append(f"any of {', '.join(column.name for column in photos)} may be the photo")
    if "timestamp" not in guess.columns:
        times = [column for column in others if column.kind == "times" or (len(others) == 1 and is_rising(column))]
        if len(times) != 1:
            return None
        guess.columns["timestamp"] = times[0].name
        doubts += [f"{times[0].name} may be the time"] * (layout.has_names and times[0].kind != "times")
    if not doubts:
        return {"image_name": photos[0].name, **guess.columns}
    choices = []
    for one in photos:
        columns = {"image_name": one.name, **guess.columns}
        choices.append(Choice(f"if {one.name} is the photo", columns_flag("image_times_columns", columns)))
    raise UnclearListError("photo times", path, layout, doubts, choices)


def _with_resolution(rows: ListRows, times_s: Array, unit: str) -> tuple[ListRows, Array, Array]:
    if not len(rows.table):
        raise InputError("no rows below the header, expected one per photo", rows.table.path)
    places = [len(found[1]) if (found := _DECIMALS.search(text)) else 0 for text in rows.text("timestamp")]
    resolution_s = SECONDS_PER_UNIT[unit] * 10.0 ** -np.array(places, np.float64)
    if "nanoseconds" in rows.columns:
        resolution_s[:] = SECONDS_PER_UNIT["ns"]
    return rows, times_s, resolution_s

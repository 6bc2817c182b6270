"""The table of the photos' times: the canonical CSV, or any table with names of photos and times."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from rangesfm.arrays import Array
from rangesfm.errors import InputError
from rangesfm.measurements.ranges.readers.guess import Guess, find_time, is_range, is_rising, named_photos, names_of
from rangesfm.measurements.ranges.readers.layout import Layout
from rangesfm.measurements.ranges.readers.lists import (
    TableForm,
    times_by_row,
    unclear_table,
)
from rangesfm.measurements.ranges.readers.times import SECONDS_PER_UNIT
from rangesfm.util.files.contents import AnyPath
from rangesfm.util.files.text_tables import NO_NAMES, TextTable, read_head

_DECIMALS = re.compile(r"(?:^[-+]?\d*|:\d\d)[.,](\d+)", re.ASCII)


def read_photo_list(
    path: AnyPath, *, columns: Mapping[str, str] = NO_NAMES, unit: str | None = None
) -> tuple[TextTable, Array, Array]:
    """Read ``image_name,timestamp_s``, or another table with names of photos and times.

    Args:
        columns: name of the column of each quantity (of PHOTO_TIMES), or its number in a table without names; empty:
            recognized.
        unit: unit of the times as in [ranges] timestamp_unit; None: by the column's name or the values.

    Returns:
        The rows; their times (n,) in seconds; and the value (n,) of one unit in the last place of each time as written.

    Raises:
        UnclearFileError: the columns or the unit are not known for sure; the advice says what to type.
        InputError: a cell is not a time or a name. The error gives the line.
    """
    path = Path(path)
    table = PHOTO_TIMES.read(path, columns)
    if not columns and PHOTO_TIMES.is_canonical(read_head(path)):
        unit = unit or "s"
    times_s, unit, notes = times_by_row(table, PHOTO_TIMES.what, unit, "image_times_unit")
    if not len(table):
        raise InputError("no rows below the header, expected one per photo", path)
    places = [len(found[1]) if (found := _DECIMALS.search(text)) else 0 for text in table.text("timestamp")]
    resolution_s = SECONDS_PER_UNIT[unit] * 10.0 ** -np.array(places, np.float64)
    if "nanoseconds" in table:
        resolution_s[:] = SECONDS_PER_UNIT["ns"]
    return replace(table, notes=(*table.notes, *notes)), times_s, resolution_s


def find_photo_columns(form: TableForm, path: Path, layout: Layout) -> dict[str, str] | None:
    """Return the name of the column of each quantity; None if the table is not one of photo times.

    Raises:
        UnclearFileError: it may be one, but the columns are not known for sure.
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
        doubts.append(f"any of {names_of(photos)} may be the photo")
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
        choices.append(form.choice(f"if {one.name} is the photo", {"image_name": one.name, **guess.columns}))
    raise unclear_table(form.what, path, layout, doubts, choices)


PHOTO_TIMES = TableForm(
    "photo times",
    {"image_name": "image_name", "timestamp": "timestamp_s"},
    ("image_name", "timestamp"),
    find_photo_columns,
    "image_times_columns",
    also=("date", "nanoseconds"),
)

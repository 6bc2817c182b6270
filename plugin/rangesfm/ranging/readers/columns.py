"""From named columns of a table to a range log: what the canonical CSV and mapped ones share."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import compress
from pathlib import Path

import numpy as np
import numpy.typing as npt

from rangesfm.errors import InputError
from rangesfm.files.tables import Table, read_table
from rangesfm.ranging.log import DEFAULT_TAG_ID, RangeLog
from rangesfm.ranging.readers.time_units import SECONDS_PER_UNIT, seconds_from_iso
from rangesfm.ranging.twr import StampOptions, double_sided_range, single_sided_range

UNITS_PER_METRE = {"m": 1.0, "cm": 100.0, "mm": 1000.0}
STAMPS = ("tx1", "rx1", "tx2", "rx2", "tx3", "rx3")
QUANTITIES = ("timestamp", "image_name", "anchor_id", "range", "tag_id", "range_stddev", "los", *STAMPS)

_TEXTS = ("image_name", "anchor_id", "tag_id")
_EXPECTED_RANGE = "a positive number{unit}; 0 means no measurement"


@dataclass(frozen=True)
class Columns:
    """Where a table has what a log needs.

    Attributes:
        required: name in the file of each of QUANTITIES that it must have: anchor_id, range (or the first
            four of STAMPS instead) and one of timestamp and image_name.
        optional: the same for those that it may have.
        timestamp_unit: one of TIMESTAMP_UNITS.
        range_unit: one of UNITS_PER_METRE, also of range_stddev.
        separator: between cells; None: told from the header row.
        header: names of all columns where the file's own header row is a comment; needs the separator.
        negative_is_no_measurement: as 0 is, and as an empty cell is then; otherwise they are errors.
        stamps: how time stamps become ranges, where there is no range.
    """

    required: Mapping[str, str]
    optional: Mapping[str, str]
    timestamp_unit: str = "s"
    range_unit: str = "m"
    separator: str | None = None
    header: tuple[str, ...] | None = None
    negative_is_no_measurement: bool = False
    stamps: StampOptions = field(default_factory=StampOptions)


def read_columns(path: Path, columns: Columns, format: str) -> RangeLog:
    """Read a log off the named columns.

    Args:
        format: name of the reader, for the record.

    Raises:
        InputError: with the line, for whatever is not a time, an id or a range; also if no range is left.
    """
    named = {**columns.optional, **columns.required}
    table = read_table(
        path,
        [*columns.required.values()],
        [*columns.optional.values()],
        text=[named[key] for key in _TEXTS if key in named],
        separator=columns.separator,
        header=columns.header,
    )
    name = {key: column for key, column in named.items() if column in table}
    ranges = _ranges(table, name["range"], columns) if "range" in name else _ranges_by_stamps(table, name, columns)
    timestamps = _timestamps(table, name["timestamp"], columns.timestamp_unit) if "timestamp" in name else None
    image_name = table.text(name["image_name"]) if timestamps is None else None
    anchor = table.categories(name["anchor_id"])
    tag = table.categories(name["tag_id"], empty=DEFAULT_TAG_ID) if "tag_id" in name else None
    stddevs = _stddevs(table, name["range_stddev"], columns) if "range_stddev" in name else None
    los = _line_of_sight(table, name["los"]) if "los" in name else None
    measured = ranges > 0
    if not np.any(measured):
        said = f"all {len(table)} records say that there was no measurement" if len(table) else "no records"
        raise InputError(f"no usable range: {said}", path)
    return RangeLog.from_arrays(
        anchor.subset(measured),
        ranges[measured],
        timestamp_s=None if timestamps is None else timestamps[measured],
        image_name=None if image_name is None else list(compress(image_name, measured.tolist())),
        range_stddev_m=None if stddevs is None else stddevs[measured],
        tag_id=None if tag is None else tag.subset(measured),
        los=None if los is None else los[measured],
        line=table.line[measured],
        source=path,
        format=format,
        num_no_measurement=int(np.count_nonzero(~measured)),
    )


def _ranges(table: Table, column: str, columns: Columns) -> npt.NDArray[np.float64]:
    unit = " of metres" if columns.range_unit == "m" else f" of {columns.range_unit}"
    expected = _EXPECTED_RANGE.format(unit=unit)
    may_be_missing = columns.negative_is_no_measurement
    ranges = table.numbers(column, empty=0.0 if may_be_missing else None, expected=expected)
    if not may_be_missing and np.any(ranges < 0):
        raise table.error(int(np.argmax(ranges < 0)), column, expected)
    return ranges / UNITS_PER_METRE[columns.range_unit]


def _ranges_by_stamps(table: Table, name: Mapping[str, str], columns: Columns) -> npt.NDArray[np.float64]:
    """Two-way ranging, double-sided where the third message is there; 0 (no measurement) where a stamp is empty."""
    stamps = {
        stamp: table.numbers(name[stamp], empty=np.nan, expected="a time stamp or nothing")
        for stamp in STAMPS
        if stamp in name
    }
    if len(stamps) == len(STAMPS) and len(table) > 0:
        ranges = double_sided_range(**stamps, options=columns.stamps)
    else:
        ranges = single_sided_range(**{stamp: stamps[stamp] for stamp in STAMPS[:4]}, options=columns.stamps)
    return np.nan_to_num(ranges, nan=0.0)


def _timestamps(table: Table, column: str, unit: str) -> npt.NDArray[np.float64]:
    if unit != "iso":
        return table.numbers(column, expected=f"a time in {unit}") * SECONDS_PER_UNIT[unit]
    seconds = np.empty(len(table))
    for row, cell in enumerate(table.text(column)):
        try:
            seconds[row] = seconds_from_iso(cell)
        except ValueError:
            raise table.error(row, column, "a time as 2026-01-31T12:00:00.000Z") from None
    return seconds


def _stddevs(table: Table, column: str, columns: Columns) -> npt.NDArray[np.float64]:
    expected = "a positive number or nothing"
    stddevs = table.numbers(column, empty=np.nan, expected=expected) / UNITS_PER_METRE[columns.range_unit]
    if np.any(stddevs <= 0):
        raise table.error(int(np.argmax(stddevs <= 0)), column, expected)
    return stddevs


def _line_of_sight(table: Table, column: str) -> npt.NDArray[np.int8]:
    expected = "1 (line of sight), 0 (none) or nothing"
    los = table.numbers(column, empty=-1.0, expected=expected)
    wrong = ~np.isin(los, (0.0, 1.0)) & (np.array(table.text(column, empty="")) != "")
    if np.any(wrong):
        raise table.error(int(np.argmax(wrong)), column, expected)
    return los.astype(np.int8)

"""Range logs from the named columns of a table; shared by the canonical CSV and by mapped tables."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np
import numpy.typing as npt

from rangesfm.arrays import Array, Categories
from rangesfm.measurements.ranges.range_log import DEFAULT_TAG_ID, RangeLog
from rangesfm.measurements.ranges.readers.counters import continued
from rangesfm.measurements.ranges.readers.layout import MISSING, Layout
from rangesfm.measurements.ranges.readers.measured import which_are_measured, which_are_within_reach
from rangesfm.measurements.ranges.readers.reader import ReadOptions
from rangesfm.measurements.ranges.readers.times import (
    CIVIL_TIME,
    CIVIL_UNITS,
    DATE_ORDERS,
    SECONDS_PER_UNIT,
    TIME_OF_DAY,
    CivilClock,
    date_order,
)
from rangesfm.measurements.ranges.readers.units import (
    SLOWEST_S,
    UNITS_PER_METRE,
    Ask,
    days_before_1970,
    range_unit,
    time_unit,
    units_within_reach,
)
from rangesfm.measurements.ranges.twr import StampOptions, double_sided_range, single_sided_range
from rangesfm.options import TIME_S
from rangesfm.util.files.text_tables import TextTable, read_table

STAMPS = ("tx1", "rx1", "tx2", "rx2", "tx3", "rx3")
QUANTITIES = (
    *("timestamp", "date", "nanoseconds", "image_name", "anchor_id", "range", "tag_id", "antenna", "range_stddev"),
    *("los", "nlos", *STAMPS),
)


@dataclass(frozen=True)
class RangeColumns:
    """Columns of a table that hold the quantities of a log.

    Attributes:
        required: by quantity (QUANTITIES), the names of columns that the table must have: one of timestamp and
            image_name, and range, or instead of it the first four of STAMPS, or ``wide``.
        optional: by quantity, the names of columns that it may have.
        wide: by name, the columns of ranges that each belong to one anchor and one tag, with the ids of these.
        anchor_id: anchor of all ranges, if neither a column nor ``wide`` gives it.
        layout: layout of the file; None: its first row is its header.
        is_strict: whether ids are taken literally. Otherwise 1.000 is the id 1.
        notes: lines for the user about how the columns were found.
    """

    required: Mapping[str, str]
    optional: Mapping[str, str] = field(default_factory=dict)
    wide: Mapping[str, tuple[str, str]] = field(default_factory=dict)
    anchor_id: str = ""
    layout: Layout | None = None
    is_strict: bool = False
    notes: tuple[str, ...] = ()


def read_columns(path: Path, columns: RangeColumns, options: ReadOptions, format: str) -> RangeLog:
    """Read a log from the named columns of a table.

    Args:
        options: the user's options for units, time stamps and, without a layout, the separator.
        format: name of the reader, which the log keeps.

    Raises:
        InputError: a cell is not a time, an id or a range (the error gives the line), no range is left, or a unit is
            ambiguous.
    """
    named, layout = {**columns.optional, **columns.required}, columns.layout
    anchors = [column for anchor_id, _ in columns.wide.values() if (column := column_of_anchor(anchor_id))]
    notes = [*columns.notes]
    if layout is None:
        required = dict.fromkeys([*columns.required.values(), *columns.wide, *anchors])
        table = read_table(path, [*required], [*columns.optional.values()], separator=options.separator)
    else:
        table, more = layout.read()
        notes += more
        if layout.are_records and "range" in named:  # records without a range are about something else
            table = table.where([cell != "" for cell in table.text(named["range"], empty="")])
    name = {key: column for key, column in named.items() if column in table}
    units = layout.units if layout else {}
    anchor, tag = _anchors(table, name, columns), _tags(table, name, columns)
    timestamps = np.zeros(0)
    if "timestamp" in name:
        ask = partial(options.which_unit, path, "timestamp")
        # One anchor after the other in a file: the times go back to the log's beginning, whatever the clock is.
        in_turn = columns.wide or np.count_nonzero(np.diff(anchor.index)) >= len(anchor.names)
        timestamps, _ = read_timestamps(
            table, name, units, options.timestamp_unit, notes, ask, may_wrap=bool(in_turn or len(anchor.names) < 2)
        )
    image_name = [] if "timestamp" in name else table.text(name["image_name"])
    num_ends = max(1, len(columns.wide))
    row = np.repeat(np.arange(len(table)), num_ends)
    ranges = _ranges(table, name, columns, options)
    link = anchor.index * len(tag.names) + tag.index
    measured, of_codes = which_are_measured(ranges, link, path)
    notes += of_codes
    unit, others = "m", list[str]()
    if "range" in name or columns.wide:
        column = name.get("range") or next(iter(columns.wide))
        column = f"{column} {units.get(column, '')}".strip()
        ask = partial(options.which_unit, path, "range")
        times = timestamps[row[measured]] if "timestamp" in name else timestamps
        unit = options.range_unit or range_unit(column, ranges[measured], times, link[measured], notes, ask)
        mapped = options if options.columns or not columns.is_strict else options.changed(columns=name)
        others = [mapped.command(path, range_unit=other) for other in units_within_reach(ranges[measured], unit)]
    per_metre = UNITS_PER_METRE[unit]
    ranges_m = ranges / per_metre
    measured[measured], of_far = which_are_within_reach(ranges_m[measured], path, others)
    notes += of_far
    row, anchor, tag = row[measured], anchor.subset(measured), tag.subset(measured)
    stddevs, los = np.full(len(table), np.nan), _line_of_sight(table, name)
    if "range_stddev" in name:
        stddevs = table.numbers(name["range_stddev"], empty=np.nan, expected="a number or nothing") / per_metre
    return RangeLog.from_arrays(
        anchor,
        ranges_m[measured],
        timestamp_s=timestamps[row] if "timestamp" in name else timestamps,
        image_name=[image_name[k] for k in row.tolist()] if image_name else (),
        range_stddev_m=stddevs[row],
        tag_id=tag,
        los=los[row],
        line=table.line[row],
        source=path,
        format=format,
        num_no_measurement=int(np.count_nonzero(~measured)),
        notes=tuple(notes),
    )


def _anchors(table: TextTable, name: Mapping[str, str], columns: RangeColumns) -> Categories:
    """Return the anchor of each range, row by row: the same in each row, or from a column."""
    if not columns.wide:
        if "anchor_id" not in name:
            return _repeated([columns.anchor_id], len(table))
        return _ids(table, name["anchor_id"], columns, None)
    each = [
        _ids(table, said, columns, "") if (said := column_of_anchor(anchor_id)) else _repeated([anchor_id], len(table))
        for anchor_id, _ in columns.wide.values()
    ]
    names = Categories.from_texts([name for one in each for name in one.names])
    first = np.cumsum([0, *(len(one.names) for one in each)])
    index = np.column_stack([names.index[one.index + start] for one, start in zip(each, first)])
    return Categories(names.names, index.ravel())


def _tags(table: TextTable, name: Mapping[str, str], columns: RangeColumns) -> Categories:
    """Return the tag of each range, row by row; each antenna of a tag counts as a tag of its own."""
    if "tag_id" not in name:
        tag_ids = [tag_id or DEFAULT_TAG_ID for _, tag_id in columns.wide.values()]
        return _repeated(tag_ids or [DEFAULT_TAG_ID], len(table))
    tag = _ids(table, name["tag_id"], columns, DEFAULT_TAG_ID)
    if "antenna" in name:
        antenna = _ids(table, name["antenna"], columns, "")
        if len(antenna.names) > 1:
            pairs = zip(tag.index.tolist(), antenna.index.tolist())
            tag = Categories.from_texts([f"{tag.names[one]}/{antenna.names[other]}" for one, other in pairs])
    return Categories(tag.names, np.repeat(tag.index, max(1, len(columns.wide))))


def column_of_anchor(anchor_id: str) -> str | None:
    """Return the name of the column that holds the anchor of a column of ranges, or None.

    Such a column of ranges has "@" and that name in the place of its anchor.
    """
    return anchor_id[1:] if anchor_id.startswith("@") else None


def _repeated(ids: list[str], num_rows: int) -> Categories:
    """Return the ids, repeated in every row."""
    each = Categories.from_texts(ids)
    return Categories(each.names if num_rows else (), np.tile(each.index, num_rows))


def _ids(table: TextTable, column: str, columns: RangeColumns, empty: str | None) -> Categories:
    ids = table.categories(column, empty=empty)
    if columns.is_strict or not all(
        re.fullmatch(r"\d{1,18}(?:\.\d*(?:[eE][+-]?0{0,3}\d{1,2})?)?", name) for name in ids.names
    ):
        return ids
    whole = [str(int(float(name))) if float(name) == int(float(name)) else name for name in ids.names]
    merged = Categories.from_texts(whole)
    return Categories(merged.names, merged.index[ids.index])


def _ranges(table: TextTable, name: Mapping[str, str], columns: RangeColumns, options: ReadOptions) -> Array:
    """Return the ranges (n,) in the unit of the file, row by row; one that is not positive means no measurement."""
    if "range" not in name and not columns.wide:
        return _ranges_by_stamps(table, name, StampOptions.from_log_options(options))
    unit = " of metres" if options.range_unit in (None, "m") else f" of {options.range_unit}"
    expected, names = f"a positive number{unit}; 0 means no measurement", columns.wide or [name["range"]]
    return np.column_stack([table.numbers(k, empty=0.0, missing=MISSING, expected=expected) for k in names]).ravel()


def _ranges_by_stamps(table: TextTable, name: Mapping[str, str], options: StampOptions) -> Array:
    """Compute ranges (n,) from two-way ranging, double-sided if there is a third message; 0 where a stamp is empty."""
    stamps = {
        stamp: table.numbers(name[stamp], empty=np.nan, expected="a time stamp or nothing")
        for stamp in STAMPS
        if stamp in name
    }
    if len(stamps) == len(STAMPS) and len(table) > 0:
        ranges = double_sided_range(**stamps, options=options)
    else:
        ranges = single_sided_range(**{stamp: stamps[stamp] for stamp in STAMPS[:4]}, options=options)
    return np.nan_to_num(ranges, nan=0.0)


def read_timestamps(
    table: TextTable,
    name: Mapping[str, str],
    units: Mapping[str, str],
    said: str | None,
    notes: list[str],
    ask: Ask,
    *,
    slowest_s: float = SLOWEST_S,
    may_wrap: bool = True,
) -> tuple[Array, str]:
    """Return the times (n,) of the rows of a table in seconds, and the unit in which they are written.

    Args:
        name: name of the column of timestamp and, if there are any, of date and nanoseconds.
        units: unit after the numbers of each column, by its name.
        said: unit that the user gave; None: found from names and values.
        notes: gets a line for the user on what was assumed.
        ask: returns the error about an ambiguous unit.
        may_wrap: whether times that go back may be those of a counter that begins again.

    Raises:
        InputError: a cell is not a time, or the unit is ambiguous.
    """
    column = name["timestamp"]
    if said in CIVIL_UNITS or "date" in name or (said is None and not table.begins_with_number(column)):
        return _civil_times(table, name, said, notes, ask), "s"
    times = table.numbers(column, expected=f"a time in {said or 's'}")
    times, counter = continued(times) if may_wrap else (times, None)
    is_in_ticks = counter is not None and counter.counts_dw1000_ticks
    if counter is not None:
        taken = ", taken for the ticks of a DW1000" * (said is None and is_in_ticks)
        notes.append(f"{column} {counter}{taken}: its times are continued")
    name_with_unit = f"{column} {units.get(column, '')}".strip()
    unit = said or ("ticks" if is_in_ticks else time_unit(name_with_unit, times, notes, ask, slowest_s))
    seconds = (times - (days_before_1970(times) if unit == "d" else 0.0)) * SECONDS_PER_UNIT[unit]
    table.refuse(~TIME_S.hold(seconds), column, f"a time in {unit}")
    return (seconds + 1e-9 * table.numbers(name["nanoseconds"]) if "nanoseconds" in name else seconds), unit


def _civil_times(table: TextTable, name: Mapping[str, str], unit: str | None, notes: list[str], ask: Ask) -> Array:
    texts = table.text(name["timestamp"])
    if "date" in name:
        texts = [f"{date} {time}" for date, time in zip(table.text(name["date"]), texts)]
    civil = [match for text in texts if (match := CIVIL_TIME.fullmatch(text))]
    dates = [match[1] for match in civil]
    order = unit if unit in DATE_ORDERS else date_order(dates) if dates else "ymd"
    if order is None:
        raise ask(DATE_ORDERS, f"dates such as {dates[0]}")
    clock, seconds = CivilClock(order), np.empty(len(table))
    for row, text in enumerate(texts):
        try:
            seconds[row] = clock.seconds(text)
        except ValueError:
            expected = f"a date as {order} and a time" if dates else "a time such as 2026-01-31T12:00:00.000Z"
            raise table.error(row, name["timestamp"], expected) from None
    if texts and TIME_OF_DAY.fullmatch(texts[0]):
        notes.append("times of day without a date: counted from the midnight before the first")
    elif len(civil) < len(texts) or any(match[5] is None for match in civil):
        notes.append("civil times without a zone are read as UTC")
    return seconds


def _line_of_sight(table: TextTable, name: Mapping[str, str]) -> npt.NDArray[np.int8]:
    column = name.get("los") or name.get("nlos")
    if column is None:
        return np.full(len(table), -1, np.int8)
    expected = "1 (line of sight), 0 (none) or nothing"
    los = table.numbers(column, empty=-1.0, expected=expected)
    wrong = ~np.isin(los, (0.0, 1.0)) & (np.array(table.text(column, empty="")) != "")
    table.refuse(wrong, column, expected)
    return np.where(los < 0, -1, los if "los" in name else 1 - los).astype(np.int8)

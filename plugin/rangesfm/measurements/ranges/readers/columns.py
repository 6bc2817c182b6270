"""Range logs from tables with columns by quantity, and the times in any table."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from types import MappingProxyType
from typing import Final

import numpy as np
import numpy.typing as npt

from rangesfm.arrays import Array, Categories
from rangesfm.errors import InputError
from rangesfm.measurements.ranges.range_log import DEFAULT_TAG_ID, RangeLog
from rangesfm.measurements.ranges.readers.counters import continued
from rangesfm.measurements.ranges.readers.layout import MISSING
from rangesfm.measurements.ranges.readers.measured import which_are_measured, which_are_within_reach
from rangesfm.measurements.ranges.readers.times import (
    CIVIL_TIME,
    CIVIL_UNITS,
    DATE_ORDERS,
    SECONDS_PER_UNIT,
    TIME_OF_DAY,
    Clock,
    date_order,
)
from rangesfm.measurements.ranges.readers.unclear import Choice, columns_typed
from rangesfm.measurements.ranges.readers.units import (
    SLOWEST_S,
    Ask,
    days_before_1970,
    range_unit,
    refuse_two_units,
    time_unit,
    units_within_reach,
    which_unit,
)
from rangesfm.measurements.ranges.readers.vocabulary import named_length_unit
from rangesfm.measurements.ranges.twr import StampOptions, double_sided_range, single_sided_range
from rangesfm.options import TIME_S, RangesOptions
from rangesfm.util.files.text_tables import TextTable
from rangesfm.util.units import UNITS_PER_METRE

STAMPS = ("tx1", "rx1", "tx2", "rx2", "tx3", "rx3")
QUANTITIES = (
    *("timestamp", "date", "nanoseconds", "image_name", "anchor_id", "range", "tag_id", "antenna", "range_stddev"),
    *("los", "nlos", *STAMPS),
)
CANONICAL = "canonical"
NO_WIDE: Final[Mapping[str, tuple[str, str]]] = MappingProxyType({})


def read_columns(
    table: TextTable,
    options: RangesOptions,
    format: str,
    *,
    wide: Mapping[str, tuple[str, str]] = NO_WIDE,
    anchor_id: str = "",
) -> RangeLog:
    """Return the log in a table with columns by quantity (QUANTITIES).

    It has timestamp or image_name, and range, or instead of it the first four of STAMPS, or ``wide``.

    Args:
        options: the user's options for units and time stamps.
        format: name of the reader, which the log keeps. In a CANONICAL one ids are literal; in others, 1.000 is the id
            1.
        wide: columns of ranges that each belong to one anchor and one tag, with the ids of these. The column of the
            anchor's ids, if there is one, has "@" before its name in the place of the id.
        anchor_id: anchor of all ranges, if neither a column nor ``wide`` gives it.

    Raises:
        InputError: a cell is not a time, an id or a range (the error gives the line), no range is left, or a unit is
            ambiguous.
    """
    path, notes, is_literal = table.path, [*table.notes], format == CANONICAL
    anchor, tag = _anchors(table, wide, anchor_id, is_literal), _tags(table, wide, is_literal)
    timestamps, image_name = np.zeros(0), list[str]()
    if "timestamp" in table:
        ask = partial(which_unit, path, "timestamp")
        # One anchor after the other in a file: the times go back to the log's beginning, whatever the clock is.
        in_turn = wide or np.count_nonzero(np.diff(anchor.index)) >= len(anchor.names)
        may_wrap = bool(in_turn or len(anchor.names) < 2)
        timestamps, _ = read_timestamps(table, options.timestamp_unit, notes, ask, may_wrap=may_wrap)
    else:
        image_name = table.text("image_name")
    row = np.repeat(np.arange(len(table)), max(1, len(wide)))
    if options.range_unit is None and len(units := _named_units(table, [*wide])) > 1:
        table, options = _in_metres(table, units), options.changed(range_unit="m")
    ranges = _ranges(table, [*wide] or ["range"], options)
    link = anchor.index * len(tag.names) + tag.index
    measured, of_codes = which_are_measured(ranges, link, path)
    notes += of_codes
    unit, others = "m", list[Choice]()
    if "range" in table or wide:
        column = table.heading("range" if "range" in table else next(iter(wide)))
        ask = partial(which_unit, path, "range")
        times = timestamps[row[measured]] if "timestamp" in table else timestamps
        unit = options.range_unit or range_unit(column, ranges[measured], times, link[measured], notes, ask)
        mapped = {"columns": columns_typed(table.names)} if is_literal and not options.columns else {}
        others = [Choice("", {**mapped, "range_unit": other}) for other in units_within_reach(ranges[measured], unit)]
    per_metre = UNITS_PER_METRE[unit]
    ranges_m = ranges / per_metre
    refuse_two_units(ranges_m[measured], link[measured], table.line[row[measured]], path)
    measured[measured], of_far = which_are_within_reach(ranges_m[measured], path, others)
    notes += of_far
    row, anchor, tag = row[measured], anchor.subset(measured), tag.subset(measured)
    stddevs, los = np.full(len(table), np.nan), _line_of_sight(table)
    if "range_stddev" in table:
        stddevs = table.numbers("range_stddev", empty=np.nan, expected="a number or nothing") / per_metre
    return RangeLog.from_arrays(
        anchor,
        ranges_m[measured],
        timestamp_s=timestamps[row] if "timestamp" in table else timestamps,
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


def _anchors(table: TextTable, wide: Mapping[str, tuple[str, str]], anchor_id: str, is_literal: bool) -> Categories:
    """Return the anchor of each range, row by row: the same in each row, or from a column."""
    if not wide:
        if "anchor_id" not in table:
            return _repeated([anchor_id], len(table))
        return _ids(table, "anchor_id", is_literal)
    each = [
        _ids(table, said, is_literal, "") if said.startswith("@") else _repeated([said], len(table))
        for said, _ in wide.values()
    ]
    names = Categories.from_texts([name for one in each for name in one.names])
    first = np.cumsum([0, *(len(one.names) for one in each)])
    index = np.column_stack([names.index[one.index + start] for one, start in zip(each, first)])
    return Categories(names.names, index.ravel())


def _tags(table: TextTable, wide: Mapping[str, tuple[str, str]], is_literal: bool) -> Categories:
    """Return the tag of each range, row by row; each antenna of a tag counts as a tag of its own."""
    if "tag_id" not in table:
        tag_ids = [tag_id or DEFAULT_TAG_ID for _, tag_id in wide.values()]
        return _repeated(tag_ids or [DEFAULT_TAG_ID], len(table))
    tag = _ids(table, "tag_id", is_literal, DEFAULT_TAG_ID)
    if "antenna" in table:
        antenna = _ids(table, "antenna", is_literal, "")
        if len(antenna.names) > 1:
            pairs = zip(tag.index.tolist(), antenna.index.tolist())
            tag = Categories.from_texts([f"{tag.names[one]}/{antenna.names[other]}" for one, other in pairs])
    return Categories(tag.names, np.repeat(tag.index, max(1, len(wide))))


def _repeated(ids: list[str], num_rows: int) -> Categories:
    """Return the ids, repeated in every row."""
    each = Categories.from_texts(ids)
    return Categories(each.names if num_rows else (), np.tile(each.index, num_rows))


def _ids(table: TextTable, column: str, is_literal: bool, empty: str | None = None) -> Categories:
    ids = table.categories(column, empty=empty)
    if is_literal or not all(
        re.fullmatch(r"\d{1,18}(?:\.\d*(?:[eE][+-]?0{0,3}\d{1,2})?)?", name) for name in ids.names
    ):
        return ids
    whole = [str(int(float(name))) if float(name) == int(float(name)) else name for name in ids.names]
    merged = Categories.from_texts(whole)
    return Categories(merged.names, merged.index[ids.index])


def _ranges(table: TextTable, columns: Sequence[str], options: RangesOptions) -> Array:
    """Return the ranges (n,) in the unit of the file, row by row; one that is not positive means no measurement."""
    if columns == ["range"] and "range" not in table:
        return _ranges_by_stamps(table, StampOptions.from_log_options(options))
    unit = " of metres" if options.range_unit in (None, "m") else f" of {options.range_unit}"
    expected = f"a positive number{unit}; 0 means no measurement"
    return np.column_stack([table.numbers(k, empty=0.0, missing=MISSING, expected=expected) for k in columns]).ravel()


def _named_units(table: TextTable, wide: Sequence[str]) -> dict[str, list[str]]:
    """Return the columns of ranges by the unit in their names, "" for none."""
    units: dict[str, list[str]] = {}
    for column in wide:
        units.setdefault(named_length_unit(table.heading(column)) or "", []).append(column)
    return units


def _in_metres(table: TextTable, units: Mapping[str, Sequence[str]]) -> TextTable:
    """Return a table with its ranges in metres, given the columns of these by unit.

    Raises:
        InputError: a column has no unit.
    """
    if bare := units.get(""):
        others = ", ".join(unit for unit in units if unit)
        message = f"{table.names[bare[0]]} has no unit, and other columns of ranges are in {others}: give each its unit"
        raise InputError(message, table.path)
    cells = dict(table.cells)
    for unit, columns in units.items():
        for column in columns:
            values = table.numbers(column, empty=0.0, missing=MISSING) / UNITS_PER_METRE[unit]
            cells[column] = [f"{value:.12g}" for value in values.tolist()]
    return replace(table, cells=cells)


def _ranges_by_stamps(table: TextTable, options: StampOptions) -> Array:
    """Compute ranges (n,) from two-way ranging, double-sided if there is a third message; 0 where a stamp is empty."""
    stamps = {
        stamp: table.numbers(stamp, empty=np.nan, expected="a time stamp or nothing")
        for stamp in STAMPS
        if stamp in table
    }
    if len(stamps) == len(STAMPS) and len(table) > 0:
        ranges = double_sided_range(**stamps, options=options)
    else:
        ranges = single_sided_range(**{stamp: stamps[stamp] for stamp in STAMPS[:4]}, options=options)
    return np.nan_to_num(ranges, nan=0.0)


def read_timestamps(
    table: TextTable,
    said: str | None,
    notes: list[str],
    ask: Ask,
    *,
    slowest_s: float = SLOWEST_S,
    may_wrap: bool = True,
) -> tuple[Array, str]:
    """Return the times (n,) of the rows of a table in seconds, and the unit in which they are written.

    Args:
        table: with the quantity timestamp, and if there are any, date and nanoseconds.
        said: unit that the user gave; None: found from names and values.
        notes: gets a line for the user on what was assumed.
        ask: returns the error about an ambiguous unit.
        may_wrap: whether times that go back may be those of a counter that begins again.

    Raises:
        InputError: a cell is not a time, or the unit is ambiguous.
    """
    if said in CIVIL_UNITS or "date" in table or (said is None and not table.begins_with_number("timestamp")):
        return _civil_times(table, said, notes, ask), "s"
    times = table.numbers("timestamp", expected=f"a time in {said or 's'}")
    times, counter = continued(times) if may_wrap else (times, None)
    is_in_ticks = counter is not None and counter.counts_dw1000_ticks
    if counter is not None:
        taken = ", taken for the ticks of a DW1000" * (said is None and is_in_ticks)
        notes.append(f"{table.names.get('timestamp', 'the time')} {counter}{taken}: its times are continued")
    unit = said or ("ticks" if is_in_ticks else time_unit(table.heading("timestamp"), times, notes, ask, slowest_s))
    seconds = (times - (days_before_1970(times) if unit == "d" else 0.0)) * SECONDS_PER_UNIT[unit]
    table.refuse(~TIME_S.hold(seconds), "timestamp", f"a time in {unit}")
    return (seconds + 1e-9 * table.numbers("nanoseconds") if "nanoseconds" in table else seconds), unit


def _civil_times(table: TextTable, unit: str | None, notes: list[str], ask: Ask) -> Array:
    texts = table.text("timestamp")
    if "date" in table:
        texts = [f"{date} {time}" for date, time in zip(table.text("date"), texts)]
    civil = [match for text in texts if (match := CIVIL_TIME.fullmatch(text))]
    dates = [match[1] for match in civil]
    order = unit if unit in DATE_ORDERS else date_order(dates) if dates else "ymd"
    if order is None:
        raise ask(DATE_ORDERS, f"dates such as {dates[0]}")
    clock, seconds = Clock(order), np.empty(len(table))
    for row, text in enumerate(texts):
        try:
            seconds[row] = clock.civil_seconds(text)
        except ValueError:
            expected = f"a date as {order} and a time" if dates else "a time such as 2026-01-31T12:00:00.000Z"
            raise table.error(row, "timestamp", expected) from None
    if texts and TIME_OF_DAY.fullmatch(texts[0]):
        notes.append("times of day without a date: counted from the midnight before the first")
    elif len(civil) < len(texts) or any(match[5] is None for match in civil):
        notes.append("civil times without a zone are read as UTC")
    return seconds


def _line_of_sight(table: TextTable) -> npt.NDArray[np.int8]:
    column = "los" if "los" in table else "nlos"
    if column not in table:
        return np.full(len(table), -1, np.int8)
    expected = "1 (line of sight), 0 (none) or nothing"
    los = table.numbers(column, empty=-1.0, expected=expected)
    wrong = ~np.isin(los, (0.0, 1.0)) & (np.array(table.text(column, empty="")) != "")
    table.refuse(wrong, column, expected)
    return np.where(los < 0, -1, los if column == "los" else 1 - los).astype(np.int8)

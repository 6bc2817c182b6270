"""Logs of ranges that are read one by one, from printed lines or messages; tables are read column by column."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from itertools import compress
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rangesfm.arrays import Array, Categories
from rangesfm.errors import InputError
from rangesfm.measurements.ranges.anchors.anchor import Anchor
from rangesfm.measurements.ranges.range_log import DEFAULT_TAG_ID, RangeLog
from rangesfm.measurements.ranges.readers.counters import continued
from rangesfm.measurements.ranges.readers.measured import which_are_measured, which_are_within_reach
from rangesfm.measurements.ranges.readers.reader import EndpointRoles, Reader
from rangesfm.measurements.ranges.readers.times import SECONDS_PER_UNIT
from rangesfm.measurements.ranges.readers.units import SLOWEST_S, time_unit, which_unit
from rangesfm.options import TIME_S, RangesOptions

RECORD_TIMES = (
    "this radio prints no times, so record the log with the host's time at the beginning of each line (seconds, ms, us "
    "or ns, or 2026-01-31T12:00:00.000Z)"
)


class Reading(NamedTuple):
    """A range as a radio reports it (see RangeLog); one that is not a positive number means no measurement.

    Attributes:
        timestamp_s: by the clock of the host or in a message; NaN if there is none.
        counted_s: by the radio's own count; NaN if there is none.
    """

    timestamp_s: float
    anchor_id: str
    range_m: float
    line: int = 0
    tag_id: str = DEFAULT_TAG_ID
    range_stddev_m: float = math.nan
    los: int = -1
    counted_s: float = math.nan


def refuse_options_of_tables(options: RangesOptions, path: Path) -> None:
    """Raise InputError if options are given that only tables have."""
    if options.columns or options.range_unit is not None or options.separator:
        message = "the log's format is not a table: columns, range_unit and separator cannot be given"
        raise InputError(message, path)


def log_of_readings(
    found: Sequence[Reading], path: Path, options: RangesOptions, format: str, notes: Sequence[str] = ()
) -> RangeLog:
    """Return the log of some ranges, without those that are no measurements.

    The times are those of the host, or those that the radio counts where the host's are missing or all the same.

    Raises:
        InputError: there is no measurement, a time is missing, or the unit of the times is ambiguous.
    """
    ranges = np.array([reading.range_m for reading in found], np.float64)
    link = Categories.from_texts([f"{reading.tag_id} {reading.anchor_id}" for reading in found]).index
    measured, of_codes = which_are_measured(ranges, link, path)
    measured[measured], of_far = which_are_within_reach(ranges[measured], path)
    times, anchor_ids, ranges_m, lines, tag_ids, stddevs, los, counted = zip(*compress(found, measured))
    times_s, counted_s, of_times = np.array(times, np.float64), np.array(counted, np.float64), list[str]()
    stand_still = not np.ptp(times_s) and np.ptp(counted_s) > 0
    if not np.isnan(counted_s).any() and (np.isnan(times_s).any() or stand_still):
        times_s = counted_s
        of_times.append("no time of the host in front of the lines: the time is the radio's count")
    if np.isnan(times_s).any():
        raise InputError(
            f"no time before the range; {RECORD_TIMES}",
            path,
            lines[int(np.argmax(np.isnan(times_s)))],
        )
    times_s, more = _continued(times_s, path, options)
    of_times += more
    return RangeLog.from_arrays(
        anchor_ids,
        ranges_m,
        timestamp_s=times_s,
        range_stddev_m=[stddev if 0 < stddev < math.inf else math.nan for stddev in stddevs],
        tag_id=tag_ids,
        los=los,
        line=lines,
        source=path,
        format=format,
        num_no_measurement=len(found) - len(ranges_m),
        notes=(*notes, *of_codes, *of_far, *of_times),
    )


def _continued(times_s: Array, path: Path, options: RangesOptions) -> tuple[Array, list[str]]:
    """Return times (n,) in seconds, continued where a counter begins again, and notes.

    Whole numbers without a unit that are too far apart for seconds are ms or us since the board was started.
    """
    if not TIME_S.hold(times_s).all():  # they are refused later, with the line
        return times_s, []
    times_s, counter = continued(times_s)
    notes = [] if counter is None else [f"the time {counter}: the times are continued"]
    distinct = np.unique(times_s)
    is_slow = len(distinct) > 1 and np.median(np.diff(distinct)) > SLOWEST_S
    if is_slow and options.timestamp_unit is None and np.all(distinct == np.round(distinct)):
        ask = partial(which_unit, path, "timestamp")
        times_s = times_s * SECONDS_PER_UNIT[time_unit("the time", times_s, notes, ask)]
    return times_s, notes


def reader_of_readings(
    name: str,
    recognizes: Callable[[str], bool],
    readings: Callable[[Path, RangesOptions], Iterable[Reading]],
    read_anchors: Callable[[Path], tuple[Anchor, ...]] = lambda path: (),
    roles: EndpointRoles = EndpointRoles.TAG_AND_ANCHOR,
) -> Reader:
    """Make the reader of a format that is not a table, from a function that yields its ranges."""

    def read(path: Path, options: RangesOptions) -> RangeLog:
        refuse_options_of_tables(options, path)
        return log_of_readings(list(readings(path, options)), path, options, name)

    return Reader(name, recognizes, read, read_anchors, roles)

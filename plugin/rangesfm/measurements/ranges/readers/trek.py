"""Lines that TREK1000 kits and the many boards with its firmware print: ranges in hexadecimal millimetres.

A line is, with blanks between, what it reports (``mc``: ranges between tag and anchors, ``mr``: the same before a
correction, ``ma``: ranges between anchors), the mask of valid ranges, four or more ranges, two counts, the radio's
milliseconds (in ``mr`` other numbers), and the ids of tag and anchor.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

from rangesfm.measurements.ranges.range_log import RangeLog
from rangesfm.measurements.ranges.readers.printed import LOST, numbered_lines
from rangesfm.measurements.ranges.readers.reader import EndpointRoles, Reader, ReadOptions
from rangesfm.measurements.ranges.readers.readings import Reading, log_of_readings, refuse_options_of_tables
from rangesfm.measurements.ranges.readers.times import HostClock

_LINE = re.compile(
    r"(?<![0-9A-Za-z])m(?P<kind>[acr]) (?P<mask>[0-9a-fA-F]{2}) (?P<ranges>(?:[0-9a-fA-F]{8} {1,2}){3,16})"
    r"[0-9a-fA-F]{4} [0-9a-fA-F]{2} (?P<clock>[0-9a-fA-F]{1,8}) [at](?P<tag>\d{1,5}):\d{1,5}",
    re.ASCII,
)
_BEGIN = re.compile(r"(?<![0-9A-Za-z])m[acr] [0-9a-fA-F]{2} [0-9a-fA-F]{8} ", re.ASCII)
_NO_RANGE = (0, 0xFFFFFFFF)
# Ends of the ranges of a line ``ma``, by their place in it.
_BETWEEN_ANCHORS = {1: ("A0", "A1"), 2: ("A0", "A2"), 3: ("A1", "A2")}


class _Report(NamedTuple):
    """One line, by the groups of _LINE; the text in front of it is "" if another report is in front, as in JSON."""

    number: int
    prefix: str
    line: re.Match[str]


def _read(path: Path, options: ReadOptions) -> RangeLog:
    refuse_options_of_tables(options, path)
    whole, num_damaged = list[_Report](), 0
    for number, text in numbered_lines(path):
        found = list(_LINE.finditer(text))
        whole += [_Report(number, "" if k else text[: one.start()], one) for k, one in enumerate(found)]
        num_damaged += max(0, len(_BEGIN.findall(text)) - len(found))
    unused = "r" if any(report.line["kind"] == "c" for report in whole) else ""  # ``mr`` repeats the ranges of ``mc``
    reports = [report for report in whole if report.line["kind"] != unused]
    seconds, notes = _times(reports, path, options)
    is_masked = any(int(report.line["mask"], 16) for report in reports)  # some firmware leaves the mask at 0
    readings = [
        (report.line["kind"], slot, _reading(report, slot, int(digits, 16), seconds(report), is_masked))
        for report in reports
        for slot, digits in enumerate(report.line["ranges"].split())
    ]
    # A place without any range belongs to no anchor.
    used = {(kind, slot) for kind, slot, reading in readings if reading.range_m > 0}
    kept = [reading for kind, slot, reading in readings if (kind, slot) in used]
    log = log_of_readings([*kept, *[LOST] * num_damaged], path, options, _NAME, notes)
    ends = {*log.tag_ids, *log.anchor_ids}
    return log.with_anchors({node for node in ends if node.startswith("A")})


def _reading(report: _Report, slot: int, range_mm: int, time_s: float, is_masked: bool) -> Reading:
    """Return the range at a place in a line; it is 0 if there is none."""
    is_valid = range_mm not in _NO_RANGE and (not is_masked or int(report.line["mask"], 16) >> slot & 1)
    tag_id, anchor_id = f"T{report.line['tag']}", f"A{slot}"
    if report.line["kind"] == "a":
        tag_id, anchor_id = _BETWEEN_ANCHORS.get(slot, ("", ""))
    return Reading(time_s, anchor_id, range_mm / 1000 * bool(is_valid and anchor_id), report.number, tag_id)


def _times(
    reports: Sequence[_Report], path: Path, options: ReadOptions
) -> tuple[Callable[[_Report], float], tuple[str, ...]]:
    """Return a function that gives the time of a line in seconds, and a note on the clock.

    The time in front of the lines is that of the host. Without one, the radio's count of milliseconds is the time.
    """
    host = HostClock(path, options)
    host_s = {host.find_seconds(report.prefix) for report in reports}
    counts = {report.line["clock"] for report in reports if report.line["kind"] != "r"}
    is_counted = len(counts) > 1 and all(report.line["kind"] != "r" for report in reports)
    if not is_counted or (len(host_s) > 1 and None not in host_s):
        clock = HostClock(path, options)
        return lambda report: clock.seconds(report.prefix, report.number), ()
    # Some firmware prints the count in decimals.
    base = 16 if any(re.search("[a-fA-F]", report.line["clock"]) for report in reports) else 10
    note = "no time of the host in front of the lines: the time is the radio's count of milliseconds"
    return lambda report: int(report.line["clock"], base) / 1000, (note,)


_NAME = "trek1000"
READER = Reader(_NAME, lambda head: _BEGIN.search(head) is not None, _read, roles=EndpointRoles.NUMBERED_APART)

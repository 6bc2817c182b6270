"""Lines that TREK1000 kits and the many boards with its firmware print: ranges in hexadecimal millimetres.

A line is, with blanks between, what it reports (``mc``: ranges between tag and anchors, ``mr``: the same before a
correction, ``ma``: ranges between anchors), the mask of valid ranges, four or more ranges, two counts, the radio's
milliseconds (in ``mr`` other numbers), and the ids of tag and anchor.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from pathlib import Path

from rangesfm.measurements.ranges.range_log import RangeLog
from rangesfm.measurements.ranges.readers.printed import LOST, numbered_lines
from rangesfm.measurements.ranges.readers.reader import EndpointRoles, Reader
from rangesfm.measurements.ranges.readers.readings import Reading, log_of_readings, refuse_options_of_tables
from rangesfm.measurements.ranges.readers.times import Clock
from rangesfm.options import RangesOptions
from rangesfm.util.files.text_tables import read_text

_LINE = re.compile(
    r"(?<![0-9A-Za-z])m(?P<kind>[acr]) (?P<mask>[0-9a-fA-F]{2}) (?P<ranges>(?:[0-9a-fA-F]{8} {1,2}){3,16})"
    r"[0-9a-fA-F]{4} [0-9a-fA-F]{2} (?P<clock>[0-9a-fA-F]{1,8}) [at](?P<tag>\d{1,5}):\d{1,5}",
    re.ASCII,
)
_BEGIN = re.compile(r"(?<![0-9A-Za-z])m[acr] [0-9a-fA-F]{2} [0-9a-fA-F]{8} ", re.ASCII)
_NO_RANGE = (0, 0xFFFFFFFF)
# Ends of the ranges of a line ``ma``, by their place in it.
_BETWEEN_ANCHORS = {1: ("A0", "A1"), 2: ("A0", "A2"), 3: ("A1", "A2")}


def _readings(path: Path, options: RangesOptions) -> Iterator[Reading]:
    """Yield the ranges with the time in front of a line, which is that of the host, and the radio's milliseconds."""
    clock, whole = Clock(options.timestamp_unit), [*_LINE.finditer(read_text(path, errors="replace"))]
    unused = "r" if any(line["kind"] == "c" for line in whole) else ""  # ``mr`` repeats the ranges of ``mc``
    used = [line for line in whole if line["kind"] != unused]
    is_masked = any(int(line["mask"], 16) for line in used)  # some firmware leaves the mask at 0
    # Some firmware prints the count in decimals.
    base = 16 if any(re.search("[a-fA-F]", line["clock"]) for line in used) else 10
    does_count = len({line["clock"] for line in used if line["kind"] != "r"}) > 1
    # A place without any range belongs to no anchor.
    places = {(line["kind"], slot) for line in used for slot, range_m in _ranges(line, is_masked) if range_m > 0}
    for number, text in numbered_lines(path):
        lines = [*_LINE.finditer(text)]
        for k, line in enumerate(lines):
            # If another report is in front, as in JSON, there is no time.
            timestamp_s = math.nan if k or line["kind"] == unused else clock.find_seconds(text[: line.start()])
            counted_s = int(line["clock"], base) / 1000 if line["kind"] != "r" and does_count else math.nan
            for slot, range_m in _ranges(line, is_masked) if line["kind"] != unused else ():
                if (line["kind"], slot) in places:
                    tag_id, anchor_id = f"T{line['tag']}", f"A{slot}"
                    if line["kind"] == "a":
                        tag_id, anchor_id = _BETWEEN_ANCHORS[slot]
                    yield Reading(timestamp_s, anchor_id, range_m, number, tag_id, counted_s=counted_s)
        yield from [LOST] * max(0, len(_BEGIN.findall(text)) - len(lines))


def _ranges(line: re.Match[str], is_masked: bool) -> Iterator[tuple[int, float]]:
    """Yield each place in a line with the range there, which is 0 if there is none."""
    for slot, digits in enumerate(line["ranges"].split()):
        range_mm, is_valid = int(digits, 16), not is_masked or int(line["mask"], 16) >> slot & 1
        is_pair = line["kind"] != "a" or slot in _BETWEEN_ANCHORS
        yield slot, range_mm / 1000 if is_valid and is_pair and range_mm not in _NO_RANGE else 0.0


def _read(path: Path, options: RangesOptions) -> RangeLog:
    refuse_options_of_tables(options, path)
    log = log_of_readings([*_readings(path, options)], path, options, _NAME)
    return log.with_anchors({node for node in (*log.tag_ids, *log.anchor_ids) if node.startswith("A")})


_NAME = "trek1000"
READER = Reader(_NAME, lambda head: _BEGIN.search(head) is not None, _read, roles=EndpointRoles.NUMBERED_APART)

"""Logs of lines printed by a radio, in which each range is a phrase of its own, and the formats of such lines.

Serial lines lose and double characters. The phrases are therefore found one by one, anywhere in a line. Complete
phrases in a damaged line are used, and incomplete ones count as no measurement.
"""

from __future__ import annotations

import math
import re
from bisect import bisect_right
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from pathlib import Path

import numpy as np

from rangesfm.errors import InputError, printable
from rangesfm.measurements.ranges.anchors.anchor import Anchor
from rangesfm.measurements.ranges.range_log import DEFAULT_TAG_ID
from rangesfm.measurements.ranges.readers.reader import EndpointRoles, Reader
from rangesfm.measurements.ranges.readers.readings import Reading, reader_of_readings
from rangesfm.measurements.ranges.readers.times import Clock
from rangesfm.options import RangesOptions
from rangesfm.util.files.text_tables import read_text

LOST = Reading(0.0, "", math.nan)


def _one_range(phrase: re.Match[str], timestamp_s: float, line: int) -> Iterator[Reading]:
    """Yield the range of a phrase, from its groups anchor_id and range (metres), and optionally tag_id and variance."""
    groups = phrase.groupdict()
    tag_id, stddev_m = groups.get("tag_id") or DEFAULT_TAG_ID, math.sqrt(max(float(groups.get("variance") or 0), 0))
    yield Reading(timestamp_s, phrase["anchor_id"], float(phrase["range"]), line, tag_id, stddev_m)


def _reader(
    name: str,
    *,
    example: str,
    begin: str,
    each: str,
    whole: str,
    ranges: Callable[[re.Match[str], float, int], Iterable[Reading]] = _one_range,
    roles: EndpointRoles = EndpointRoles.TAG_AND_ANCHOR,
) -> Reader:
    """Make the reader of lines with phrases that are given as ASCII patterns.

    Args:
        example: part of a line that is understood, for messages.
        begin: beginning of the first range in a line; the host's time is before it.
        whole: a complete phrase. Groups x, y and z, if present, are the position of the anchor in metres. A group time,
            if present, is the time of the range, and no time before the phrase is used.
        ranges: yields the ranges of a phrase, given its time in seconds and its line.
        roles: what the log says about the two ends of a range.
    """
    first, begun, phrase = (re.compile(pattern, re.ASCII | re.MULTILINE) for pattern in (begin, each, whole))
    has_time = "time" in phrase.groupindex

    def readings(path: Path, options: RangesOptions) -> Iterator[Reading]:
        clock, lost, num_found = Clock(options.timestamp_unit), (0, ""), 0
        for line, text in numbered_lines(path):
            num_begun = len(begun.findall(text))
            at = first.search(text) if num_begun else None
            if at is None:
                continue
            timestamp_s = math.nan if has_time else clock.find_seconds(text[: at.start()])
            found = list(phrase.finditer(text))
            for one in found:
                yield from ranges(one, clock.find_seconds(one["time"]) if has_time else timestamp_s, line)
            yield from [LOST] * (num_begun - len(found))
            num_found, lost = num_found + len(found), lost if lost[0] or found else (line, text)
        if lost[0] and not num_found:
            message = f"begins as a line of {name}, and is not understood: '{printable(lost[1].strip())}'"
            raise InputError(f"{message}; expected such as {example}", path, lost[0])

    def recognizes(head: str) -> bool:
        return first.search(head) is not None

    return reader_of_readings(name, recognizes, readings, partial(_anchors_said, phrase), roles)


def _anchors_said(phrase: re.Pattern[str], path: Path) -> tuple[Anchor, ...]:
    """Return the anchors in a log, each at the median of its positions; anchors with equal positions are unknown.

    Equal positions mean that nobody has set up the anchors.
    """
    positions: dict[str, list[tuple[float, float, float]]] = {}
    for _, text in numbered_lines(path) if "x" in phrase.groupindex else ():
        for one in phrase.finditer(text):
            if one["z"] is not None:  # a position in the plane has no height
                positions.setdefault(one["anchor_id"], []).append((float(one["x"]), float(one["y"]), float(one["z"])))
    medians = {anchor_id: np.median(said, axis=0) for anchor_id, said in positions.items()}
    places = [tuple(median.tolist()) for median in medians.values()]
    return tuple(
        Anchor(anchor_id, position_m=median if places.count(tuple(median.tolist())) == 1 else None)
        for anchor_id, median in medians.items()
    )


def numbered_lines(path: Path) -> Iterator[tuple[int, str]]:
    """Yield every line with its 1-based number; bytes that are not text, as in serial logs, are replaced."""
    return enumerate(read_text(path, errors="replace").split("\n"), 1)


# Output of the shell commands lec, les and similar ones of DWM1001, MDEK1001, LEAPS and PANS PRO. LEAPS and PANS PRO
# print a quality in percent after each anchor's position. Numbers always have two decimals; one with fewer is cut off.
_DECIMALS = r"-?\d{1,6}\.\d\d(?![\d.])"
_XYZ = rf"(?P<x>{_DECIMALS}),(?P<y>{_DECIMALS}),(?P<z>{_DECIMALS})"
_RANGE = rf"(?P<range>{_DECIMALS})"
_QUALITY = r"\d{1,3}"
_ANCHOR = r"(?P<anchor_id>[0-9A-F]{4})"
_ALONE = r"(?<![0-9A-Za-z])"
_DWM1001 = (
    _reader(
        "leaps_meas",
        example="POS,4.07,-2.85,0.59,74,MEAS,1,AN0,8EAA,5.14,-2.16,0.00,100,1.41",
        begin=r"(?:POS,[-\d.,]{0,60})?MEAS,\d{1,2},AN\d",
        each=r"AN\d{1,2},",
        whole=rf"AN\d{{1,2}},{_ANCHOR},{_XYZ},{_QUALITY},{_RANGE}",
    ),
    _reader(
        "leaps_lea",
        example="8EAA[5.14,-2.16,0.00,100]=1.41",
        begin=rf"(?:POS\[[-\d.,]{{0,60}}\]\s*)?{_ALONE}[0-9A-F]{{4}}\[{_XYZ},{_QUALITY}\]",
        each=rf"{_ALONE}[0-9A-F]{{4}}\[",
        whole=rf"{_ALONE}{_ANCHOR}\[{_XYZ},{_QUALITY}\]={_RANGE}",
    ),
    _reader(
        "dwm1001_lec",
        example="DIST,1,AN0,022E,7.94,8.03,0.00,3.44",
        begin=rf"(?:DIST,\d{{1,2}},)?{_ALONE}AN\d{{1,2}},[0-9A-F]{{4}},",
        each=r"AN\d{1,2},",
        whole=rf"AN\d{{1,2}},{_ANCHOR},{_XYZ},{_RANGE}",
    ),
    _reader(
        "dwm1001_les",
        example="022E[7.94,8.03,0.00]=3.38",
        begin=rf"{_ALONE}[0-9A-F]{{4}}\[-?\d{{1,6}}\.\d\d,",
        each=rf"{_ALONE}[0-9A-F]{{4}}\[",
        whole=rf"{_ALONE}{_ANCHOR}\[{_XYZ}\]={_RANGE}",
    ),
)

# Input files of factor graph solvers, in which the first word of a line is its type: libRSF and PyFactorGraph.
_NUMBER = r"-?\d{1,19}(?:\.\d{0,20})?(?:[eE][-+]?\d{1,3})?"
_TIME_AND = rf"(?P<time>{_NUMBER}) "
_RANGE_AND_VARIANCE = rf"(?P<range>{_NUMBER}) (?P<variance>{_NUMBER})"
# A12 is the twelfth pose of the robot A, which counts as the node A; L3 is a landmark, which is the node L3.
_ROBOT_OR_LANDMARK = r"L\d{1,9}|[A-KM-Za-z](?=\d{1,9} )"
_FACTOR_GRAPHS = (
    _reader(
        "librsf",
        example="range2 12.5 3.38 0.01 7.94 8.03 104 1.0",
        begin=rf"^range[23] {_NUMBER} ",
        each=r"^range[23] ",
        whole=(
            rf"^range[23] {_TIME_AND}{_RANGE_AND_VARIANCE} (?P<x>{_NUMBER}) (?P<y>{_NUMBER}) "
            rf"(?:(?P<z>{_NUMBER}) )?(?P<anchor_id>\w{{1,16}}) {_NUMBER}\s*$"
        ),
    ),
    _reader(
        "pyfg",
        example="EDGE_RANGE 12.5 A7 L1 3.38 0.01",
        begin=rf"^(?:EDGE_RANGE|VERTEX_SE2|VERTEX_SE3:QUAT) {_NUMBER} [A-Za-z]",
        each=r"^EDGE_RANGE ",
        whole=(
            rf"^EDGE_RANGE {_TIME_AND}(?P<tag_id>[A-KM-Za-z])\d{{1,9}} (?P<anchor_id>{_ROBOT_OR_LANDMARK})\d{{0,9}} "
            rf"{_RANGE_AND_VARIANCE}\s*$"
        ),
    ),
)


def _mauwb_ranges(record: re.Match[str], timestamp_s: float, line: int) -> Iterator[Reading]:
    """Yield the ranges of the slots that hold one, by the anchors' ids, or by the mask that old firmware prints."""
    ranges_cm = list(map(int, record["range"].split(",")))
    if record["rest"]:
        anchor_ids = list(map(int, record["anchor_id"].split(","))) if record["anchor_id"] else []
    else:
        anchor_ids = [slot if int(record["mask"], 16) >> slot & 1 else -1 for slot in range(len(ranges_cm))]
    if len(anchor_ids) != len(ranges_cm):  # the line is damaged, and the anchors of the ranges are not known
        yield from [LOST] * len(ranges_cm)
        return
    for range_cm, anchor_id in zip(ranges_cm, anchor_ids):
        if anchor_id >= 0:
            yield Reading(timestamp_s, str(anchor_id), range_cm / 100, line, record["tag_id"])


# Qorvo's shell of DWM3001CDK and QM33: SESSION_INFO_NTF: {..} on several lines, or older {"Block":1, "results":[..]}.
_QORVO_BEGIN = re.compile(r'SESSION_INFO_NTF:?\s{0,9}\{|\{\s{0,9}"Block"\s{0,9}:', re.ASCII)
_QORVO_END = re.compile(r"\]\s{0,9}\}")
_QORVO_COUNTERS = tuple(
    re.compile(rf"{name}\s{{0,9}}[=:]\s{{0,9}}(\d{{1,18}})(?!\d)", re.ASCII)
    for name in ("block_index", "sequence_number", '"Block"')
)
_QORVO_EACH = re.compile(r'mac_address=|"Addr"')
_QORVO_MEASUREMENT = re.compile(
    r'mac_address=(?P<id>0x[0-9A-Fa-f]{1,16}), status="SUCCESS", distance\[cm\]=(?P<cm>-?\d{1,9})(?=[],])'
    r'|"Addr"\s*:\s*"(?P<json_id>(?:0x)?[0-9A-Fa-f]{1,16})"\s*,\s*"Status"\s*:\s*"(?:Ok|SUCCESS)"\s*,'
    r'\s*"D_cm"\s*:\s*(?P<json_cm>-?\d{1,9})(?=[,}])',
    re.ASCII,
)


def _qorvo_readings(path: Path, options: RangesOptions) -> Iterator[Reading]:
    """Yield the ranges with the host's time before a record, and the time by the radio's count of intervals."""
    text, clock, counted_s = read_text(path, errors="replace"), Clock(options.timestamp_unit), -math.inf
    begins = list(_QORVO_BEGIN.finditer(text))
    line_starts = [0, *(end.end() for end in re.finditer("\n", text))]
    for begin, stop in zip(begins, [*(begin.start() for begin in begins[1:]), len(text)]):
        end = _QORVO_END.search(text, begin.end(), stop)
        body = text[begin.start() : stop if end is None else end.end()]
        line = bisect_right(line_starts, begin.start())
        timestamp_s = clock.find_seconds(text[line_starts[line - 1] : begin.start()])
        found = next(filter(None, (counter.search(body) for counter in _QORVO_COUNTERS)), None)
        before_s, counted_s = counted_s, math.nan if found is None else int(found[1]) * options.ranging_interval_s
        if math.isnan(timestamp_s) and counted_s < before_s:
            raise InputError(
                f"the radio's count goes back to {counted_s / options.ranging_interval_s:.0f}: it was restarted; split "
                "the log there, or record it with the host's time before each record",
                path,
                line,
            )
        measurements = list(_QORVO_MEASUREMENT.finditer(body))
        for one in measurements:
            anchor_id, range_cm = one["id"] or one["json_id"], one["cm"] or one["json_cm"]
            yield Reading(timestamp_s, anchor_id, int(range_cm) / 100, line, counted_s=counted_s)
        yield from [LOST] * (len(_QORVO_EACH.findall(body)) - len(measurements))


_BLANKS = r"[ \t]{0,9}"
# A blank stands for any blanks.
_MAUWB = (
    r"AT\+RANGE= tid: (?P<tag_id>\d{1,9}) , mask: (?P<mask>[0-9A-Fa-f]{1,16}) , seq: \d{1,9} , "
    r"range: \( (?P<range>-?\d{1,9} (?:, -?\d{1,9} ){0,63})\) (?:, rssi: \([^()]{0,999}\) )?"
    r"(?P<rest>, ancid: (?:\( (?P<anchor_id>-?\d{1,9} (?:, -?\d{1,9} ){0,63})\))?)?"
)

PRINTED = (
    *_FACTOR_GRAPHS,
    *_DWM1001,
    reader_of_readings("qorvo", lambda head: _QORVO_BEGIN.search(head) is not None, _qorvo_readings),
    _reader(
        "mauwb",
        example="AT+RANGE=tid:0,mask:03,seq:182,range:(232,401),ancid:(0,1)",
        begin=rf"AT\+RANGE={_BLANKS}tid:",
        each=rf"AT\+RANGE={_BLANKS}tid:",
        whole=_MAUWB.replace(" ", _BLANKS),
        ranges=_mauwb_ranges,
        roles=EndpointRoles.NUMBERED_APART,
    ),
    _reader(
        "arduino",
        example="from: D325 Range: 29.40 m",
        begin=r"from:\s{0,9}[0-9A-Fa-f]{1,16}\s{1,9}Range:",
        each=r"from:",
        whole=r"from:\s{0,9}(?P<anchor_id>[0-9A-Fa-f]{1,16})\s{1,9}Range:\s{0,9}(?P<range>-?\d{1,6}\.\d{1,4}) ?m\b",
    ),
    _reader(
        "makerfabs_json",
        example='{"links":[{"A":"1782","R":"1.2"}]}',
        begin=r'\{\s*"links"\s*:\s*\[\s*\{\s*"A"',
        each=r'"A"',
        whole=(
            r'"A"\s*:\s*"(?P<anchor_id>[0-9A-Fa-f]{1,16})"\s*,\s*"R"\s*:\s*"?(?P<range>-?\d{1,6}(?:\.\d{1,4})?)"?\s*\}'
        ),
    ),
)

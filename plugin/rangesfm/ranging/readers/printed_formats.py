"""The formats of printed lines, each a declaration: how a range begins and what is all of it."""

from __future__ import annotations

import re
from collections.abc import Iterator

from rangesfm.ranging.readers import qorvo
from rangesfm.ranging.readers.printed import LOST, printed_reader
from rangesfm.ranging.readers.reader import Reading
from rangesfm.ranging.readers.roles import Sides

# DWM1001, MDEK1001, LEAPS and PANS PRO: what the shell commands lec, les and their like print; LEAPS and PANS PRO print
# a quality in percent after each anchor's position. Always two decimals: a number with fewer was cut off.
_DECIMALS = r"-?\d{1,6}\.\d\d(?![\d.])"
_XYZ = rf"(?P<x>{_DECIMALS}),(?P<y>{_DECIMALS}),(?P<z>{_DECIMALS})"
_RANGE = rf"(?P<range>{_DECIMALS})"
_QUALITY = r"\d{1,3}"
_ANCHOR = r"(?P<anchor_id>[0-9A-F]{4})"
_ALONE = r"(?<![0-9A-Za-z])"
_DWM1001 = (
    printed_reader(  # POS,..,MEAS,4,AN0,8EAA,5.14,-2.16,0.00,100,1.41,..
        "leaps_meas",
        begin=r"(?:POS,[-\d.,]{0,60})?MEAS,\d{1,2},AN\d",
        each=r"AN\d{1,2},",
        whole=rf"AN\d{{1,2}},{_ANCHOR},{_XYZ},{_QUALITY},{_RANGE}",
    ),
    printed_reader(  # 8EAA[5.14,-2.16,0.00,100]=1.41 ..
        "leaps_lea",
        begin=rf"(?:POS\[[-\d.,]{{0,60}}\]\s*)?{_ALONE}[0-9A-F]{{4}}\[{_XYZ},{_QUALITY}\]",
        each=rf"{_ALONE}[0-9A-F]{{4}}\[",
        whole=rf"{_ALONE}{_ANCHOR}\[{_XYZ},{_QUALITY}\]={_RANGE}",
    ),
    printed_reader(  # DIST,4,AN0,022E,7.94,8.03,0.00,3.44,..
        "dwm1001_lec",
        begin=rf"(?:DIST,\d{{1,2}},)?{_ALONE}AN\d{{1,2}},[0-9A-F]{{4}},",
        each=r"AN\d{1,2},",
        whole=rf"AN\d{{1,2}},{_ANCHOR},{_XYZ},{_RANGE}",
    ),
    printed_reader(  # 022E[7.94,8.03,0.00]=3.38 ..
        "dwm1001_les",
        begin=rf"{_ALONE}[0-9A-F]{{4}}\[-?\d{{1,6}}\.\d\d,",
        each=rf"{_ALONE}[0-9A-F]{{4}}\[",
        whole=rf"{_ALONE}{_ANCHOR}\[{_XYZ}\]={_RANGE}",
    ),
)

# Inputs of solvers of factor graphs, in which a line's first word says what it holds: libRSF and PyFactorGraph.
_NUMBER = r"-?\d{1,19}(?:\.\d{0,20})?(?:[eE][-+]?\d{1,3})?"
_TIME_AND = rf"(?P<time>{_NUMBER}) "
_RANGE_AND_VARIANCE = rf"(?P<range>{_NUMBER}) (?P<variance>{_NUMBER})"
# A12 is where the robot A was at its twelfth pose; L3 is a landmark, and has no other name.
_ROBOT_OR_LANDMARK = r"L\d{1,9}|[A-KM-Za-z](?=\d{1,9} )"
_FACTOR_GRAPHS = (
    printed_reader(  # range2 TIME RANGE VARIANCE X Y ID SNR, or range3
        "librsf",
        begin=rf"^range[23] {_NUMBER} ",
        each=r"^range[23] ",
        whole=(
            rf"^range[23] {_TIME_AND}{_RANGE_AND_VARIANCE} (?P<x>{_NUMBER}) (?P<y>{_NUMBER}) "
            rf"(?:(?P<z>{_NUMBER}) )?(?P<anchor_id>\w{{1,16}}) {_NUMBER}\s*$"
        ),
    ),
    printed_reader(  # EDGE_RANGE TIME POSE LANDMARK RANGE VARIANCE
        "pyfg",
        begin=rf"^(?:EDGE_RANGE|VERTEX_SE2|VERTEX_SE3:QUAT) {_NUMBER} [A-Za-z]",
        each=r"^EDGE_RANGE ",
        whole=(
            rf"^EDGE_RANGE {_TIME_AND}(?P<tag_id>[A-KM-Za-z])\d{{1,9}} (?P<anchor_id>{_ROBOT_OR_LANDMARK})\d{{0,9}} "
            rf"{_RANGE_AND_VARIANCE}\s*$"
        ),
    ),
)


def _mauwb_ranges(record: re.Match[str], timestamp_s: float, line: int) -> Iterator[Reading]:
    """Of the slots that say that they hold one: by their anchor's id, or by the mask of old firmware."""
    ranges_cm = list(map(int, record["range"].split(",")))
    if record["rest"]:
        anchor_ids = list(map(int, (record["anchor_id"] or "").split(","))) if record["anchor_id"] else []
        if len(anchor_ids) != len(ranges_cm):  # damaged: whose ranges these are is lost
            yield from [LOST] * len(ranges_cm)
    else:
        mask = int(record["mask"], 16)
        anchor_ids = [slot if mask >> slot & 1 else -1 for slot in range(len(ranges_cm))]
    if len(anchor_ids) == len(ranges_cm):
        for range_cm, anchor_id in zip(ranges_cm, anchor_ids):
            if anchor_id >= 0:
                yield Reading(timestamp_s, str(anchor_id), range_cm / 100, line, record["tag_id"])


PRINTED = (
    *_FACTOR_GRAPHS,
    *_DWM1001,
    qorvo.READER,
    printed_reader(  # DW3000 with AT commands: AT+RANGE=tid:0,mask:03,seq:182,range:(232,401,..),ancid:(0,1,..)
        "mauwb",
        begin=r"AT\+RANGE=tid:",
        each=r"AT\+RANGE=tid:",
        whole=(
            r"AT\+RANGE=tid:(?P<tag_id>\d{1,9}),mask:(?P<mask>[0-9A-Fa-f]{1,16}),seq:\d{1,9},"
            r"range:\((?P<range>-?\d{1,9}(?:,-?\d{1,9}){0,63})\)(?:,rssi:\([^()]{0,999}\))?"
            r"(?P<rest>,ancid:(?:\((?P<anchor_id>-?\d{1,9}(?:,-?\d{1,9}){0,63})\))?)?"
        ),
        ranges=_mauwb_ranges,
        sides=Sides.APART,
    ),
    printed_reader(  # Arduino sketches for the DW1000, as Makerfabs ships them: from: D325 Range: 29.40 m ..
        "arduino",
        begin=r"from:\s{0,9}[0-9A-Fa-f]{1,16}\s{1,9}Range:",
        each=r"from:",
        whole=r"from:\s{0,9}(?P<anchor_id>[0-9A-Fa-f]{1,16})\s{1,9}Range:\s{0,9}(?P<range>-?\d{1,6}\.\d{1,4}) ?m\b",
    ),
    printed_reader(  # {"links":[{"A":"1782","R":"1.2"},..]}
        "makerfabs_json",
        begin=r'\{\s*"links"\s*:\s*\[\s*\{\s*"A"',
        each=r'"A"',
        whole=(
            r'"A"\s*:\s*"(?P<anchor_id>[0-9A-Fa-f]{1,16})"\s*,\s*"R"\s*:\s*"?(?P<range>-?\d{1,6}(?:\.\d{1,4})?)"?\s*\}'
        ),
    ),
)

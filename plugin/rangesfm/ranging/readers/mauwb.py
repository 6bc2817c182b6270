"""MaUWB (DW3000 with AT commands): ``AT+RANGE=tid:0,mask:03,seq:182,range:(232,401,..),ancid:(0,1,..)``."""

from __future__ import annotations

import re

from rangesfm.ranging.readers.printed import printed_reader
from rangesfm.ranging.readers.records import Records
from rangesfm.ranging.readers.roles import Sides

_BEGIN = r"AT\+RANGE=tid:"


def _add(records: Records, record: re.Match[str], timestamp_s: float, line: int) -> None:
    """Take the slots that say that they hold a range: by their anchor's id, or by the mask of old firmware."""
    ranges_cm = list(map(int, record["range"].split(",")))
    if record["rest"]:
        anchor_ids = list(map(int, (record["anchor_id"] or "").split(","))) if record["anchor_id"] else []
        if len(anchor_ids) != len(ranges_cm):  # damaged: whose ranges these are is lost
            records.num_no_measurement += len(ranges_cm)
            return
    else:
        mask = int(record["mask"], 16)
        anchor_ids = [slot if mask >> slot & 1 else -1 for slot in range(len(ranges_cm))]
    for range_cm, anchor_id in zip(ranges_cm, anchor_ids):
        if anchor_id >= 0:
            records.add(timestamp_s, str(anchor_id), range_cm / 100, line, tag_id=record["tag_id"])


READER = printed_reader(
    "mauwb",
    "MaUWB: AT+RANGE=tid:0,mask:03,seq:182,range:(232,401,..)..",
    begin=_BEGIN,
    each=_BEGIN,
    whole=(
        r"AT\+RANGE=tid:(?P<tag_id>\d{1,9}),mask:(?P<mask>[0-9A-Fa-f]{1,16}),seq:\d{1,9},"
        r"range:\((?P<range>-?\d{1,9}(?:,-?\d{1,9}){0,63})\)(?:,rssi:\([^()]{0,999}\))?"
        r"(?P<rest>,ancid:(?:\((?P<anchor_id>-?\d{1,9}(?:,-?\d{1,9}){0,63})\))?)?"
    ),
    add=_add,
    sides=Sides.APART,
)

"""Logs of radios that hold no ranges, and why they cannot give a scale."""

from __future__ import annotations

import re

_POSITIONS_ONLY = (
    "holds positions that the radio computed and not the ranges they came from; "
    "record the ranges themselves (DWM1001: the command lec or les instead of lep)"
)
_TDOA = (
    "holds differences of arrival times (TDoA), which are no ranges between a tag and an anchor; "
    "record two-way ranging instead"
)
_KINDS = (
    (re.compile(r'\btdoa\b|\btdoa_|"tdoa|\bidA\b.{0,99}\bidB\b', re.ASCII | re.IGNORECASE), _TDOA),
    (re.compile(r'"tagId".{0,2000}"(?:tagData|coordinates|anchorData)"', re.ASCII | re.DOTALL), _POSITIONS_ONLY),
    (re.compile(r"(?<![0-9A-Za-z])POS[,\[]-?\d", re.ASCII), _POSITIONS_ONLY),
    (re.compile(r'"(?:POS|pos|position)"\s*:\s*[{\[]|"est_pos"', re.ASCII), _POSITIONS_ONLY),
)


def reason_without_ranges(head: str) -> str | None:
    """What the beginning of a log holds instead of ranges; None if that is not known."""
    return next((reason for pattern, reason in _KINDS if pattern.search(head)), None)

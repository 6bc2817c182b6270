"""Times as logs spell them, in seconds."""

from __future__ import annotations

import re

import numpy as np

SECONDS_PER_UNIT = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
TIMESTAMP_UNITS = (*SECONDS_PER_UNIT, "iso")
ISO_TIME = re.compile(
    r"(\d{4}-\d\d-\d\d)[T ](\d\d:\d\d(?::\d\d(?:[.,]\d{1,18})?)?) ?(Z|[+-]\d\d(?::?\d\d)?(?!\d))?", re.ASCII
)


def seconds_from_iso(text: str) -> float:
    """Seconds since 1970 of an ISO 8601 time; without a zone it counts as UTC.

    Raises:
        ValueError: it is none.
    """
    match = ISO_TIME.fullmatch(text)
    if match is None:
        raise ValueError(text)
    date, time, zone = match.groups(default="Z")
    microseconds = np.datetime64(f"{date}T{time.replace(',', '.')}", "us").astype(np.int64)
    seconds = float(microseconds) * 1e-6
    if zone == "Z":
        return seconds
    hours, minutes = int(zone[1:3]), int(zone[3:].lstrip(":") or 0)
    return seconds - (-1 if zone[0] == "-" else 1) * (hours * 3600.0 + minutes * 60.0)

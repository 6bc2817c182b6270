"""Angles as people and exiftool write them: 49 deg 2' 23.58" N, 49°02'23.58"N, N 49.0398°."""

from __future__ import annotations

import re

_ANGLE = re.compile(
    r"([NSEW]?) ?(-?)(\d{1,3}(?:\.\d+)?) ?(?:°|º|deg) ?(?:(\d{1,2}(?:\.\d+)?) ?['’′])? ?"
    r"(?:(\d{1,2}(?:\.\d+)?) ?(?:\"|''|″|”))? ?([NSEW]?)",
    re.ASCII,
)


def spelt_angle(text: str) -> float | None:
    """Return the degrees of an angle in degrees, minutes and seconds, south and west negative; None for other text."""
    found = _ANGLE.fullmatch(text.replace(",", "."))
    if found is None or bool(found[1]) + bool(found[2]) + bool(found[6]) > 1:
        return None
    size = float(found[3]) + float(found[4] or 0) / 60 + float(found[5] or 0) / 3600
    return -size if found[2] or "S" in (found[1], found[6]) or "W" in (found[1], found[6]) else size

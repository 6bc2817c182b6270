"""Times as logs spell them, in seconds; also those that a logging program writes before what the radio printed."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from rangesfm.errors import InputError
from rangesfm.ranging.readers.reader import ReadOptions

SECONDS_PER_UNIT = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
ISO_TIME = re.compile(
    r"(\d{4})[-/.](\d\d?)[-/.](\d\d?)[T _](\d\d?:\d\d(?::\d\d(?:[.,]\d{1,18})?)?) ?(Z|UTC|[+-]\d\d(?::?\d\d)?(?!\d))?",
    re.ASCII,
)
TIME_OF_DAY = re.compile(r"(?<![\d:])([01]?\d|2[0-3]):([0-5]\d):([0-5]\d(?:[.,]\d{1,18})?)(?![\d:])", re.ASCII)
_NUMBER = re.compile(r"(?<![\w.+-])-?\d{1,19}(?:\.\d{1,18})?(?![\w.-]|:\d)", re.ASCII)
_DAY_S = 86400.0
# Of a time since 1970, the digits tell the unit: 1e11 s are three thousand years, 1e11 ms are three.
_UNIT_ABOVE = ((1e17, "ns"), (1e14, "us"), (1e11, "ms"))


def unit_by_digits(value: float) -> str | None:
    """The unit that a number has if it is a time since 1970; None for one too small to be in ms, us or ns."""
    return next((unit for above, unit in _UNIT_ABOVE if abs(value) > above), None)


def seconds_from_iso(text: str) -> float:
    """Seconds since 1970 of an ISO 8601 time, or of one nearly so; without a zone it counts as UTC.

    Raises:
        ValueError: it is none.
    """
    match = ISO_TIME.fullmatch(text)
    if match is None:
        raise ValueError(text)
    year, month, day, time, zone = match.groups(default="Z")
    date = f"{year}-{month:>02}-{day:>02}T{time.replace(',', '.'):0>{len(time) + (time[1] == ':')}}"
    seconds = float(np.datetime64(date, "us").astype(np.int64)) * 1e-6
    if zone in ("Z", "UTC"):
        return seconds
    hours, minutes = int(zone[1:3]), int(zone[3:].lstrip(":") or 0)
    return seconds - (-1 if zone[0] == "-" else 1) * (hours * 3600.0 + minutes * 60.0)


def is_zoned(text: str) -> bool:
    """Whether an ISO 8601 time says its zone."""
    match = ISO_TIME.fullmatch(text)
    return match is not None and match[5] is not None


class CivilClock:
    """Reads civil times one after the other; a time of day goes on counting after midnight."""

    def __init__(self) -> None:
        self._days = 0
        self._last_of_day_s = 0.0

    def seconds(self, text: str) -> float:
        """Seconds since 1970, or of a time of day since the midnight before the first; ValueError if it is neither."""
        of_day = TIME_OF_DAY.fullmatch(text)
        if of_day is None:
            return seconds_from_iso(text)
        seconds = int(of_day[1]) * 3600.0 + int(of_day[2]) * 60.0 + float(of_day[3].replace(",", "."))
        if seconds < self._last_of_day_s - _DAY_S / 2:
            self._days += 1
        self._last_of_day_s = seconds
        return self._days * _DAY_S + seconds


class HostClock:
    """Reads the times of one log, each from what stands before a range."""

    def __init__(self, path: Path, options: ReadOptions):
        self._path = path
        self._unit = options.timestamp_unit
        self._civil = CivilClock()

    def find_seconds(self, prefix: str) -> float | None:
        """The time in ``prefix``: ISO 8601, a time of day, or a number of seconds, ms, us or ns; None without any."""
        if self._unit in (None, "iso") and (civil := ISO_TIME.search(prefix) or TIME_OF_DAY.search(prefix)):
            try:
                return self._civil.seconds(civil[0])
            except ValueError:
                return None
        number = _NUMBER.search(prefix)
        if number is None or self._unit == "iso":
            return None
        value = float(number[0])
        return value * SECONDS_PER_UNIT[self._unit or unit_by_digits(value) or "s"]

    def seconds(self, prefix: str, line: int) -> float:
        """As ``find_seconds``, but InputError if there is no time."""
        seconds = self.find_seconds(prefix)
        if seconds is None:
            raise InputError(
                "no time before the range; the radio prints none, so record the log with the host's time at the "
                "beginning of each line (seconds, ms, us or ns, or 2026-01-31T12:00:00.000Z)",
                self._path,
                line,
            )
        return seconds

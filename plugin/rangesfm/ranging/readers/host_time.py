"""The time that a logging program writes before what the radio printed."""

from __future__ import annotations

import re
from pathlib import Path

from rangesfm.errors import InputError
from rangesfm.ranging.readers.reader import ReadOptions
from rangesfm.ranging.readers.time_units import ISO_TIME, SECONDS_PER_UNIT, TIMESTAMP_UNITS, seconds_from_iso

_DAY_S = 86400.0
_TIME_OF_DAY = re.compile(r"(?<![\d:])([01]?\d|2[0-3]):([0-5]\d):([0-5]\d(?:[.,]\d{1,9})?)(?![\d:])", re.ASCII)
_NUMBER = re.compile(r"(?<![\w.+-])-?\d{1,19}(?:\.\d{1,12})?(?![\w.-]|:\d)", re.ASCII)
# Of a time since 1970, the digits tell the unit: 1e11 s are three thousand years, 1e11 ms are three.
_UNIT_ABOVE = ((1e17, "ns"), (1e14, "us"), (1e11, "ms"))


class HostClock:
    """Reads the times of one log; a time of day goes on counting after midnight."""

    def __init__(self, path: Path, options: ReadOptions):
        if options.timestamp_unit not in (None, *TIMESTAMP_UNITS):
            expected = ", ".join(TIMESTAMP_UNITS)
            raise InputError(f"timestamp_unit is '{options.timestamp_unit}', expected one of {expected}", path)
        self._path = path
        self._unit = options.timestamp_unit
        self._days = 0
        self._last_of_day_s = 0.0

    def find_seconds(self, prefix: str) -> float | None:
        """The time in ``prefix``: ISO 8601, a time of day, or a number of seconds, ms, us or ns; None without any."""
        if self._unit in (None, "iso"):
            if iso := ISO_TIME.search(prefix):
                try:
                    return seconds_from_iso(iso[0])
                except ValueError:
                    return None
            if of_day := _TIME_OF_DAY.search(prefix):
                return self._unwrapped(of_day)
        number = _NUMBER.search(prefix)
        if number is None or self._unit == "iso":
            return None
        value = float(number[0])
        unit = self._unit or next((unit for above, unit in _UNIT_ABOVE if abs(value) > above), "s")
        return value * SECONDS_PER_UNIT[unit]

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

    def _unwrapped(self, of_day: re.Match[str]) -> float:
        seconds = int(of_day[1]) * 3600.0 + int(of_day[2]) * 60.0 + float(of_day[3].replace(",", "."))
        if seconds < self._last_of_day_s - _DAY_S / 2:
            self._days += 1
        self._last_of_day_s = seconds
        return self._days * _DAY_S + seconds

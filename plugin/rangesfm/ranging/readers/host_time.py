"""The time that a logging program writes before what the radio printed."""

from __future__ import annotations

import re
from pathlib import Path

from rangesfm.errors import InputError
from rangesfm.ranging.readers.reader import ReadOptions
from rangesfm.ranging.readers.time_units import (
    ISO_TIME,
    SECONDS_PER_UNIT,
    TIME_OF_DAY,
    TIMESTAMP_UNITS,
    CivilClock,
    unit_by_digits,
)

_NUMBER = re.compile(r"(?<![\w.+-])-?\d{1,19}(?:\.\d{1,18})?(?![\w.-]|:\d)", re.ASCII)


class HostClock:
    """Reads the times of one log."""

    def __init__(self, path: Path, options: ReadOptions):
        if options.timestamp_unit not in (None, *TIMESTAMP_UNITS):
            expected = ", ".join(TIMESTAMP_UNITS)
            raise InputError(f"timestamp_unit is '{options.timestamp_unit}', expected one of {expected}", path)
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

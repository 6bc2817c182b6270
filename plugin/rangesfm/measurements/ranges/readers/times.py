"""Times in logs, in seconds, including those that a logging program writes in front of the radio's output."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence

import numpy as np

from rangesfm.measurements.ranges.twr import SECONDS_PER_STAMP
from rangesfm.util.files.clock_times import are_seconds_since_1970

DAY_S = 86400.0
SECONDS_PER_UNIT = {**SECONDS_PER_STAMP, "min": 60.0, "h": 3600.0, "d": DAY_S}
DATE_ORDERS = ("dmy", "mdy")
CIVIL_UNITS = ("iso", *DATE_ORDERS)
# fmt: off
# Hours by which zones are ahead of UTC, of names that mean only one; CST is China's and Chicago's.
_ZONES = {
    "Z": 0, "UTC": 0, "GMT": 0, "WET": 0, "WEST": 1, "BST": 1, "CET": 1, "MEZ": 1, "CEST": 2, "MESZ": 2, "EET": 2,
    "EEST": 3, "JST": 9, "KST": 9, "AEST": 10, "AEDT": 11, "NZST": 12, "NZDT": 13,
    "EST": -5, "EDT": -4, "CDT": -5, "MST": -7, "MDT": -6, "PST": -8, "PDT": -7,
}
# fmt: on
CIVIL_TIME = re.compile(
    r"((?:\d{4}[-/.]\d\d?[-/.]\d\d?)|(?:\d\d?[-/.]\d\d?[-/.]\d{4}))[T _]"
    r"(\d\d?):(\d\d(?::\d\d(?:[.,]\d{1,18})?)?)(?: ?([AP])M)? ?"
    rf"((?:UTC|GMT)?[+-]\d\d?(?::?\d\d)?(?!\d)|(?:{'|'.join(_ZONES)})(?![A-Z]))?",
    re.ASCII | re.IGNORECASE,
)
TIME_OF_DAY = re.compile(
    r"(?<![\d:])([01]?\d|2[0-3]):([0-5]\d):([0-5]\d(?:[.,]\d{1,18})?)(?![\d:])(?: ?([AP])M\b)?",
    re.ASCII | re.IGNORECASE,
)
_COMPACT = re.compile(  # 20260131T120000.5Z, 20260131120000500
    r"((?:19|20)\d\d)(0[1-9]|1[0-2])([0-2]\d|3[01])[T_ -]?"
    r"([01]\d|2[0-3])([0-5]\d)([0-5]\d)(?:[.,]?(\d{1,9}))?(Z?)",
    re.ASCII,
)
_MONTHS = ("jan", "feb", "mar", "apr", "may", "jun", "jul", "aug", "sep", "oct", "nov", "dec")
_WITH_MONTH = re.compile(
    rf"(\d\d?)[- ]({'|'.join(_MONTHS)})[a-z]{{0,6}}[- ](\d{{4}})(?=$|[T _])", re.ASCII | re.IGNORECASE
)
_AS_EXIF = re.compile(r"(\d{4}):(\d\d):(\d\d)(?=[T ]\d\d?:)", re.ASCII)  # 2026:01:31 12:00:00
_SHORT_YEAR = re.compile(r"(\d\d?)\.(\d\d?)\.(\d\d)(?=$|[T _]\d\d?:)", re.ASCII)  # 31.01.26 12:00:00
_NUMBER = re.compile(r"(?<![\w.+-])-?\d{1,19}(?:\.\d{1,18})?(?![\w.-]|:\d)", re.ASCII)
# The size of a time since 1970 tells its unit: 1e11 s are three thousand years, and 1e11 ms are three years.
_UNIT_ABOVE = ((1e17, "ns"), (1e14, "us"), (1e11, "ms"))


def unit_by_digits(value: float) -> str | None:
    """Return the unit of a number if it is a time since 1970, or None if it is too small for ms, us or ns."""
    return next((unit for above, unit in _UNIT_ABOVE if abs(value) > above), None)


def spelt_date(text: str) -> str | None:
    """Convert a date of digits alone, with colons as in EXIF, or with the month in words to 2026-01-31; else None.

    So are dates with points and a year of two digits: 31.01.26.
    """
    if compact := _COMPACT.fullmatch(text):
        year, month, day, hour, minute, second, fraction, zone = compact.groups()
        return f"{year}-{month}-{day}T{hour}:{minute}:{second}.{fraction or 0}{zone}"
    if exif := _AS_EXIF.match(text):
        return f"{exif[1]}-{exif[2]}-{exif[3]}{text[exif.end() :]}"
    if short := _SHORT_YEAR.match(text):
        return f"20{short[3]}-{short[2]:>02}-{short[1]:>02}{text[short.end() :]}"
    if named := _WITH_MONTH.match(text):
        return f"{named[3]}-{_MONTHS.index(named[2].lower()) + 1:02}-{named[1]:>02}{text[named.end() :]}"
    return None


def date_order(dates: Sequence[str]) -> str | None:
    """Return the order of day, month and year in dates: "ymd", "dmy" or "mdy", or None if it is ambiguous."""
    first, second = (max(int(re.split("[-/.]", date)[k]) for date in dates) for k in (0, 1))
    if first > 31:
        return "ymd"
    return "dmy" if first > 12 or "." in dates[0] else "mdy" if second > 12 else None


def _seconds_from_civil(text: str, order: str) -> float:
    """Return the seconds since 1970 of a date and time, in UTC if it has no zone; ValueError if it is not one."""
    match = CIVIL_TIME.fullmatch(text)
    if match is None:
        raise ValueError(text)
    date, hour, rest, half, zone = match.groups()
    year, month, day = (field for _, field in sorted(zip(map("ymd".index, order), re.split("[-/.]", date))))
    seconds = float(
        np.datetime64(f"{year}-{month:>02}-{day:>02}T{_hour(hour, half):02}:{rest.replace(',', '.')}", "us").astype(int)
    )
    seconds *= 1e-6
    if zone is None or zone.upper() in _ZONES:
        return seconds - _ZONES[(zone or "Z").upper()] * 3600.0
    sign, digits = -1 if "-" in zone else 1, re.sub(r"\D", "", zone)
    hours, minutes = (digits[:-2], digits[-2:]) if len(digits) > 2 else (digits, 0)
    return seconds - sign * (int(hours) * 3600.0 + int(minutes) * 60.0)


def _hour(hour: str, half: str | None) -> int:
    """Return an hour of the day, of a half of it if that is "A" or "P"."""
    return int(hour) if half is None else int(hour) % 12 + 12 * (half in "pP")


def time_in_front(text: str) -> str | None:
    """Return the civil time in a text, or else the number if there is nothing beside it but marks such as brackets.

    A whole number counts only if it is a time since 1970; others number the lines. A time since 1970 at the beginning
    counts whatever follows it, such as the topic of a message of MQTT.
    """
    if civil := CIVIL_TIME.search(text) or TIME_OF_DAY.search(text):
        return civil[0]
    number = _NUMBER.search(text)
    if number and not text[: number.start()].strip("[( ") and _is_since_1970(number[0]):
        return number[0]
    if number is None or re.search("[A-Za-z0-9]", text.replace(number[0], "", 1)):
        return None
    return number[0] if "." in number[0] or _is_since_1970(number[0]) else None


def _is_since_1970(number: str) -> bool:
    return unit_by_digits(float(number)) is not None or are_seconds_since_1970(float(number))


class Clock:
    """Reader of the successive times of one log; times of day without a date continue after midnight."""

    def __init__(self, unit: str | None = None) -> None:
        """Make a clock; ``unit`` is that of the times or the order of dates, None: as their texts and sizes tell."""
        self._unit = unit
        self._days = 0
        self._last_of_day_s = 0.0

    def civil_seconds(self, text: str) -> float:
        """Return the seconds since 1970, or for a time of day since the midnight before the first one.

        Raises:
            ValueError: the text is neither a date and time nor a time of day.
        """
        of_day = TIME_OF_DAY.fullmatch(text)
        if of_day is None:
            return _seconds_from_civil(text, self._unit if self._unit in DATE_ORDERS else "ymd")
        seconds = _hour(of_day[1], of_day[4]) * 3600.0 + int(of_day[2]) * 60.0 + float(of_day[3].replace(",", "."))
        if seconds < self._last_of_day_s - DAY_S / 2:
            self._days += 1
        self._last_of_day_s = seconds
        return self._days * DAY_S + seconds

    def find_seconds(self, prefix: str) -> float:
        """Return the time in a text in seconds, such as the host's time before a range; NaN without one.

        It may be ISO 8601, a time of day, or a number of seconds, ms, us or ns.
        """
        is_civil = self._unit in CIVIL_UNITS
        if (is_civil or self._unit is None) and (civil := self._find_civil(prefix)):
            try:
                return self.civil_seconds(civil)
            except ValueError:
                return math.nan
        number = _NUMBER.search(prefix)
        if number is None or is_civil:
            return math.nan
        value = float(number[0])
        return value * SECONDS_PER_UNIT[self._unit or unit_by_digits(value) or "s"]

    def _find_civil(self, prefix: str) -> str | None:
        """Return the civil time in a text; of a date whose order is not known, only the time of day."""
        dated = CIVIL_TIME.search(prefix)
        if dated and (self._unit in DATE_ORDERS or date_order([dated[1]]) == "ymd"):
            return dated[0]
        of_day = TIME_OF_DAY.search(prefix)
        return of_day and of_day[0]

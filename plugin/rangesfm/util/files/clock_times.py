"""Times of clocks in seconds: which of them are since 1970, and how they are shown."""

from __future__ import annotations

from datetime import datetime, timezone

SECONDS_SINCE_1970 = (1e9, 4e9)
"""The years 2001 to 2096. With this interval a time in ms, us or ns is never taken for one in another unit, and neither
a frame number nor a date written as digits (20260131...) is taken for a time."""


def are_seconds_since_1970(value: float) -> bool:
    """Return whether a number of seconds can be a present time since 1970."""
    return SECONDS_SINCE_1970[0] <= value < SECONDS_SINCE_1970[1]


def time_text(time_s: float) -> str:
    """Return a time for the user, to the millisecond: date and time of day if it is since 1970, else seconds."""
    return f"{_date(time_s)} {_of_day(time_s)} UTC" if are_seconds_since_1970(time_s) else f"{time_s:.3f} s"


def span_text(first_s: float, last_s: float) -> str:
    """Return two times, "... to ...", as ``time_text`` does; the date only once if it is the same."""
    if not (are_seconds_since_1970(first_s) and are_seconds_since_1970(last_s)):
        return f"{first_s:.3f} to {last_s:.3f} s"
    last = _of_day(last_s) if _date(first_s) == _date(last_s) else f"{_date(last_s)} {_of_day(last_s)}"
    return f"{_date(first_s)} {_of_day(first_s)} to {last} UTC"


def _date(time_s: float) -> str:
    return f"{_moment(time_s):%Y-%m-%d}"


def _of_day(time_s: float) -> str:
    return _moment(time_s).strftime("%H:%M:%S.%f")[:-3]


def _moment(time_s: float) -> datetime:
    return datetime.fromtimestamp(round(time_s, 3), timezone.utc)

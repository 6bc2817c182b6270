"""Times since 1970 are shown as dates, others in seconds."""

from __future__ import annotations

import pytest

from rangesfm.util.files.clock_times import span_text, time_text


@pytest.mark.parametrize(
    ("time_s", "text"),
    [
        (1710252200.028, "2024-03-12 14:03:20.028 UTC"),
        (1710252200.9999, "2024-03-12 14:03:21.000 UTC"),
        (41.5, "41.500 s"),
        (-3.0, "-3.000 s"),
        (999_999_999.0, "999999999.000 s"),
    ],
)
def test_only_a_present_time_since_1970_is_a_date(time_s: float, text: str) -> None:
    assert time_text(time_s) == text


def test_two_times_of_one_day_have_one_date() -> None:
    assert span_text(1710252200.028, 1710252300.5) == "2024-03-12 14:03:20.028 to 14:05:00.500 UTC"
    assert span_text(1710252200.0, 1710352200.0) == "2024-03-12 14:03:20.000 to 2024-03-13 17:50:00.000 UTC"
    assert span_text(0.0, 41.5) == "0.000 to 41.500 s"
    assert span_text(0.5, 1710252200.028) == "0.500 to 1710252200.028 s"

"""Unwrap optional results that a test expects to be there, and compare the scale with a known one."""

from __future__ import annotations

from typing import TypeVar

import pytest

from rangesfm.result.summary import ResultSummary

_T = TypeVar("_T")


def known(value: _T | None) -> _T:
    """Return a value that may be None in general, but not in this test."""
    assert value is not None
    return value


def assert_scale(summary: ResultSummary, truth: float, within: float) -> None:
    """Assert that the true scale is in the 95 % interval, and the scale ``within`` a fraction of it."""
    low, high = known(summary.scale.interval_95)
    assert known(low) < truth < known(high)
    assert summary.scale.value == pytest.approx(truth, rel=within)

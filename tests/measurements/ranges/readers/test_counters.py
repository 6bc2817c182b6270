"""Clocks that count to a power of two and begin again at 0 are continued; a clock that was restarted is not."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rangesfm.measurements.ranges.range_log import RangeLog
from rangesfm.measurements.ranges.readers import read_ranges

DW1000_TICK_S = 1 / (499.2e6 * 128)
STEP_S = 0.07
TRUE_S = STEP_S * np.arange(900)


def log_of(path: Path, times: list[str], header: str | None, prefix: str = "") -> RangeLog:
    ranges = 6 + 2 * np.sin(TRUE_S / 4) + np.random.default_rng(1).normal(0, 0.03, len(TRUE_S))
    rows = (f"{prefix}{time},A{k % 3},{ranges[k]:.3f}" for k, time in enumerate(times))
    path.write_text("\n".join([*([header] if header else []), *rows]) + "\n")
    return read_ranges(path)


@pytest.mark.parametrize("header", ["time,anchor,range_m", None])
@pytest.mark.parametrize(
    ("bits", "tick_s", "written"),
    [(32, 1e-6, "{:.0f}"), (16, 1e-3, "{:.0f}"), (24, 1e-6, "{:.0f}"), (40, DW1000_TICK_S, "{:.0f}")],
)
def test_counter_that_begins_again_is_continued(
    tmp_path: Path, bits: int, tick_s: float, written: str, header: str | None
) -> None:
    first = 2**bits - round(20 / tick_s) % 2**bits
    counts = (first + np.floor(TRUE_S / tick_s)) % 2**bits
    log = log_of(tmp_path / "uwb.csv", [written.format(count) for count in counts], header)
    np.testing.assert_allclose(log.timestamp_s - log.timestamp_s[0], TRUE_S, atol=2e-3)
    assert sum(f"{bits} bits" in note for note in log.notes) == 1


def test_counter_is_continued_over_a_gap_and_for_late_rows_and_in_other_units(tmp_path: Path) -> None:
    wrapped = (TRUE_S + 4294.967296 - 12.0 + np.where(np.arange(900) > 160, 8.0, 0.0)) % 4294.967296
    late = np.arange(900)
    at = int(np.argmax(np.diff(wrapped) < 0))
    late[[at, at + 1]] = at + 1, at
    log = log_of(tmp_path / "uwb.csv", [f"{time:.6f}" for time in wrapped[late]], "timestamp_s,anchor_id,range_m")
    assert np.ptp(log.timestamp_s) == pytest.approx(np.ptp(TRUE_S) + 8, abs=1e-3)
    assert np.count_nonzero(np.diff(log.timestamp_s) < 0) == 1


def test_a_clock_that_was_restarted_is_not_continued_and_said_once(tmp_path: Path) -> None:
    times = np.where(TRUE_S < 40, TRUE_S + 300, TRUE_S - 40)
    log = log_of(tmp_path / "uwb.csv", [f"{time:.3f}" for time in times], "time_s,anchor,range_m")
    np.testing.assert_allclose(log.timestamp_s, times, atol=1e-3)
    assert log.num_restarts == 1  # of one clock, not one for each of three anchors


def test_one_anchor_after_the_other_is_no_counter(tmp_path: Path) -> None:
    times = 0.01 + np.arange(0, 65.4, 0.3)
    rows = [f"{1000 * time:.0f},A{k},{5 + k + time / 50:.3f}" for k in range(3) for time in times]
    (tmp_path / "uwb.csv").write_text("\n".join(["time_ms,anchor_id,range_m", *rows]) + "\n")
    log = read_ranges(tmp_path / "uwb.csv")
    np.testing.assert_allclose(log.timestamp_s, np.tile(times, 3), atol=1e-3)

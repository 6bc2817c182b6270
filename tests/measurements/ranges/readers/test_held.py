"""Values that a logger holds until the next one count once; values that a rounding radio measures again all count."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from rangesfm.measurements.ranges.range_log import RangeLog
from rangesfm.measurements.ranges.range_summary import summarize_ranges
from rangesfm.measurements.ranges.readers import read_ranges

ANCHORS_M = np.array([[5.0, 4.0], [-5.0, 4.0], [-5.0, -4.0], [5.0, -4.0]])
NOISE_M = 0.05
Values = npt.NDArray[np.float64]


def ranges_at(times_s: Values, anchor: int, *, speed: float = 0.6, noise_m: float = NOISE_M) -> Values:
    """Ranges to one anchor on a circle of 2 m."""
    turns = speed * times_s / 2
    tag_m = 2 * np.column_stack([np.cos(turns), np.sin(turns)])
    noise = np.random.default_rng([1, anchor]).normal(0, noise_m, len(times_s))
    return np.asarray(np.linalg.norm(tag_m - ANCHORS_M[anchor], axis=1) + noise)


def measured(step_m: float = 0.001) -> list[tuple[Values, Values]]:
    """Times and ranges to each anchor, five a second, in turn."""
    times = [np.arange(0.05 * anchor, 50, 0.2) for anchor in range(4)]
    return [(each, np.round(ranges_at(each, k) / step_m) * step_m) for k, each in enumerate(times)]


def held(rows_s: Values, step_m: float = 0.001) -> Values:
    """Table (n, 5) of rows at these times with the last range to each anchor."""
    last = [ranges[np.searchsorted(times, rows_s, side="right") - 1] for times, ranges in measured(step_m)]
    return np.column_stack([rows_s, *last])


def read_table(path: Path, table: Values) -> RangeLog:
    rows = [f"{row[0]:.4f}," + ",".join(f"{value:.4f}" for value in row[1:]) for row in table]
    path.write_text("\n".join(["time_s,A1_range_m,A2_range_m,A3_range_m,A4_range_m", *rows]) + "\n")
    return read_ranges(path)


@pytest.mark.parametrize(
    ("rows_s", "times"),
    [
        (np.arange(0.2, 49, 1 / 60), 12.0),  # faster than the radio
        (np.arange(0.2, 49, 1 / 7), 1.4),  # a little faster, so that not every value is repeated
        (np.sort(np.concatenate([times for times, _ in measured()]))[4:-4], 4.0),  # all anchors where one is new
    ],
)
@pytest.mark.parametrize("step_m", [0.001, 0.01])
def test_held_values_count_once_at_the_time_at_which_they_came(
    tmp_path: Path, rows_s: Values, times: float, step_m: float
) -> None:
    log = read_table(tmp_path / "uwb.csv", held(rows_s, step_m))
    (note,) = [note for note in log.notes if "the log holds the last range until the next" in note]
    assert float(note.split("about ")[1].split(" times")[0]) == pytest.approx(times, rel=0.1)
    for link in summarize_ranges(log).anchors:
        assert link.num == pytest.approx(245, abs=25)
        assert link.noise_stddev_m == pytest.approx(NOISE_M, rel=0.3)
    mine = log.anchor_index == 2
    true_s, true_m = measured(step_m)[2]
    came = np.searchsorted(true_s, log.timestamp_s[mine] + 1e-4, side="right") - 1
    np.testing.assert_allclose(log.range_m[mine], true_m[came], atol=1e-4)
    age_s = log.timestamp_s[mine] - true_s[came]
    assert np.all(age_s[1:] <= np.diff(rows_s).max() + 1e-4)  # of the first, nobody sees when it came


def test_rows_of_one_range_that_are_written_again_and_again_count_once(tmp_path: Path) -> None:
    table = held(np.arange(0.2, 49, 0.02))
    rows = [f"{row[0]:.3f},A{k},{row[1 + k]:.3f}" for row in table for k in range(4)]
    (tmp_path / "uwb.csv").write_text("\n".join(["time,anchor,range_m", *rows]) + "\n")
    log = read_ranges(tmp_path / "uwb.csv")
    assert len(log) == pytest.approx(980, abs=40)


@pytest.mark.parametrize("noise_m", [0.002, 0.03])
@pytest.mark.parametrize("speed", [0.0, 1.0])
@pytest.mark.parametrize(("step_m", "rate_hz"), [(0.01, 10), (0.01, 100), (0.1, 10), (0.1, 100)])
def test_values_that_a_rounding_radio_measures_again_all_count(
    tmp_path: Path, step_m: float, rate_hz: float, speed: float, noise_m: float
) -> None:
    times = np.arange(0, 1500 / rate_hz, 1 / rate_hz)
    ranges = np.column_stack([ranges_at(times, k, speed=speed, noise_m=noise_m) for k in range(4)])
    spikes = np.random.default_rng(5)
    ranges += np.where(spikes.random(ranges.shape) < 0.1, spikes.uniform(0.5, 3, ranges.shape), 0)
    log = read_table(tmp_path / "uwb.csv", np.column_stack([times, np.round(ranges / step_m) * step_m]))
    assert len(log) == ranges.size

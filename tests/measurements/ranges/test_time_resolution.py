"""The rounding of a log's times is seen from ranges that cannot be simultaneous but have the same time."""

from __future__ import annotations

import numpy as np
import pytest

from rangesfm.measurements.ranges.range_log import RangeLog

TIMES = np.sort(np.random.default_rng(0).uniform(0.0, 60.0, 1200))


def log_at(times: np.typing.NDArray[np.float64], num_anchors: int = 2) -> RangeLog:
    ids = [f"A{number % num_anchors}" for number in range(len(times))]
    return RangeLog.from_arrays(ids, np.full(len(times), 5.0), timestamp_s=times)


@pytest.mark.parametrize("step_s", [1.0, 0.5])
def test_step_of_rounded_times_is_found(step_s: float) -> None:
    assert log_at(np.floor(TIMES / step_s) * step_s).time_resolution_s == pytest.approx(step_s)
    assert log_at(1.7e9 + np.floor(TIMES / step_s) * step_s).time_resolution_s == pytest.approx(step_s)


def test_batches_of_lines_that_share_the_host_time_are_as_coarse_as_their_distance() -> None:
    assert log_at(np.repeat(np.arange(0.0, 60.0, 0.4), 8)).time_resolution_s == pytest.approx(0.4)


def test_times_of_their_own_have_no_step() -> None:
    assert log_at(TIMES).time_resolution_s == 0.0
    assert log_at(np.round(TIMES, 2)).time_resolution_s == 0.0
    assert log_at(np.arange(60.0), num_anchors=1).time_resolution_s == 0.0


def test_all_anchors_of_one_round_may_share_its_time() -> None:
    assert log_at(np.repeat(np.arange(0.0, 60.0, 0.1), 4), num_anchors=4).time_resolution_s == 0.0


def test_logs_that_name_photos_and_empty_ones_have_none() -> None:
    assert RangeLog.from_arrays(["A"] * 4, np.full(4, 5.0), image_name=["a.jpg"] * 4).time_resolution_s == 0.0
    assert log_at(np.empty(0)).time_resolution_s == 0.0

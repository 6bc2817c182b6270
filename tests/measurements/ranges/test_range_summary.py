"""The summary of a log in a few numbers."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rangesfm.measurements.ranges.errors.noise import estimate_noise_m, find_quantization_m
from rangesfm.measurements.ranges.range_log import RangeLog
from rangesfm.measurements.ranges.range_summary import summarize_ranges

Array = npt.NDArray[np.float64]


def test_summary_counts_ranges_time_and_gaps() -> None:
    log = RangeLog.from_arrays(
        ["a", "b", "a", "a", "b"], [1, 5, 2, 6, 7], timestamp_s=[10, 13, 11, 14, 10.5], num_no_measurement=4
    )
    summary = summarize_ranges(log)
    assert (summary.num, summary.num_no_measurement, summary.format) == (5, 4, "memory")
    assert (summary.start_s, summary.end_s, summary.rate_hz) == (10, 14, 1.0)
    assert summary.largest_gap_s == pytest.approx(2.0)
    first, second = summary.anchors
    assert (first.ids, first.num, first.min_m, first.median_m, first.max_m) == (("a",), 3, 1, 2, 6)
    assert (first.largest_gap_s, second.largest_gap_s) == (3.0, 2.5)


def test_summary_of_a_log_by_photos_has_no_times() -> None:
    summary = summarize_ranges(RangeLog.from_arrays(["a", "a"], [1, 2], image_name=["1.jpg", "2.jpg"]))
    assert np.isnan([summary.start_s, summary.end_s, summary.rate_hz, summary.largest_gap_s]).all()
    assert np.isnan(summary.anchors[0].noise_stddev_m)


def test_single_range_has_neither_rate_nor_gap_nor_noise() -> None:
    summary = summarize_ranges(RangeLog.from_arrays(["a"], [1], timestamp_s=[3]))
    assert summary.start_s == 3.0
    assert np.isnan([summary.rate_hz, summary.anchors[0].largest_gap_s, summary.anchors[0].noise_stddev_m]).all()


def test_duplicates_and_times_out_of_order_are_counted() -> None:
    log = RangeLog.from_arrays(
        ["a", "a", "b", "a", "a", "a"], [1, 1, 1, 1, 1, 2], timestamp_s=[0, 0, 0, 5, 4, 0], tag_id=[*"xxxxxx"]
    )
    summary = summarize_ranges(log)
    assert summary.num_duplicates == 1
    assert summary.num_out_of_order == 2


def test_ranges_between_two_of_a_kind_are_told_apart_from_those_of_the_camera() -> None:
    log = RangeLog.from_arrays(
        ["a", "b", "b", "a", "u"], [1, 2, 3, 5, 9], timestamp_s=range(5), tag_id=["t", "t", "a", "b", "t"]
    ).with_anchors({"a", "b"})
    summary = summarize_ranges(log)
    assert [(anchor.ids, anchor.num) for anchor in summary.anchors] == [(("a",), 1), (("b",), 1)]
    between, tags = summary.pairs
    assert (between.kind, set(between.ids), between.num) == ("anchor-anchor", {"a", "b"}, 2)
    assert (between.min_m, between.median_m, between.max_m) == (3, 4, 5)
    assert (tags.kind, tags.ids, tags.num, tags.median_m) == ("tag-tag", ("t", "u"), 1, 9)


# Rounded ranges


@pytest.mark.parametrize("step_m", [0.01, 0.1])
def test_step_of_rounded_ranges_is_found(step_m: float) -> None:
    ranges = np.random.default_rng(1).uniform(1, 90, 500)
    rounded = np.maximum(np.round(ranges / step_m), 1) * step_m
    assert find_quantization_m(rounded) == step_m
    assert find_quantization_m(rounded.astype(np.float32).astype(np.float64)) == step_m
    rounded[17] += step_m / 3
    assert find_quantization_m(rounded) != step_m


# Noise, estimated from the log alone


def walk(rate_hz: float, num: int) -> tuple[Array, Array]:
    """Times and true ranges of somebody who walks around an anchor."""
    time = np.arange(num) / rate_hz
    return time, 5 + 2 * np.sin(0.7 * time) + np.cos(0.31 * time)


@pytest.mark.parametrize("rate_hz", [10.0, 20.0, 100.0])
@pytest.mark.parametrize("stddev_m", [0.02, 0.1])
def test_noise_is_found_whatever_the_rate(rate_hz: float, stddev_m: float) -> None:
    time, range_m = walk(rate_hz, 3000)
    noisy = range_m + np.random.default_rng(2).normal(0, stddev_m, len(time))
    assert estimate_noise_m(time, noisy) == pytest.approx(stddev_m, rel=0.1)


def test_the_curve_of_a_walk_is_no_noise() -> None:
    noise_m = estimate_noise_m(*walk(5.0, 500))
    assert noise_m is not None
    assert noise_m < 0.003  # a tenth of a good radio's


def test_noise_is_that_of_most_ranges_in_spite_of_outliers_gaps_and_order() -> None:
    time, range_m = walk(10.0, 3000)
    random = np.random.default_rng(2)
    noisy = range_m + random.normal(0, 0.05, len(time))
    late = random.random(len(time)) < 0.1
    noisy[late] += random.uniform(0.5, 3, late.sum())
    time = time + 100 * (np.arange(len(time)) // 500)
    order = random.permutation(len(time))
    assert estimate_noise_m(time[order], noisy[order]) == pytest.approx(0.05, rel=0.25)


def test_noise_is_not_less_than_that_of_rounding() -> None:
    log = RangeLog.from_arrays(["a"] * 100, [1.5] * 100, timestamp_s=np.arange(100))
    (anchor,) = summarize_ranges(log).anchors
    assert anchor.noise_stddev_m == pytest.approx(0.1 / np.sqrt(12))


@given(
    st.lists(
        st.tuples(st.floats(-1e300, 1e300), st.floats(1e-300, 1e300)) | st.just((0.0, 1.0)), min_size=22, max_size=40
    )
)
def test_any_log_has_a_summary(rows: list[tuple[float, float]]) -> None:
    times, ranges = zip(*rows)
    (anchor,) = summarize_ranges(RangeLog.from_arrays(["a"] * len(rows), list(ranges), timestamp_s=times)).anchors
    assert np.isnan(anchor.noise_stddev_m) or anchor.noise_stddev_m >= 0

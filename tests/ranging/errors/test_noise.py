"""The noise of ranges, from residuals or from a log alone, and stretches of time in which errors are correlated."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from scipy.stats import expon, norm
from tests.known import known

from rangesfm.ranging.errors import noise
from rangesfm.ranging.errors.noise import (
    _densities,
    _misses_of_parabola,
    bias_whitening,
    correlation_inflation,
    estimate_noise_m,
    find_quantization_m,
    inlier_noise,
    quantization_stddev_m,
    robust_stddev,
    robust_stddevs,
    shared_stddev,
    short_range_stddev,
    stretch_labels,
)
from rangesfm.ranging.range_log import RangeLog

Array = npt.NDArray[np.float64]


def test_a_stretch_is_as_long_as_asked() -> None:
    labels = stretch_labels(100.0 + np.arange(0.0, 200.0, 0.5), 10.0)
    np.testing.assert_array_equal(np.bincount(labels), np.full(20, 20))


def test_a_short_log_has_eight_all_the_same() -> None:
    labels = stretch_labels(np.linspace(0.0, 16.0, 161), 10.0)
    np.testing.assert_array_equal(np.unique(labels), np.arange(9))
    np.testing.assert_array_equal(np.bincount(labels)[:8], np.full(8, 20))


def test_a_log_of_less_than_a_second_has_eight_too() -> None:
    np.testing.assert_array_equal(stretch_labels(np.array([0.0, 0.1, 0.31, 0.79]), 10.0), [0, 1, 3, 8])


def test_ranges_of_one_moment_are_one_stretch() -> None:
    np.testing.assert_array_equal(stretch_labels(np.full(5, 3.0), 10.0), 0)


def test_errors_of_a_stretch_that_are_alike_widen_and_rounding_does_not() -> None:
    groups = np.repeat(np.arange(20), 25)
    alike = np.repeat(np.random.default_rng(0).normal(size=20), 25)
    assert correlation_inflation(alike, np.ones(500), groups) == pytest.approx(5.0)
    assert correlation_inflation(1e-12 * alike, np.ones(500), groups) == 1.0
    assert correlation_inflation(0 * alike, np.ones(500), groups) == 1.0


def test_one_stretch_says_nothing_of_what_the_errors_of_one_have_in_common() -> None:
    assert correlation_inflation(np.ones(500), np.ones(500), np.zeros(500, dtype=np.int64)) == 1.0


def test_the_robust_stddev_is_that_of_a_normal_distribution_with_the_same_median_size() -> None:
    assert robust_stddev([-1.0, 2.0, 30.0]) == pytest.approx(2.0 * 1.4826022)
    np.testing.assert_allclose(robust_stddevs(np.array([[1.0, -3.0], [0.0, 0.0]])), [[2 * 1.4826022], [1e-9]])
    assert robust_stddev([]) == robust_stddev([0.0]) == 1e-9


def test_short_ranges_share_an_error_that_fades_within_metres() -> None:
    expected = [2.0, 2.0 * np.exp(-1.0), 2.0 * np.exp(-4.0)]
    np.testing.assert_allclose(short_range_stddev(np.array([0.0, 1.0, 4.0])), expected)
    log = RangeLog.from_arrays(["a", "a"], [1.0, 4.0], timestamp_s=[0.0, 1.0])
    np.testing.assert_allclose(shared_stddev(log), expected[1:])
    np.testing.assert_array_equal(shared_stddev(replace(log, shared_stddev_m=np.array([0.3, 0.4]))), [0.3, 0.4])


def test_whitened_biases_are_independent_with_variance_one() -> None:
    own = np.array([0.1, 0.2, 0.4])
    whitening = bias_whitening(own, 0.3)
    covariance = np.full((3, 3), 0.09) + np.diag([0.01, 0.04, 0.16])
    np.testing.assert_allclose(whitening @ covariance @ whitening.T, np.eye(3), atol=1e-12)
    assert bias_whitening(np.zeros(0), 0.3).shape == (0, 0)


def test_what_a_stretch_has_in_common_counts_with_the_weights_and_the_shares() -> None:
    groups = np.repeat([4, 7], 8)
    half = np.tile([1.0, 0.0], 8)
    assert correlation_inflation(np.full(16, 0.1), np.ones(16), groups) == pytest.approx(np.sqrt(8))
    assert correlation_inflation(np.ones(16), half, groups) == pytest.approx(np.sqrt(4))
    assert correlation_inflation(np.ones(16), np.ones(16), groups, np.full(16, 0.5)) == pytest.approx(np.sqrt(4))
    # 2 of 8 in each stretch have four times the share: sums of 8 + 6, and 8 + 6 of squares.
    shares = np.tile([4.0, 4.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0], 2)
    assert correlation_inflation(np.ones(16), np.ones(16), groups, shares) == pytest.approx(np.sqrt(14.0))


def test_errors_that_cancel_within_a_stretch_do_not_narrow_and_those_alike_count_as_one() -> None:
    alternating = np.tile([1.0, -1.0], 20)
    assert correlation_inflation(alternating, np.ones(40), np.repeat([0, 1], 20)) == 1.0
    found = correlation_inflation(np.ones(2000), np.ones(2000), np.repeat([0, 1], 1000))
    assert found == pytest.approx(np.sqrt(1000))


@pytest.mark.parametrize("share", [1.0, 0.25])
def test_residuals_of_a_thousandth_of_their_stddev_are_rounding(share: float) -> None:
    groups, shares = np.repeat([0, 1], 32), np.full(64, share)
    assert correlation_inflation(np.full(64, 0.9e-3), np.ones(64), groups, shares) == 1.0
    assert correlation_inflation(np.full(64, 1.1e-3), np.ones(64), groups, shares) == pytest.approx(np.sqrt(32 * share))


def test_the_densities_of_noise_and_outliers_are_those_of_their_distributions() -> None:
    found = _densities(np.array([0.2, -0.6, 0.0]), 0.2, np.array([3.0, 2.0]), np.array([0.5, 0.3, 0.1]))
    np.testing.assert_allclose(found[0], 0.5 * norm.pdf([0.2, -0.6, 0.0], scale=0.2))
    np.testing.assert_allclose(found[1], [0.3 * expon.pdf(0.2, scale=3.0), 0.0, 0.0])
    np.testing.assert_allclose(found[2], [0.0, 0.1 * expon.pdf(0.6, scale=2.0), 0.0])


def test_a_mixture_is_found_again_from_its_quantiles() -> None:
    """600 residuals are noise of 0.1 m, 300 too long by 2 m on average, and 100 too short by 1 m."""
    parts = (norm(scale=0.1), 600, 1.0), (expon(scale=2.0), 300, 1.0), (expon(scale=1.0), 100, -1.0)
    residuals = np.concatenate([sign * part.ppf((np.arange(num) + 0.5) / num) for part, num, sign in parts])
    found = inlier_noise(residuals)
    assert found.stddev == pytest.approx(0.1, rel=0.01)
    assert found.num == pytest.approx(600, rel=0.01)
    density = sum(num / 1000 * part.pdf(sign * residuals) for part, num, sign in parts)
    assert found.log_likelihood == pytest.approx(np.sum(np.log(density)), abs=1.0)


def test_outliers_are_told_from_noise_where_there_are_twenty_residuals() -> None:
    residuals = np.append(0.1 * norm.ppf((np.arange(13) + 0.5) / 13), np.linspace(3.0, 9.0, 6))
    assert inlier_noise(residuals).num == 19
    assert inlier_noise(np.append(residuals, 4.0)).num == pytest.approx(13, abs=0.5)


def test_the_middle_of_a_window_misses_the_parabola_through_the_others() -> None:
    """A parabola through 11 even points follows its middle one by 89 / 429 (Savitzky and Golay, 1964)."""
    times = np.arange(11.0)[None] + [[5.0], [-300.0], [0.0]]
    ranges = 3.0 + 0.2 * times - 0.01 * times**2
    ranges[:2, 5] += [0.5, -2.0]
    misses = _misses_of_parabola(times, ranges)
    np.testing.assert_allclose(misses, np.array([0.5, -2.0, 0.0]) * np.sqrt(429 / 340), atol=1e-6)


def test_ranges_with_wrong_ones_among_them_keep_their_parabola() -> None:
    times = np.cumsum([[0.0, 1.0, 2.0, 1.0, 1.0, 3.0, 1.0, 1.0, 1.0, 2.0, 1.0]], axis=1)
    ranges = 50.0 - times + 0.05 * times**2
    ranges[0, [1, 9]] += [4.0, 7.0]
    np.testing.assert_allclose(_misses_of_parabola(times, ranges), 0.0, atol=1e-4)


def test_noise_is_the_scatter_about_a_smooth_motion() -> None:
    rng = np.random.default_rng(0)
    time_s = np.arange(1000) / 10
    range_m = 8.0 + 3.0 * np.sin(time_s / 5) + 0.1 * rng.standard_normal(1000)
    noise_m = known(estimate_noise_m(time_s, range_m))
    assert noise_m == pytest.approx(0.1, rel=0.15)
    order = rng.permutation(1000)
    assert estimate_noise_m(time_s[order], range_m[order]) == noise_m


def test_noise_is_told_from_two_windows_of_ranges() -> None:
    range_m = 5.0 + 0.1 * np.random.default_rng(0).standard_normal(22)
    assert estimate_noise_m(np.arange(21.0), range_m[:21]) is None
    assert 0.02 < known(estimate_noise_m(np.arange(22.0), range_m)) < 0.3


def test_what_all_windows_miss_alike_is_no_noise() -> None:
    """All windows miss a curve of the fourth degree by nearly the same amount, here 0.7 m."""
    time_s = np.arange(-20.0, 21.0)
    assert known(estimate_noise_m(time_s, 10.0 + 0.01 * time_s**4)) < 0.02


@pytest.mark.parametrize(("gap_s", "is_too_long"), [(20.9, False), (21.1, True)])
def test_windows_three_times_as_long_as_typical_ones_have_a_gap(gap_s: float, is_too_long: bool) -> None:
    """Bursts of 24 ranges a second apart: a window across the gap between two has nine seconds and the gap."""
    number = np.arange(40 * 24)
    time_s = number % 24 + (23 + gap_s) * (number // 24)
    range_m = 5.0 + 0.4 * (number % 24) + 0.02 * np.random.default_rng(0).standard_normal(len(number))
    noise_m = known(estimate_noise_m(time_s, range_m))
    assert (noise_m == pytest.approx(0.02, rel=0.3)) == is_too_long


def test_of_many_windows_some_are_enough(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[int] = []

    def count(times: Array, ranges: Array) -> Array:
        seen.append(len(times))
        return _misses_of_parabola(times, ranges)

    monkeypatch.setattr(noise, "_MAX_NUM_SAMPLES", 10)
    monkeypatch.setattr(noise, "_misses_of_parabola", count)
    for num_windows in (20, 21, 30):
        estimate_noise_m(np.arange(num_windows + 10.0), np.ones(num_windows + 10))
    assert seen == [10, 7, 10]


def test_absurd_ranges_have_no_noise() -> None:
    assert estimate_noise_m(np.arange(30.0), np.resize([1.0, 1.7e308], 30)) is None


def test_ranges_in_whole_decimetres_or_centimetres_are_known_by_twenty() -> None:
    decimetres = (0.1 * np.arange(2400, 2420)).astype(np.float32).astype(np.float64)
    assert find_quantization_m(decimetres) == 0.1
    assert find_quantization_m(decimetres[:19]) is None
    centimetres = np.linspace(1.0, 1.19, 20)
    assert find_quantization_m(centimetres) == 0.01
    # Numbers of 32 bits are off by up to 6e-8 of their value, those of a longer range by more.
    assert find_quantization_m((400 + 0.1 * np.arange(20)).astype(np.float32).astype(np.float64)) == 0.1
    assert find_quantization_m(centimetres + 1.1e-7) == 0.01
    assert find_quantization_m(centimetres + 1.5e-7) is None
    assert find_quantization_m(np.linspace(1.0, 1.095, 20)) is None


def test_the_rounding_error_is_uniform_over_a_step() -> None:
    even = (np.arange(10_000) + 0.5) / 10_000 - 0.5
    assert quantization_stddev_m(0.1) == pytest.approx(0.1 * even.std(), rel=1e-6)

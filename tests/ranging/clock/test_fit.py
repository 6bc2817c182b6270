"""The descent to a time offset of the clocks."""

from __future__ import annotations

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy import stats

from rangesfm.arrays import Array, Indices
from rangesfm.ranging.clock import fit, time_offset
from rangesfm.ranging.clock.fit import OffsetFit, Timing, drift_note, fit_at_offset, fit_clocks, refine_offset
from rangesfm.ranging.clock.search import PathSamples, TimedRanges

STEP_S = 0.025
NUM_SAMPLES = 8000


@pytest.fixture
def path() -> PathSamples:
    """A walk of 200 s that never repeats itself."""
    rng = np.random.default_rng(0)
    speed = np.apply_along_axis(np.convolve, 0, rng.normal(size=(NUM_SAMPLES, 3)), np.hanning(80), "same")
    centers = STEP_S * speed.cumsum(axis=0)
    return PathSamples(0.0, STEP_S, centers, np.zeros((1, NUM_SAMPLES, 3)), np.ones(NUM_SAMPLES, dtype=bool))


def ranges_at(path: PathSamples, offset_s: float, noise_m: float) -> TimedRanges:
    """Simulate ranges in the middle of the walk, for clocks with this offset."""
    rng = np.random.default_rng(1)
    times_s = np.sort(rng.uniform(40.0, 160.0, 1500))
    zero = np.zeros(len(times_s), dtype=np.int64)
    points, _ = path.tag(times_s + offset_s, zero, np.inf)
    distances_m = np.linalg.norm(points - np.array([4.0, -6.0, 2.0]), axis=1)
    return TimedRanges(times_s, distances_m + noise_m * rng.standard_normal(len(times_s)), zero, zero)


def test_a_descent_finds_the_offset_to_a_twentieth_of_its_stddev_from_wherever_it_starts_nearby(
    path: PathSamples,
) -> None:
    ranges = ranges_at(path, 0.0, 0.02)
    found = [refine_offset(ranges, path, offset_s) for offset_s in (-0.2, 0.0, 0.3)]
    stddev_s = found[0].timing().stddev_s
    assert found[0].offset_s == pytest.approx(0.0, abs=3 * stddev_s)
    np.testing.assert_allclose([fit.offset_s for fit in found], found[0].offset_s, rtol=0, atol=0.1 * stddev_s)


def test_descents_end_soon_where_they_are_far_behind_and_go_on_where_they_are_not(path: PathSamples) -> None:
    ranges = ranges_at(path, 0.0, 0.02)
    best = refine_offset(ranges, path, 0.3)
    alone, behind = refine_offset(ranges, path, -20.0), refine_offset(ranges, path, -20.0, best)
    assert behind.is_hopeless_beside(best)
    assert not best.is_hopeless_beside(behind)
    assert behind.offset_s == -20.0 != alone.offset_s  # it stopped at once
    again = refine_offset(ranges, path, 0.3, behind)
    assert again.offset_s == best.offset_s


def test_even_motion_on_a_line_tells_nothing_of_the_clocks() -> None:
    """Another offset fits equally well with another place of the anchor."""
    times_s = STEP_S * np.arange(NUM_SAMPLES)
    way = times_s[:, None] * np.array([0.5, 0.2, 0.0])
    even = PathSamples(0.0, STEP_S, way, np.zeros((1, NUM_SAMPLES, 3)), np.ones(NUM_SAMPLES, dtype=bool))
    assert fit_at_offset(ranges_at(even, 0.0, 0.02), even, 0.0).timing() == Timing(np.inf, 0.0, np.inf)


def test_of_two_offsets_one_is_as_much_likelier_as_the_other_is_less_likely(path: PathSamples) -> None:
    """Each offset puts other ranges on the path; only the ranges that both put there are compared."""
    ranges = ranges_at(path, 0.0, 0.02)
    best, rival = (fit_at_offset(ranges, path, offset_s) for offset_s in (0.0, -60.0))
    assert len(rival.losses()) < len(best.losses())
    odds = time_offset._log_odds(best, rival, path)
    assert odds > 0
    assert odds == pytest.approx(-time_offset._log_odds(rival, best, path), rel=1e-9)


def student_factor(num_blocks: int) -> float:
    """Return the square of the ratio of Student's quantile to that of a normal distribution."""
    return float((stats.t.ppf(0.975, num_blocks - 1) / stats.norm.ppf(0.975)) ** 2)


def linear_fit(num: int = 60, num_own: int = 2) -> tuple[Array, Array, Array]:
    """Return columns of other unknowns, columns without what these explain, and values with noise."""
    rng = np.random.default_rng(7)
    others, _ = np.linalg.qr(rng.normal(size=(num, 3)))
    own = rng.normal(size=(num, num_own)) * [2.0, 0.3][:num_own]
    own -= others @ (others.T @ own)
    return others, own, rng.normal(size=num)


def jackknife(others: Array, own: Array, residuals: Array, weights: Array, blocks: Sequence[Indices]) -> list[Array]:
    squares: Any = SimpleNamespace(basis=others, weights=weights)
    return fit._jackknife_variances(own, residuals, squares, blocks)


def test_the_variance_is_that_of_fits_without_one_block_each_enlarged_for_few_blocks() -> None:
    others, own, values = linear_fit()
    columns = np.column_stack([others, own])
    all_unknowns = np.linalg.lstsq(columns, values, rcond=None)[0]
    mixed = np.random.default_rng(8).permutation(60) % 4
    divisions = [np.repeat(np.arange(6), 10), mixed, np.arange(60) // 30]
    found = jackknife(others, own, values - columns @ all_unknowns, np.ones(60), divisions)
    assert len(found) == 3
    for variances, block in zip(found, divisions):
        num = int(block.max()) + 1
        refits = [np.linalg.lstsq(columns[block != k], values[block != k], rcond=None)[0] for k in range(num)]
        changes = (np.array(refits) - all_unknowns)[:, 3:]
        wanted = student_factor(num) * (num - 1) / num * np.sum(changes**2, axis=0)
        np.testing.assert_allclose(variances, wanted, rtol=1e-9)


def test_the_curvature_of_the_loss_falls_with_the_weights_and_is_none_at_one_half() -> None:
    """Twice the weight less one is the second derivative of the loss: half of it makes each step twice as long."""
    others, own, values = linear_fit()
    block = np.arange(60) // 10
    (full,) = jackknife(others, own, values, np.ones(60), [block])
    (less,) = jackknife(others, own, values, np.full(60, 0.75), [block])
    np.testing.assert_allclose(less, 4 * full, rtol=1e-9)
    (none,) = jackknife(others, own, values, np.full(60, 0.5), [block])
    np.testing.assert_array_equal(none, [np.inf, np.inf])


@pytest.mark.parametrize(("left_of_column", "is_finite"), [(0.5e-14, False), (2e-14, True)])
def test_unknowns_that_hang_on_one_block_have_no_variance(left_of_column: float, is_finite: bool) -> None:
    others = np.zeros((40, 1))
    others[:20, 0] = np.sqrt((1 - left_of_column) / 20)
    others[20:, 0] = np.sqrt(left_of_column / 20) * np.tile([1, -1], 10)
    own = np.tile([1.0, 1.0, -1.0, -1.0], 10)[:, None]
    (found,) = jackknife(others, own, np.ones(40), np.ones(40), [np.arange(40) // 20])
    assert found.shape == (1,)
    assert np.all(np.isfinite(found)) == is_finite
    (single,) = jackknife(others, own, np.ones(40), np.ones(40), [np.zeros(40, dtype=np.int64)])
    assert single[0] == np.inf


def an_offset_fit(times_s: Array, weights: Array | None = None) -> OffsetFit:
    """Return a fit of ranges at these times, of which only times and weights are told."""
    num = len(times_s)
    squares: Any = SimpleNamespace(weights=np.ones(num) if weights is None else weights, basis=np.zeros((num, 0)))
    zero = np.zeros(num, dtype=np.int64)
    ranges = TimedRanges(times_s, np.ones(num), zero, zero)
    return OffsetFit(0.0, ranges, squares, np.ones(num), num, np.ones(num), np.ones(num))


@pytest.mark.parametrize(
    ("span_s", "num_blocks"), [(60.0, [6, 12, 24]), (240.0, [6, 12, 24]), (300.0, [8, 15, 30]), (600.0, [15, 30, 60])]
)
def test_the_variance_is_the_mean_over_numbers_of_blocks_that_grow_in_long_logs(
    span_s: float, num_blocks: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The error of all ranges together, of 5 cm, comes on top."""
    asked: list[int] = []

    def variances(_own: Array, _residuals: Array, _squares: Any, blocks: Sequence[Indices]) -> list[Array]:
        asked.extend(len(np.unique(block)) for block in blocks)
        return [np.array([1.0, 0.1]), np.array([2.0, 0.2]), np.array([6.0, 0.6])]

    monkeypatch.setattr(fit, "_jackknife_variances", variances)
    times_s = np.linspace(0, span_s, 1200)
    own = np.column_stack([np.ones(1200), np.tile([1.0, -1.0], 600)])
    found = an_offset_fit(times_s)._variances(own, np.ones(1200), times_s)
    assert asked == num_blocks
    np.testing.assert_allclose(found, [3.0 + 0.05**2, 0.3])
    weighted = an_offset_fit(times_s, np.full(1200, 0.25))._variances(own, np.ones(1200), times_s)
    np.testing.assert_allclose(weighted, [3.0 + 0.025**2, 0.3])


@pytest.mark.parametrize(("span_s", "num_blocks"), [(60.0, 12), (120.0, 12), (600.0, 60)])
def test_the_variance_of_a_mean_is_that_of_means_of_blocks_of_ten_seconds_or_a_dozen(
    span_s: float, num_blocks: int
) -> None:
    rng = np.random.default_rng(3)
    times_s = np.linspace(100.0, 100.0 + span_s, 20 * num_blocks, endpoint=False)
    times_s[-1] = 100.0 + span_s
    values = np.repeat(rng.normal(size=num_blocks), 20) + 0.1 * rng.normal(size=20 * num_blocks)
    means = values.reshape(num_blocks, 20).mean(axis=1)
    assert fit._variance_of_mean(values, times_s) == pytest.approx(np.var(means, ddof=1) / num_blocks)


def test_blocks_without_ranges_are_not_counted() -> None:
    times_s = np.array([10.0, 11.0, 12.4, 17.6, 19.9, 20.0])
    np.testing.assert_array_equal(fit._blocks(times_s, 4), [0, 0, 0, 1, 1, 1])
    np.testing.assert_array_equal(fit._blocks(times_s, 5), [0, 0, 1, 2, 3, 3])
    np.testing.assert_array_equal(fit._blocks(np.array([0.0, 0.05, 0.15, 0.29, 0.3]), 3), [0, 0, 1, 2, 2])
    np.testing.assert_array_equal(fit._blocks(np.full(3, 7.0), 4), [0, 0, 0])


class DriftingClocks:
    """Clocks of a known drift, of which each refinement sees a fraction, with the stddev given."""

    def __init__(self, drift: float, stddev: float, seen: float, times_s: Array):
        self.drift, self.stddev, self.seen, self.times_s = drift, stddev, seen, times_s
        self.offsets_s: list[float] = []
        self.corrected: list[float] = []

    def refine_offset(self, ranges: TimedRanges, path: PathSamples, offset_s: float) -> Any:
        """Return a fit whose timing tells the drift that the times of the ranges still have."""
        middle = self.times_s.mean()
        slope, at_middle = np.polyfit(self.times_s - middle, ranges.times_s - self.times_s, 1)
        assert at_middle == pytest.approx(0.0, abs=1e-9)
        self.offsets_s.append(offset_s)
        self.corrected.append(float(slope))
        timing = Timing(0.1, self.seen * (self.drift - slope), self.stddev)
        return SimpleNamespace(offset_s=offset_s + 1.0, timing=lambda: timing)


@pytest.mark.parametrize(
    ("stddevs", "seen", "num_fits"),
    [
        (2.9, 1.0, 1),  # may be chance
        (-2.9, 1.0, 1),
        (3.1, 1.0, 2),
        (-3.1, 1.0, 2),
        # What is left falls to a tenth each time: 3, then 0.3, then 0.03 standard deviations.
        (3.0 / 0.9 + 0.1, 0.9, 3),
        # Half of it each time: 4, 2, ..; after seven corrections 0.03 are left.
        (8.0, 0.5, 8),
    ],
)
def test_a_drift_of_three_standard_deviations_is_removed_until_a_twentieth_is_left(
    stddevs: float, seen: float, num_fits: int, monkeypatch: pytest.MonkeyPatch, path: PathSamples
) -> None:
    times_s = 1000.0 + np.array([0.0, 10.0, 80.0, 110.0])
    clocks = DriftingClocks(1e-4 * stddevs, 1e-4, seen, times_s)
    monkeypatch.setattr(fit, "refine_offset", clocks.refine_offset)
    zero = np.zeros(4, dtype=np.int64)
    found, timing, drift, reference_s = fit_clocks(TimedRanges(times_s, np.ones(4), zero, zero), path, 5.0)
    assert clocks.offsets_s == [5.0 + k for k in range(num_fits)]
    assert found.offset_s == 5.0 + num_fits
    assert reference_s == 1050.0
    left = (1 - seen) ** (num_fits - 1)
    assert drift == pytest.approx(1e-4 * stddevs * (1 - left) if num_fits > 1 else 0.0, abs=1e-10)
    assert drift == pytest.approx(clocks.corrected[-1], abs=1e-10)
    assert timing.drift == pytest.approx(seen * (1e-4 * stddevs - drift), abs=1e-10)


def test_a_drift_is_told_with_its_uncertainty_and_what_it_does_in_half_of_the_log() -> None:
    """A tenth of a thousandth is 100 ppm, and over 300 s 0.03 s."""
    assert drift_note(-1e-4, 1e-5, np.array([100.0, 700.0, 300.0])) == (
        "the clocks drift: the camera's gains -100 ppm on the radio's (within 20 ppm, 95 %); the drift is corrected, "
        "and the time offset at the end of the log differs by -0.030 s from that in its middle"
    )
    assert "gains +250 ppm on the radio's (within 39 ppm" in drift_note(2.5e-4, 2e-5, np.array([0.0, 1.0]))


@pytest.mark.parametrize(("own", "is_determined"), [(0.99e-7, False), (1.01e-7, True)])
def test_an_offset_is_determined_if_more_than_rounding_of_the_rates_is_its_own(own: float, is_determined: bool) -> None:
    rates = np.array([3.0, -4.0, 12.0])
    assert fit._is_determined(own * rates[::-1], rates) == is_determined

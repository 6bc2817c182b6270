"""The descent to a time offset of the clocks."""

from __future__ import annotations

import numpy as np
import pytest

from rangesfm.ranging.clock import fit, time_offset
from rangesfm.ranging.clock.fit import Timing, fit_at_offset, refine_offset
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


@pytest.mark.parametrize(("own", "is_determined"), [(0.99e-7, False), (1.01e-7, True)])
def test_an_offset_is_determined_if_more_than_rounding_of_the_rates_is_its_own(own: float, is_determined: bool) -> None:
    rates = np.array([3.0, -4.0, 12.0])
    assert fit._is_determined(own * rates[::-1], rates) == is_determined

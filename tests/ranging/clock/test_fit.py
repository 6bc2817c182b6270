"""What motion must be like to tell the time offset of the clocks."""

from __future__ import annotations

import numpy as np
import pytest

from rangesfm.ranging.clock.fit import Timing, fit_at_offset
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


def test_even_motion_on_a_line_tells_nothing_of_the_clocks() -> None:
    """Another offset fits equally well with another place of the anchor."""
    times_s = STEP_S * np.arange(NUM_SAMPLES)
    way = times_s[:, None] * np.array([0.5, 0.2, 0.0])
    even = PathSamples(0.0, STEP_S, way, np.zeros((1, NUM_SAMPLES, 3)), np.ones(NUM_SAMPLES, dtype=bool))
    assert fit_at_offset(ranges_at(even, 0.0, 0.02), even, 0.0).timing() == Timing(np.inf, 0.0, np.inf)

"""The search over all time offsets of the clocks."""

from __future__ import annotations

import numpy as np
import pytest

from rangesfm.ranging.clock.search import PathSamples, TimedRanges, scan_offsets


@pytest.mark.parametrize("rounding", [0.0, 1e-15])
def test_a_camera_that_stands_still_but_for_rounding_explains_no_range_at_any_offset(rounding: float) -> None:
    """No ranges fit any offset, not even ranges that vary as the rounding errors do."""
    rng = np.random.default_rng(0)
    wobble = rng.normal(size=(400, 3)).cumsum(axis=0)
    centers = np.array([1.0, 2.0, 3.0]) + rounding * wobble / np.abs(wobble).max()
    path = PathSamples(0.0, 0.025, centers, np.zeros((1, 400, 3)), np.ones(400, dtype=bool))
    zero = np.zeros(400, dtype=np.int64)
    ranges = TimedRanges(0.025 * np.arange(400, dtype=np.float64), 20.0 + wobble[:, 0], zero, zero)
    np.testing.assert_allclose(scan_offsets(ranges, path).scores, 0.0, atol=1e-3)

"""The study of the time offset's stddev, with few seeds and its two shortest logs.

For all of it, run ``tests/studies/clock_coverage.py``.
"""

from __future__ import annotations

import numpy as np
import pytest
from tests.studies import clock_coverage

NUM_SEEDS = 6


@pytest.mark.parametrize("num_anchors", [1, 4])
def test_offset_of_a_short_log_with_errors_that_stay_is_as_certain_as_it_is_said_to_be(num_anchors: int) -> None:
    errors, stddevs = clock_coverage.estimates(20.0, num_anchors, correlation_s=2.0, num_seeds=NUM_SEEDS)
    assert len(errors) >= NUM_SEEDS - 1
    scaled = errors / stddevs
    # With residuals summed over blocks, and without the jackknife's steps, both are 1.6 to 1.9.
    assert 0.4 < np.sqrt(np.mean(scaled**2)) < 1.4
    assert np.mean(np.abs(scaled) < 1.96) >= 0.8
    assert np.median(stddevs) < 0.03

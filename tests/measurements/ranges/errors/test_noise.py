"""Errors that ranges have in common: those of short ranges, and biases."""

from __future__ import annotations

import numpy as np

from rangesfm.measurements.ranges.errors.noise import (
    bias_whitening,
    shared_stddev,
    short_range_stddev,
)
from rangesfm.measurements.ranges.range_log import RangeLog


def test_short_ranges_share_an_error_that_fades_within_metres() -> None:
    expected = [2.0, 2.0 * np.exp(-1.0), 2.0 * np.exp(-4.0)]
    np.testing.assert_allclose(short_range_stddev(np.array([0.0, 1.0, 4.0])), expected)
    log = RangeLog.from_arrays(["a", "a"], [1.0, 4.0], timestamp_s=[0.0, 1.0])
    np.testing.assert_allclose(shared_stddev(log.range_m, log.shared_stddev_m), expected[1:])
    np.testing.assert_array_equal(shared_stddev(log.range_m, np.array([0.3, 0.4])), [0.3, 0.4])


def test_whitened_biases_are_independent_with_variance_one() -> None:
    own = np.array([0.1, 0.2, 0.4])
    whitening = bias_whitening(own, 0.3)
    covariance = np.full((3, 3), 0.09) + np.diag([0.01, 0.04, 0.16])
    np.testing.assert_allclose(whitening @ covariance @ whitening.T, np.eye(3), atol=1e-12)
    assert bias_whitening(np.zeros(0), 0.3).shape == (0, 0)

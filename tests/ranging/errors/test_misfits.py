"""Residuals that are not noise."""

from __future__ import annotations

import numpy as np
from tests.ranging.errors.test_range_errors import NUM_EACH, make_errors, noise

from rangesfm.ranging.errors.range_errors import misfits
from rangesfm.ranging.errors.robust_loss import CAUCHY


def test_noise_is_no_misfit() -> None:
    assert misfits(make_errors(0.1), noise((0.1, 0.1, 0.1)), np.arange(3.0 * NUM_EACH)) == ()


def test_residuals_far_beyond_their_stddev_are_told() -> None:
    reasons = misfits(make_errors(0.01), noise((0.1, 0.1, 0.1)), np.arange(3.0 * NUM_EACH))
    assert any("times their stddev" in reason for reason in reasons)


def test_a_stretch_that_is_off_is_told() -> None:
    residuals = noise((0.1, 0.1, 0.1))
    residuals[300:360] += 1.0
    (reason,) = misfits(make_errors(0.1), residuals, np.arange(3.0 * NUM_EACH))
    assert "in 3 of 60 stretches" in reason


def test_drift_that_is_left_is_told_even_where_the_noise_was_estimated_with_it() -> None:
    drift = 3.0 * np.sin(np.arange(3 * NUM_EACH) / 150)
    errors = make_errors(loss=CAUCHY).seen_by_bending_map(noise((0.1, 0.1, 0.1)) + drift, 0.0)
    reasons = misfits(errors, noise((0.1, 0.1, 0.1)) + drift, np.arange(3.0 * NUM_EACH))
    assert any("far larger than the ranges' scatter" in reason for reason in reasons)

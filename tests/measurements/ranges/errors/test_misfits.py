"""Residuals that are not noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from tests.measurements.ranges.errors.test_range_errors import NUM_EACH, make_errors, noise

from rangesfm.measurements.ranges.errors.range_errors import RangeErrors, misfits
from rangesfm.util.geometry.robust_statistics import CAUCHY


def test_noise_is_no_misfit() -> None:
    assert misfits(make_errors(0.1), noise((0.1, 0.1, 0.1)), np.arange(3.0 * NUM_EACH)) == ()


def test_residuals_far_beyond_their_stddev_are_told() -> None:
    reasons = misfits(make_errors(0.01), noise((0.1, 0.1, 0.1)), np.arange(3.0 * NUM_EACH))
    assert any("times their standard deviation" in misfit.reason for misfit in reasons)


def test_a_log_that_has_each_range_twice_scatters_as_before() -> None:
    rows = np.repeat(np.arange(3 * NUM_EACH), 2)
    assert misfits(make_errors(0.1).subset(rows), noise((0.1, 0.1, 0.1))[rows], rows.astype(np.float64)) == ()


def test_a_stretch_that_is_off_is_told() -> None:
    residuals = noise((0.1, 0.1, 0.1))
    residuals[300:360] += 1.0
    (reason,) = misfits(make_errors(0.1), residuals, np.arange(3.0 * NUM_EACH))
    assert "in 3 of 60 short periods" in reason.reason
    assert reason.advice == "check clocks, lever arm and anchors"


def test_one_stretch_of_many_in_which_somebody_stood_between_is_no_misfit() -> None:
    residuals = noise((0.1, 0.1, 0.1))
    residuals[300:320] += 1.0
    assert misfits(make_errors(0.1), residuals, np.arange(3.0 * NUM_EACH)) == ()


def test_drift_that_is_left_is_told_even_where_the_noise_was_estimated_with_it() -> None:
    drift = 3.0 * np.sin(np.arange(3 * NUM_EACH) / 150)
    errors = make_errors(loss=CAUCHY).seen_by_bending_map(noise((0.1, 0.1, 0.1)) + drift, 0.0)
    reasons = misfits(errors, noise((0.1, 0.1, 0.1)) + drift, np.arange(3.0 * NUM_EACH))
    (reason,) = (misfit for misfit in reasons if "far more than they scatter" in misfit.reason)
    assert reason.advice == "check clocks, lever arm and anchors"


def test_photos_too_far_apart_are_told_where_ranges_fit_only_near_them() -> None:
    """Photos every 40 ranges, and a path between them that is off by up to half a metre."""
    between = np.abs(np.sin(np.arange(3 * NUM_EACH) * np.pi / 40))
    errors = replace(make_errors(0.4), placing_m=0.4 * between)
    reasons = misfits(errors, noise((0.02, 0.02, 0.02)) + 0.5 * between, np.arange(3.0 * NUM_EACH))
    (reason,) = (misfit for misfit in reasons if "far more than they scatter" in misfit.reason)
    assert reason.reason.endswith("the photos are too far apart")
    assert "use more of the photos" in reason.advice


def apart(num: int, stddev_m: float = 1.0) -> RangeErrors:
    """Errors of ranges of as many anchors in as many stretches of time."""
    return replace(make_errors(stddev_m).subset(np.arange(num)), anchor_index=np.arange(num), block=np.arange(num))

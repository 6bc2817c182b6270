"""Residuals that are not noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from tests.ranging.errors.test_range_errors import NUM_EACH, make_errors, noise

from rangesfm.ranging.errors.range_errors import Misfit, RangeErrors, misfits
from rangesfm.ranging.errors.robust_loss import CAUCHY

Array = npt.NDArray[np.float64]


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
    assert reason.remedy == "check clocks, lever arm and anchors"


def test_one_stretch_of_many_in_which_somebody_stood_between_is_no_misfit() -> None:
    residuals = noise((0.1, 0.1, 0.1))
    residuals[300:320] += 1.0
    assert misfits(make_errors(0.1), residuals, np.arange(3.0 * NUM_EACH)) == ()


def test_drift_that_is_left_is_told_even_where_the_noise_was_estimated_with_it() -> None:
    drift = 3.0 * np.sin(np.arange(3 * NUM_EACH) / 150)
    errors = make_errors(loss=CAUCHY).seen_by_bending_map(noise((0.1, 0.1, 0.1)) + drift, 0.0)
    reasons = misfits(errors, noise((0.1, 0.1, 0.1)) + drift, np.arange(3.0 * NUM_EACH))
    (reason,) = (misfit for misfit in reasons if "far more than they scatter" in misfit.reason)
    assert reason.remedy == "check clocks, lever arm and anchors"


def test_photos_too_far_apart_are_told_where_ranges_fit_only_near_them() -> None:
    """Photos every 40 ranges, and a path between them that is off by up to half a metre."""
    between = np.abs(np.sin(np.arange(3 * NUM_EACH) * np.pi / 40))
    errors = replace(make_errors(0.4), placing_m=0.4 * between)
    reasons = misfits(errors, noise((0.02, 0.02, 0.02)) + 0.5 * between, np.arange(3.0 * NUM_EACH))
    (reason,) = (misfit for misfit in reasons if "far more than they scatter" in misfit.reason)
    assert reason.reason.endswith("the photos are too far apart")
    assert "use more of the photos" in reason.remedy


def apart(num: int, stddev_m: float = 1.0) -> RangeErrors:
    """Errors of ranges of as many anchors in as many stretches of time."""
    return replace(make_errors(stddev_m).subset(np.arange(num)), anchor_index=np.arange(num), block=np.arange(num))


def alternating(num: int, middle_m: float, off_m: float) -> Array:
    return middle_m + off_m * np.resize([1.0, -1.0], num)


def test_nothing_is_told_of_no_ranges() -> None:
    assert misfits(apart(0), np.zeros(0), np.zeros(0)) == ()


def test_twenty_residuals_of_more_than_three_stddevs_are_told() -> None:
    def told(num: int, typical: float) -> tuple[Misfit, ...]:
        return misfits(apart(num, 0.1), alternating(num, 0.0, 0.1 * typical / 1.4826022), np.arange(float(num)))

    assert told(20, 3.06) == (Misfit("the ranges typically miss the map by 3.1 times their standard deviation"),)
    assert told(20, 2.95) == told(19, 3.06) == ()


OFF_AS_A_WHOLE = (
    "in 1 of 49 short periods all ranges to one anchor miss the map on the same side, by more than their noise explains"
)


@pytest.mark.parametrize(
    ("num_blocks", "num_each", "off", "told"),
    [
        (49, 5, 3.1, (OFF_AS_A_WHOLE,)),
        (49, 5, -3.1, (OFF_AS_A_WHOLE,)),
        (50, 5, 3.1, ()),
        (49, 5, 2.9, ()),
        (49, 4, 3.1, ()),
    ],
)
def test_one_stretch_of_fifty_may_be_off_by_more_than_three_stddevs(
    num_blocks: int, num_each: int, off: float, told: tuple[str, ...]
) -> None:
    num = num_blocks * num_each
    block = np.arange(num) // num_each
    residuals = 0.1 * (alternating(num, 0.0, 1.0) + np.where(block == 7, off, 0.0))
    if num_each == 5:
        residuals[block == 7] = 0.1 * off
    errors = replace(apart(num, 0.1), block=block, anchor_index=np.full(num, 2))
    assert tuple(misfit.reason for misfit in misfits(errors, residuals, np.arange(float(num)))) == told


def of_one_anchor(num: int) -> RangeErrors:
    return replace(apart(num), anchor_index=np.zeros(num, dtype=np.int64))


def test_residuals_five_times_as_large_as_their_scatter_are_told_of_twenty_steps() -> None:
    """Steps of twice 0.1 m are a scatter of 0.1 m times the root of two, besides 1.4826022 for both."""
    limit = 5 * 0.1 * np.sqrt(2)

    def told(num: int, size_m: float) -> tuple[Misfit, ...]:
        return misfits(of_one_anchor(num), alternating(num, size_m - 0.1, 0.1), np.arange(float(num)))

    (misfit,) = told(21, 1.02 * limit)
    scatter_m = 1.4826022 * 0.1 * np.sqrt(2)
    assert misfit == Misfit(
        f"the ranges miss the map by {5 * 1.02 * scatter_m:.2f} m, far more than they scatter from one to the next "
        f"({scatter_m:.2f} m)"
    )
    assert told(21, 0.98 * limit) == told(20, 1.02 * limit) == ()


def test_a_scatter_below_a_centimetre_counts_as_one() -> None:
    small, large = (misfits(of_one_anchor(30), np.full(30, mm / 1482.6), np.arange(30.0)) for mm in (49, 51))
    assert small == ()
    assert (
        large[0].reason == "the ranges miss the map by 0.05 m, far more than they scatter from one to the next (0.01 m)"
    )


def test_steps_are_between_ranges_of_one_anchor_in_the_order_of_time() -> None:
    """Each anchor's residuals rise slowly; those of the other, and the order of the log, jump."""
    order = np.random.default_rng(0).permutation(60)
    time = np.arange(60)
    residuals = np.where(time % 2 == 0, 1.0, -1.0) * (1.0 + 0.002 * time)
    errors = replace(apart(60), anchor_index=time[order] % 2)
    (misfit,) = misfits(errors, residuals[order], time[order].astype(np.float64))
    assert (
        misfit.reason == "the ranges miss the map by 1.57 m, far more than they scatter from one to the next (0.01 m)"
    )
    anchors = np.repeat([0, 1], 30)
    assert misfits(replace(apart(60), anchor_index=anchors), alternating(60, 0.0, 1.0), np.arange(60.0)) == ()


@pytest.mark.parametrize(("share", "num_near", "is_told"), [(0.49, 11, True), (0.51, 20, False), (0.49, 9, False)])
def test_the_fifth_of_the_ranges_nearest_to_photos_tells_whether_these_are_too_far_apart(
    share: float, num_near: int, is_told: bool
) -> None:
    residuals = np.ones(100)
    residuals[:num_near] = share
    errors = replace(of_one_anchor(100), placing_m=np.linspace(0.0, 0.1, 100))
    (misfit,) = misfits(errors, residuals, np.arange(100.0))
    told = "the ranges miss the map by 1.48 m, far more than they scatter from one to the next (0.01 m)"
    if is_told:
        assert misfit.reason == f"{told}, but not those nearest to the photos (0.73 m): the photos are too far apart"
        assert misfit.remedy.startswith("use more of the photos")
    else:
        assert misfit == Misfit(told)

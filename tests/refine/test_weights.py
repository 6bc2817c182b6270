"""Noise found from residuals, and residuals that are none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest

from rangesfm.ranging.errors.robust_loss import CAUCHY, GEMAN_MCCLURE, RobustLoss
from rangesfm.refine.weights import RangeWeights, misfits

Array = npt.NDArray[np.float64]
NUM_EACH = 400


def make_weights(stddev_m: float = 1.0, *, is_estimated: bool = True, loss: RobustLoss = GEMAN_MCCLURE) -> RangeWeights:
    """Three anchors in turn for 400 rounds of half a second."""
    n = 3 * NUM_EACH
    rounds = np.arange(n) // 3
    return RangeWeights(
        stddev_m=np.full(n, stddev_m),
        inflation=1.0,
        fixed_m=np.zeros(n),
        is_estimated=np.full(n, is_estimated),
        anchor_index=np.arange(n) % 3,
        block=rounds // 20,
        place=np.arange(n),
        place_share=np.ones(n),
        loss=loss,
    )


def noise(stddevs_m: tuple[float, float, float]) -> Array:
    values: Array = np.random.default_rng(0).standard_normal(3 * NUM_EACH) * np.tile(stddevs_m, NUM_EACH)
    return values


def test_a_noisier_anchor_is_known_by_its_residuals() -> None:
    found = make_weights().estimated(noise((0.05, 0.05, 0.3)), 0.0)
    assert found.stddev_m[2] == pytest.approx(0.3, rel=0.15)
    assert found.stddev_m[0] == pytest.approx(0.05, rel=0.15)
    assert found.inflation == pytest.approx(1.0, abs=0.25)


def test_anchors_of_like_noise_share_it() -> None:
    found = make_weights().estimated(noise((0.1, 0.1, 0.1)), 0.0)
    np.testing.assert_array_equal(found.stddev_m, found.stddev_m[0])
    assert found.stddev_m[0] == pytest.approx(0.1, rel=0.07)


def test_an_anchor_that_disagrees_as_a_whole_is_not_silenced() -> None:
    residuals = noise((0.1, 0.1, 0.1)) + np.tile([0.0, 0.0, 0.3], NUM_EACH)
    found = make_weights().estimated(residuals, 0.0)
    np.testing.assert_array_equal(found.stddev_m, found.stddev_m[0])


def test_what_the_map_takes_from_the_residuals_is_given_back() -> None:
    plain, widened = (make_weights().estimated(noise((0.1, 0.1, 0.1)), num) for num in (0.0, 900.0))
    assert widened.stddev_m[0] == pytest.approx(2 * plain.stddev_m[0])


def test_slow_errors_weigh_less_than_their_size_says() -> None:
    slow = np.repeat(np.random.default_rng(1).standard_normal(20), 60) * 0.2
    assert make_weights().estimated(noise((0.1, 0.1, 0.1)) + slow, 0.0).inflation > 3


def test_ranges_of_one_place_that_err_alike_count_for_less() -> None:
    """A hundred places of two ranges to each anchor, and then one place for all the rest."""
    num_places = 101
    rounds = np.minimum(np.arange(3 * NUM_EACH) // 3 // 2, num_places - 1)
    place = rounds + num_places * (np.arange(3 * NUM_EACH) % 3)
    alike = 0.1 * np.random.default_rng(2).standard_normal(3 * num_places)[place]
    weights = replace(make_weights(), place=place)
    apart, together = (
        weights.estimated(noise((0.1, 0.1, 0.1)), 0.0),
        weights.estimated(noise((0.1, 0.1, 0.1)) + alike, 0.0),
    )
    lingered = rounds == num_places - 1
    assert apart.place_share[lingered].mean() > 0.5 * apart.place_share[~lingered].mean()
    assert together.place_share[lingered].mean() < 0.1 * together.place_share[~lingered].mean()
    as_if_each_its_own = make_weights().estimated(noise((0.1, 0.1, 0.1)) + alike, 0.0)
    assert together.inflation < 0.7 * as_if_each_its_own.inflation


def test_independent_errors_keep_their_say() -> None:
    """Chance makes some of them look alike; on average it takes little, of one place as of one stretch of time."""
    rounds, anchors = np.divmod(np.arange(3 * NUM_EACH), 3)
    crowded = replace(make_weights(), place=np.unique(3 * (rounds // 5) + anchors, return_inverse=True)[1])
    says = []
    for seed in range(20):
        residuals = 0.1 * np.random.default_rng(seed).standard_normal(3 * NUM_EACH)
        found = crowded.estimated(residuals, 0.0)
        says.append(np.mean(found.share / found.stddev_m**2) * 0.1**2)
    assert 0.85 < np.mean(says) < 1.1
    assert np.min(says) > 0.6


def test_noise_stays_that_of_the_likeliest_residuals() -> None:
    """Seven of ten ranges are long, and then a fit has gone half-way to meet them."""
    rng = np.random.default_rng(3)
    is_long = rng.random(3 * NUM_EACH) < 0.7
    true = noise((0.1, 0.1, 0.1)) - is_long * rng.exponential(1.0, 3 * NUM_EACH)
    followed = true + 0.8 + 0.4 * rng.standard_normal(3 * NUM_EACH)
    fresh = replace(make_weights(), loss=GEMAN_MCCLURE)
    seen = fresh.estimated(true, 0.0)
    assert seen.stddev_m[0] < 0.25
    assert fresh.estimated(followed, 0.0).stddev_m[0] > 2 * seen.stddev_m[0]
    np.testing.assert_array_equal(seen.estimated(followed, 0.0).stddev_m, seen.stddev_m)
    assert seen.estimated(noise((0.05, 0.05, 0.05)), 0.0).stddev_m[0] == pytest.approx(0.05, rel=0.15)


def test_an_anchors_noise_is_that_of_its_ranges_that_fit() -> None:
    """One anchor has most of its ranges short, the others few."""
    rng = np.random.default_rng(4)
    is_short = rng.random(3 * NUM_EACH) < np.tile([0.7, 0.2, 0.2], NUM_EACH)
    residuals = noise((0.1, 0.1, 0.1)) + is_short * rng.exponential(5.0, 3 * NUM_EACH)
    found = make_weights().estimated(residuals, 0.0)
    np.testing.assert_array_equal(found.stddev_m, found.stddev_m[0])
    assert found.stddev_m[0] == pytest.approx(0.1, rel=0.15)


def test_a_map_that_may_bend_shows_no_more_noise_than_one_that_may_not() -> None:
    held = replace(make_weights(), max_noise_m=0.07).estimated(noise((0.1, 0.1, 0.1)), 0.0)
    np.testing.assert_allclose(held.stddev_m, 0.07)
    free = replace(make_weights(), max_noise_m=0.2).estimated(noise((0.1, 0.1, 0.1)), 0.0)
    assert free.stddev_m[0] == pytest.approx(0.1, rel=0.07)


def test_what_drifts_away_is_noise_to_the_wide_loss_alone() -> None:
    """Six of ten ranges are off by metres: outliers, or drift."""
    residuals = noise((0.1, 0.1, 0.1))
    residuals[: 3 * NUM_EACH * 6 // 10] += 3.0
    wide, bounded = (make_weights(loss=loss).estimated(residuals, 0.0).stddev_m[0] for loss in (CAUCHY, GEMAN_MCCLURE))
    assert wide > 3.0
    assert bounded == pytest.approx(0.1, rel=0.2)


def test_known_noise_stays_as_it_is() -> None:
    weights = make_weights(0.2, is_estimated=False)
    assert weights.estimated(noise((1.0, 1.0, 1.0)), 0.0) is weights


def test_a_change_is_that_of_the_ranges_that_have_a_place() -> None:
    weights = make_weights(0.1)
    stddev = np.where(np.arange(3 * NUM_EACH) < 3, np.nan, 0.1)
    before = replace(weights, stddev_m=stddev)
    assert before.change(replace(weights, stddev_m=1.5 * stddev)) == pytest.approx(np.log(1.5))
    assert before.change(before) == 0.0


def test_noise_is_no_misfit() -> None:
    assert misfits(make_weights(0.1), noise((0.1, 0.1, 0.1)), np.arange(3.0 * NUM_EACH)) == ()


def test_residuals_far_beyond_their_stddev_are_told() -> None:
    reasons = misfits(make_weights(0.01), noise((0.1, 0.1, 0.1)), np.arange(3.0 * NUM_EACH))
    assert any("times their stddev" in reason for reason in reasons)


def test_a_stretch_that_is_off_is_told() -> None:
    residuals = noise((0.1, 0.1, 0.1))
    residuals[300:360] += 1.0
    (reason,) = misfits(make_weights(0.1), residuals, np.arange(3.0 * NUM_EACH))
    assert "in 3 of 60 stretches" in reason


def test_drift_that_is_left_is_told_even_where_the_noise_was_estimated_with_it() -> None:
    drift = 3.0 * np.sin(np.arange(3 * NUM_EACH) / 150)
    weights = make_weights(loss=CAUCHY).estimated(noise((0.1, 0.1, 0.1)) + drift, 0.0)
    reasons = misfits(weights, noise((0.1, 0.1, 0.1)) + drift, np.arange(3.0 * NUM_EACH))
    assert any("far larger than the ranges' scatter" in reason for reason in reasons)

"""The noise of ranges, found from their residuals."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from scipy.stats import norm

from rangesfm.options import RangeModelOptions
from rangesfm.ranging.errors.range_errors import RangeErrors, fit_with_own_errors
from rangesfm.ranging.errors.robust_loss import CAUCHY, GEMAN_MCCLURE, RobustLoss
from rangesfm.ranging.range_log import RangeLog

Array = npt.NDArray[np.float64]
NUM_EACH = 400


def make_errors(stddev_m: float = 1.0, *, is_estimated: bool = True, loss: RobustLoss = GEMAN_MCCLURE) -> RangeErrors:
    """Errors of three anchors in turn, for 400 rounds of half a second."""
    n = 3 * NUM_EACH
    rounds = np.arange(n) // 3
    return RangeErrors(
        stddev_m=np.full(n, stddev_m),
        share=np.ones(n),
        inflation=1.0,
        given_m=np.full(n, np.nan if is_estimated else stddev_m),
        shared_m=np.zeros(n),
        placing_m=np.zeros(n),
        anchor_index=np.arange(n) % 3,
        block=rounds // 20,
        place=np.arange(n),
        loss=loss,
        common_bias_stddev_m=0.1,
    )


def noise(stddevs_m: tuple[float, float, float]) -> Array:
    values: Array = np.random.default_rng(0).standard_normal(3 * NUM_EACH) * np.tile(stddevs_m, NUM_EACH)
    return values


def test_a_noisier_anchor_is_known_by_its_residuals() -> None:
    found = make_errors().seen_by_bending_map(noise((0.05, 0.05, 0.3)), 0.0)
    assert found.stddev_m[2] == pytest.approx(0.3, rel=0.15)
    assert found.stddev_m[0] == pytest.approx(0.05, rel=0.15)
    assert found.inflation == pytest.approx(1.0, abs=0.25)


def test_anchors_of_like_noise_share_it() -> None:
    found = make_errors().seen_by_bending_map(noise((0.1, 0.1, 0.1)), 0.0)
    np.testing.assert_array_equal(found.stddev_m, found.stddev_m[0])
    assert found.stddev_m[0] == pytest.approx(0.1, rel=0.07)


def test_an_anchor_that_disagrees_as_a_whole_is_not_silenced() -> None:
    residuals = noise((0.1, 0.1, 0.1)) + np.tile([0.0, 0.0, 0.3], NUM_EACH)
    found = make_errors().seen_by_bending_map(residuals, 0.0)
    np.testing.assert_array_equal(found.stddev_m, found.stddev_m[0])


def test_what_the_map_takes_from_the_residuals_is_given_back() -> None:
    plain, widened = (make_errors().seen_by_bending_map(noise((0.1, 0.1, 0.1)), num) for num in (0.0, 900.0))
    assert widened.stddev_m[0] == pytest.approx(2 * plain.stddev_m[0])


def test_slow_errors_weigh_less_than_their_size_says() -> None:
    slow = np.repeat(np.random.default_rng(1).standard_normal(20), 60) * 0.2
    assert make_errors().seen_by_bending_map(noise((0.1, 0.1, 0.1)) + slow, 0.0).inflation > 3


def test_ranges_of_one_place_that_err_alike_count_for_less() -> None:
    """A hundred places have two ranges to each anchor each; one more place has all the others."""
    num_places = 101
    rounds = np.minimum(np.arange(3 * NUM_EACH) // 3 // 2, num_places - 1)
    place = rounds + num_places * (np.arange(3 * NUM_EACH) % 3)
    alike = 0.1 * np.random.default_rng(2).standard_normal(3 * num_places)[place]
    errors = replace(make_errors(), place=place)
    apart, together = (
        errors.seen_by_bending_map(noise((0.1, 0.1, 0.1)), 0.0),
        errors.seen_by_bending_map(noise((0.1, 0.1, 0.1)) + alike, 0.0),
    )
    lingered = rounds == num_places - 1
    assert apart.share[lingered].mean() > 0.5 * apart.share[~lingered].mean()
    assert together.share[lingered].mean() < 0.1 * together.share[~lingered].mean()
    as_if_each_its_own = make_errors().seen_by_bending_map(noise((0.1, 0.1, 0.1)) + alike, 0.0)
    assert together.inflation < 0.7 * as_if_each_its_own.inflation


def test_independent_errors_keep_their_say() -> None:
    """Independent errors look correlated by chance; on average this hardly lowers their weights."""
    rounds, anchors = np.divmod(np.arange(3 * NUM_EACH), 3)
    crowded = replace(make_errors(), place=np.unique(3 * (rounds // 5) + anchors, return_inverse=True)[1])
    says = []
    for seed in range(20):
        residuals = 0.1 * np.random.default_rng(seed).standard_normal(3 * NUM_EACH)
        found = crowded.seen_by_bending_map(residuals, 0.0)
        says.append(np.mean(found.worth / found.stddev_m**2) * 0.1**2)
    assert 0.85 < np.mean(says) < 1.1
    assert np.min(says) > 0.6


def test_noise_stays_that_of_the_likeliest_residuals() -> None:
    """Seven of ten ranges are too long; a later fit that gives way to them does not change the noise."""
    rng = np.random.default_rng(3)
    is_long = rng.random(3 * NUM_EACH) < 0.7
    true = noise((0.1, 0.1, 0.1)) - is_long * rng.exponential(1.0, 3 * NUM_EACH)
    followed = true + 0.8 + 0.4 * rng.standard_normal(3 * NUM_EACH)
    fresh = replace(make_errors(), loss=GEMAN_MCCLURE)
    seen = fresh.seen_by_bending_map(true, 0.0)
    assert seen.stddev_m[0] < 0.25
    assert fresh.seen_by_bending_map(followed, 0.0).stddev_m[0] > 2 * seen.stddev_m[0]
    np.testing.assert_array_equal(seen.seen_by_bending_map(followed, 0.0).stddev_m, seen.stddev_m)
    assert seen.seen_by_bending_map(noise((0.05, 0.05, 0.05)), 0.0).stddev_m[0] == pytest.approx(0.05, rel=0.15)


def test_an_anchors_noise_is_that_of_its_ranges_that_fit() -> None:
    """One anchor has most of its ranges off to one side, the others few."""
    rng = np.random.default_rng(4)
    is_short = rng.random(3 * NUM_EACH) < np.tile([0.7, 0.2, 0.2], NUM_EACH)
    residuals = noise((0.1, 0.1, 0.1)) + is_short * rng.exponential(5.0, 3 * NUM_EACH)
    found = make_errors().seen_by_bending_map(residuals, 0.0)
    np.testing.assert_array_equal(found.stddev_m, found.stddev_m[0])
    assert found.stddev_m[0] == pytest.approx(0.1, rel=0.15)


def test_a_map_that_may_bend_shows_no_more_noise_than_one_that_may_not() -> None:
    held = replace(make_errors(), noise_m=0.07).seen_by_bending_map(noise((0.1, 0.1, 0.1)), 0.0)
    np.testing.assert_allclose(held.stddev_m, 0.07)
    free = replace(make_errors(), noise_m=0.2).seen_by_bending_map(noise((0.1, 0.1, 0.1)), 0.0)
    assert free.stddev_m[0] == pytest.approx(0.1, rel=0.07)


def test_it_begins_with_the_noise_that_the_rigid_map_showed() -> None:
    """The noise excludes the shared errors of short ranges, the uncertainty of places, and stated stddevs."""
    shared, placing = np.full(3 * NUM_EACH, 0.2), np.full(3 * NUM_EACH, 0.05)
    rigid = replace(make_errors(), shared_m=shared, placing_m=placing).seen_by_rigid_map(noise((0.1, 0.1, 0.1)), 0.0)
    begun = rigid.for_bending_map(CAUCHY)
    assert begun.noise_m == pytest.approx(rigid.noise_m, rel=1e-12)
    assert (begun.loss, begun.log_likelihood) == (CAUCHY, -np.inf)
    assert rigid.without_shared().for_bending_map(CAUCHY).noise_m == pytest.approx(rigid.noise_m, rel=1e-12)
    assert make_errors(0.1, is_estimated=False).for_bending_map(CAUCHY).noise_m == np.inf


def test_what_drifts_away_is_noise_to_the_wide_loss_alone() -> None:
    """Six of ten ranges are off by metres, which may be outliers or drift."""
    residuals = noise((0.1, 0.1, 0.1))
    residuals[: 3 * NUM_EACH * 6 // 10] += 3.0
    wide, bounded = (
        make_errors(loss=loss).seen_by_bending_map(residuals, 0.0).stddev_m[0] for loss in (CAUCHY, GEMAN_MCCLURE)
    )
    assert wide > 3.0
    assert bounded == pytest.approx(0.1, rel=0.2)


def test_known_noise_stays_as_it_is() -> None:
    errors = make_errors(0.2, is_estimated=False)
    assert errors.seen_by_bending_map(noise((1.0, 1.0, 1.0)), 0.0) is errors


def test_a_change_is_that_of_the_weight_that_changes_most() -> None:
    errors = make_errors(0.1)
    factor = np.where(np.arange(3 * NUM_EACH) < 3, 1.5, 1.1)
    assert errors.change(replace(errors, stddev_m=factor * errors.stddev_m)) == pytest.approx(np.log(1.5))
    assert errors.change(replace(errors, share=0.25 * errors.share)) == pytest.approx(np.log(2))
    assert errors.change(errors) == 0.0


def test_a_part_spread_over_the_whole_log_is_that_part_and_the_rest_has_no_place() -> None:
    rows, part = np.array([7, 3, 12]), replace(make_errors(), place=np.arange(3 * NUM_EACH) // 4)
    part = part.subset(np.array([4, 5, 600]))
    assert len(part.stddev_m) == 3
    np.testing.assert_array_equal(part.place, [0, 0, 1])
    spread = part.spread(rows, 20)
    assert np.count_nonzero(np.isfinite(spread.stddev_m)) == 3
    again = spread.subset(rows)
    for name in ("stddev_m", "share", "anchor_index", "block", "place"):
        np.testing.assert_array_equal(getattr(again, name), getattr(part, name))


def test_a_rigid_map_shows_one_noise_and_keeps_it_where_another_map_was_likelier() -> None:
    """The likelihood includes the cost of priors; stated stddevs stay as stated."""
    true = noise((0.1, 0.1, 0.1))
    seen = make_errors().seen_by_rigid_map(true, prior_cost=0.0)
    np.testing.assert_allclose(seen.stddev_m, seen.noise_m)
    assert seen.noise_m == pytest.approx(0.1, rel=0.07)
    assert seen.seen_by_rigid_map(3 * true, prior_cost=0.0).noise_m == seen.noise_m
    assert seen.seen_by_rigid_map(0.9 * true, prior_cost=1e6).noise_m == seen.noise_m
    assert seen.seen_by_rigid_map(0.9 * true, prior_cost=0.0).noise_m < seen.noise_m
    stated = replace(make_errors(), given_m=np.where(np.arange(3 * NUM_EACH) < 9, 0.5, np.nan))
    placed = replace(stated, placing_m=np.full(3 * NUM_EACH, 0.2), shared_m=np.full(3 * NUM_EACH, 0.05))
    found = placed.seen_by_rigid_map(true, prior_cost=0.0).stddev_m
    np.testing.assert_allclose(found[:9], np.sqrt(0.5**2 + 0.2**2 + 0.05**2))
    np.testing.assert_allclose(found[9:], np.sqrt(0.1**2 + 0.2**2 + 0.05**2), rtol=0.07)


def test_fits_and_errors_alternate_until_the_last_is_good_enough() -> None:
    """The simulated fit halves its start, and the errors grow by what the fit returns."""
    fits: list[tuple[float, float | None]] = []

    def fit(errors: float, before: float | None) -> float:
        fits.append((errors, before))
        return (8.0 if before is None else before) / 2

    def run(max_num_rounds: int, least: float) -> tuple[float, float, float]:
        fits.clear()
        return fit_with_own_errors(
            fit,
            lambda errors, fitted: errors + fitted,
            1.0,
            max_num_rounds=max_num_rounds,
            is_last=lambda used, seen, fitted: fitted <= least,
        )

    assert run(3, 0.0) == (1.0, 7.0, 8.0)
    assert fits == [(1.0, None), (5.0, 4.0), (7.0, 2.0)]
    assert run(9, 2.0) == (2.0, 5.0, 7.0)


def few(num: int, stddev_m: float = 1.0, **others: Any) -> RangeErrors:
    """Errors of some ranges, each of an anchor, a stretch and a place of its own."""
    return replace(
        RangeErrors(
            stddev_m=np.full(num, stddev_m),
            share=np.ones(num),
            inflation=1.0,
            given_m=np.full(num, np.nan),
            shared_m=np.zeros(num),
            placing_m=np.zeros(num),
            anchor_index=np.arange(num),
            block=np.arange(num),
            place=np.arange(num),
            loss=GEMAN_MCCLURE,
            common_bias_stddev_m=0.1,
        ),
        **others,
    )


def begun(log: RangeLog, rows: list[int], **options: float) -> RangeErrors:
    observations: Any = SimpleNamespace(log=log, before=np.array([5, 6, 7]))
    return RangeErrors.begin(observations, np.array(rows), RangeModelOptions(**options))


def test_a_map_seen_to_bend_keeps_its_likelihood() -> None:
    residuals = noise((0.1, 0.1, 0.1))
    seen = make_errors().seen_by_bending_map(residuals, 0.0)
    gaussian = np.sum(norm.logpdf(residuals, scale=0.1))
    assert seen.log_likelihood == pytest.approx(gaussian, rel=0.02)

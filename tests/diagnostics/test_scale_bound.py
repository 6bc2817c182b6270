"""The bound on the scale holds with its risk, also if one mistake was not found; and what was given is checked."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from scipy import special, stats
from tests.diagnostics.test_hypothesis_tests import made_test
from tests.studies.erring_surveys import SITES, run, surveyed

from rangesfm.diagnostics import hypothesis_tests
from rangesfm.diagnostics.catalogue import anchor_places, wrong_lever_arms
from rangesfm.diagnostics.hypothesis_tests import Factorization
from rangesfm.diagnostics.linearized import Linearized
from rangesfm.diagnostics.mistakes import find_mistakes
from rangesfm.diagnostics.scale_bound import RISK, HiddenMistake, _beyond, hidden_among, hidden_lengths, scale_bound
from rangesfm.scale.linear_map import noncentrality
from rangesfm.scale.scale_by_lengths import LengthScale
from rangesfm.scale.scale_estimate import ScaleUncertainty

ONE_PERCENT = ScaleUncertainty(0.0, {"noise": 0.01})


@pytest.fixture(scope="module")
def problem() -> Linearized:
    on_map = run(surveyed(SITES[0], 3), 3).on_map
    assert on_map is not None
    return find_mistakes(on_map).problem


def results_of(problem: Linearized) -> list[hypothesis_tests.Test]:
    return Factorization(problem).test([*anchor_places(problem), *wrong_lever_arms(problem)], 0)


def test_without_a_mistake_the_bound_is_that_of_a_normal_error() -> None:
    bound, limited_by = scale_bound(ONE_PERCENT, [])
    assert bound == pytest.approx(-0.01 * special.ndtri(RISK / 2), rel=1e-6)
    assert limited_by == ""


def test_a_mistake_of_any_size_exceeds_the_bound_unnoticed_no_more_often_than_the_risk() -> None:
    """Draw the two independent normal numbers, of the test and of the scale, for mistakes of many sizes."""
    hidden = HiddenMistake("a step", 0.004, 15.0, 1, np.inf)
    bound, limited_by = scale_bound(ONE_PERCENT, [hidden])
    assert limited_by == "a step"
    rng, num = np.random.default_rng(0), 1_000_000
    noise, of_test = 0.01 * rng.standard_normal(num), rng.standard_normal(num)
    risks = [
        np.mean(((of_test + moves) ** 2 < 15.0) & (np.abs(noise + 0.004 * moves) > bound))
        for moves in np.linspace(0.0, 8.0, 9)
    ]
    assert 0.5 * RISK < max(risks) < 1.4 * RISK  # of a million draws, 100 +- 10 exceed it
    assert np.argmax(risks) not in (0, 8)


def test_what_people_would_notice_limits_what_no_test_sees() -> None:
    bound, limited_by = scale_bound(ONE_PERCENT, [HiddenMistake("lever arm", np.inf, 15.0, 0, 0.02)])
    assert bound == pytest.approx(0.02 - 0.01 * special.ndtri(RISK), rel=1e-6)
    assert limited_by == "lever arm"
    assert scale_bound(ONE_PERCENT, [HiddenMistake("length", np.inf, 15.0, 1, np.inf)]) == (np.inf, "length")
    little, _ = scale_bound(ONE_PERCENT, [HiddenMistake("a step", 0.004, 15.0, 1, 0.002)])
    assert little < bound


def test_redundancy_is_the_share_of_a_mistake_that_the_residuals_show(problem: Linearized) -> None:
    """The residuals themselves are compared: with all unknowns adapting to the mistake, and on a map that is known."""
    silent = replace(problem, residual_m=0 * problem.residual_m, prior_residual=0 * problem.prior_residual)
    inverse = np.linalg.inv(problem.errors.covariance_m2)
    for test in results_of(problem):
        effect, seen = test.hypothesis.effect, test.hypothesis.seen
        off_m = effect.columns if seen is None else seen
        of_units = [
            replace(silent, residual_m=column, prior_residual=prior)
            for column, prior in zip(effect.columns.T, effect.priors.T, strict=True)
        ]
        left = np.stack([Factorization(made).residual for made in of_units], axis=1)
        directions = np.random.default_rng(0).standard_normal((test.hypothesis.num, 1000))
        shares = np.sum((left @ directions) ** 2, axis=0)
        shares /= np.einsum("ij,ik,kj->j", off_m @ directions, inverse, off_m @ directions)
        assert 0.0 < test.redundancy <= shares.min() * (1 + 1e-9)
        assert shares.min() < test.redundancy + 0.05
        assert shares.max() <= 1.0 + 1e-9


def test_what_two_anchors_alone_are_given_is_untested(problem: Linearized) -> None:
    """Three coordinates of each of two anchors determine the map, and nothing is left to check them."""
    few = np.isin(problem.bins.anchor_index, problem.heard[:2])
    loose = np.where(few[:, None] & few, problem.errors.covariance_m2, 0.0) + 1e8 * np.diag(~few)
    lonely = replace(problem, errors=replace(problem.errors, covariances_m2=loose[None]))
    places = {test.hypothesis.subject: test for test in results_of(lonely) if test.hypothesis.name == "anchor place"}
    assert places
    assert not any(test.is_checked for test in places.values())
    names = [problem.on_map.anchor_ids[k] for k in problem.heard[:2]]
    assert all(places[name].redundancy < 0.01 for name in names)
    with_all = [test for test in results_of(problem) if test.hypothesis.name == "anchor place"]
    assert all(test.is_checked for test in with_all)


def test_a_hidden_mistake_moves_the_scale_by_its_slope_for_each_stddev_of_its_test() -> None:
    """A mistake of the smallest detectable size moves its test by the root of Baarda's noncentrality."""
    by_unknowns = np.zeros((7, 2))
    by_unknowns[0] = [0.03, 0.04]
    test = made_test(
        sizes=(1.0, 2.0),
        stddevs=(0.5, 0.5),
        effect_on_log_scale=0.02,
        threshold=21.0,
        by_unknowns=by_unknowns,
        name="anchor place",
        subject="A2",
        most=8.0,
    )
    (found,) = hidden_among([test])
    assert (found.words, found.threshold, found.num) == ("position of anchor A2", 21.0, 2)
    assert found.slope == pytest.approx(0.02 / np.sqrt(noncentrality(2)))
    assert found.most == pytest.approx(0.05 * 8.0)
    noticed = replace(test, hypothesis=replace(test.hypothesis, max_unnoticed=0.5))
    (found,) = hidden_among([noticed])
    assert found.most == pytest.approx(0.05 * 0.5)


def test_a_mistake_that_no_test_sees_has_no_slope() -> None:
    test = made_test(stddevs=(), effect_on_log_scale=np.inf, basis=np.zeros((9, 0)), threshold=np.inf, most=0.1)
    (found,) = hidden_among([test])
    assert (found.slope, found.num) == (np.inf, 0)


def test_mistakes_that_the_interval_allows_for_are_not_hidden_ones() -> None:
    of_interval = made_test(name="common bias", is_in_interval=True)
    assert hidden_among([of_interval]) == ()
    assert [each.words for each in hidden_among([of_interval, made_test(name="step"), of_interval])] == [
        "jump of all ranges"
    ]


def test_sizes_of_a_hidden_mistake_go_to_where_it_is_found_for_certain() -> None:
    """Half of those of 4 stddevs, the root of the threshold, are missed, and of those of 7.72 as few as bounds fail."""
    changes, missed = HiddenMistake("a step", 0.005, 16.0, 1, np.inf).sizes
    np.testing.assert_allclose(changes[[0, -1]], [0.0, 0.005 * (4 + stats.norm.isf(1e-4))])
    np.testing.assert_allclose(missed, stats.ncx2.cdf(16.0, 1, (changes / 0.005) ** 2), atol=1e-12)
    assert missed[0] == pytest.approx(stats.chi2.cdf(16.0, 1))
    assert missed[-1] == pytest.approx(1e-4)
    assert np.interp(0.02, changes, missed) == pytest.approx(0.5, abs=0.01)
    assert np.diff(changes).max() < 0.01 * 0.1


def test_the_more_numbers_a_mistake_has_the_easier_it_is_missed_at_a_given_threshold() -> None:
    changes, missed = HiddenMistake("anchor place", 0.005, 16.0, 3, np.inf).sizes
    np.testing.assert_allclose(missed[1:], stats.ncx2.cdf(16.0, 3, (changes[1:] / 0.005) ** 2))


def test_sizes_of_a_hidden_mistake_go_no_farther_than_people_would_notice() -> None:
    changes, missed = HiddenMistake("a step", 0.005, 16.0, 1, 0.03).sizes
    assert changes[-1] == pytest.approx(0.03)
    assert missed[-1] == pytest.approx(special.ndtr(-2.0))
    changes, missed = HiddenMistake("no effect", 0.0, 16.0, 1, 0.03).sizes
    assert changes.max() == 0.0
    changes, missed = HiddenMistake("unseen", np.inf, 16.0, 1, 0.03).sizes
    assert (changes.tolist(), missed.tolist()) == ([0.03], [1.0])


def lengths_of(*stddevs_m: float) -> LengthScale:
    """The scale by some lengths, whose errors move it by 10 %, -20 %, 30 %, ... for each metre."""
    num = len(stddevs_m)
    signs = np.array([1, -1, 1])[:num]
    return LengthScale(
        value=2.0,
        components={"tape": 0.01},
        rows=np.arange(num),
        is_kept=np.ones(num, dtype=bool),
        too_long_m=np.zeros(num),
        stddev_m=np.array(stddevs_m),
        redundancy=np.full(num, 0.5),
        threshold=np.linspace(10.0, 9.0 + num, num),
        by_metre=0.1 * signs * (1 + np.arange(num)),
    )


def assert_hidden(found: Sequence[HiddenMistake], *expected: tuple[str, float, float]) -> None:
    """Compare words, slope and threshold; all are of one number, which may have any size."""
    assert [(each.words, each.num, each.most) for each in found] == [(words, 1, np.inf) for words, *_ in expected]
    np.testing.assert_allclose([(each.slope, each.threshold) for each in found], [each[1:] for each in expected])


def test_an_error_of_a_length_hides_behind_the_noise_of_its_test() -> None:
    assert_hidden(
        hidden_lengths(lengths_of(0.02, 0.05), None), ("length", 0.1 * 0.02, 10.0), ("length", 0.2 * 0.05, 11.0)
    )


def test_a_length_that_nothing_checks_may_hide_any_error_unless_all_are_compared_with_another_kind() -> None:
    lengths = lengths_of(0.02, np.inf, 0.05)
    checked = ("length", 0.1 * 0.02, 10.0), ("length", 0.3 * 0.05, 12.0)
    assert_hidden(hidden_lengths(lengths, None), *checked, ("length", np.inf, np.inf))
    together = ("lengths", 0.015, float(stats.chi2.isf(0.02, 1)))
    assert_hidden(hidden_lengths(lengths, 0.015), *checked, together)


def test_the_bound_is_that_of_the_worst_mistake() -> None:
    small, large = (HiddenMistake(name, np.inf, 15.0, 0, most) for name, most in (("small", 0.02), ("large", 0.03)))
    for hidden in ([small, large], [large, small]):
        bound, limited_by = scale_bound(ONE_PERCENT, hidden)
        assert limited_by == "large"
        assert bound == pytest.approx(0.03 - 0.01 * special.ndtri(RISK), rel=1e-6)
    # A mistake that hardly moves the scale leaves the bound to chance.
    nothing = HiddenMistake("hardly any", 1e-6, 15.0, 1, np.inf)
    assert scale_bound(ONE_PERCENT, [nothing]) == scale_bound(ONE_PERCENT, [])


def test_a_change_that_is_hidden_both_ways_exceeds_the_bound_on_either_side() -> None:
    """Beyond a bound of 2 stddevs, a change of 1 leaves a normal number 1 above and 3 below."""
    found = _beyond(ONE_PERCENT, np.array([0.0, 0.01, -0.01]), 0.02)
    np.testing.assert_allclose(found, [2 * stats.norm.sf(2), *[stats.norm.sf(1) + stats.norm.sf(3)] * 2])
    exact = ScaleUncertainty(0.0, {})
    np.testing.assert_array_equal(_beyond(exact, np.array([0.0, 0.03]), 0.02), [0.0, 1.0])

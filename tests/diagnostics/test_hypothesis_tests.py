"""Tests of hypotheses: their statistic, their power, and the rate of false alarms of all together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy import stats
from tests.studies.erring_surveys import SITES, run, surveyed

from rangesfm.arrays import Array
from rangesfm.diagnostics import hypothesis_tests
from rangesfm.diagnostics.catalogue import STANDING
from rangesfm.diagnostics.hypothesis import Correction, Effect, Hypothesis
from rangesfm.diagnostics.hypothesis_tests import Factorization, finite, overlap, row_of, row_of_mistake
from rangesfm.diagnostics.linearized import Linearized
from rangesfm.diagnostics.mistakes import find_mistakes
from rangesfm.diagnostics.timed_hypotheses import SCANNING
from rangesfm.scale.linear_map import FALSE_ALARM_RATE, EstimatedMistake, noncentrality


@pytest.fixture(scope="module")
def problem() -> Linearized:
    """The linearized problem of a clean survey, with the noise that was learnt."""
    on_map = run(surveyed(SITES[2], 3), 3).on_map
    assert on_map is not None
    return find_mistakes(on_map).problem


def hypotheses(problem: Linearized) -> list[Hypothesis]:
    return [each for of_kind in (*STANDING, *SCANNING) for each in of_kind(problem)]


def without_noise(problem: Linearized) -> Linearized:
    return replace(
        problem,
        residual_m=np.zeros_like(problem.residual_m),
        prior_residual=np.zeros_like(problem.prior_residual),
    )


def test_a_mistake_without_noise_is_estimated_exactly(problem: Linearized) -> None:
    silent = without_noise(problem)
    for each in hypotheses(problem):
        size = np.arange(1.0, each.num + 1)
        made = replace(silent, residual_m=each.effect.columns @ size, prior_residual=each.effect.priors @ size)
        [test] = Factorization(made).test([each], 0)
        if np.isfinite(test.smallest_detectable):
            np.testing.assert_allclose(test.sizes, size, rtol=1e-5)


def test_the_smallest_detectable_mistake_raises_the_statistic_as_it_must(problem: Linearized) -> None:
    silent = without_noise(problem)
    for each in hypotheses(problem):
        [test] = Factorization(silent).test([each], 0)
        if each.num == 1 and np.isfinite(test.smallest_detectable):
            size = np.array([test.smallest_detectable])
            made = replace(silent, residual_m=each.effect.columns @ size, prior_residual=each.effect.priors @ size)
            [found] = Factorization(made).test([each], 0)
            assert found.statistic == pytest.approx(noncentrality(1), rel=1e-4)
            moved = Factorization(made).step[0]
            assert abs(moved) == pytest.approx(found.effect_on_log_scale, rel=1e-3, abs=1e-9)


def test_the_size_of_one_number_keeps_its_sign_and_that_of_more_is_their_length(problem: Linearized) -> None:
    silent = without_noise(problem)
    for each in hypotheses(problem):
        direction = -np.arange(1.0, each.num + 1) / np.linalg.norm(np.arange(1.0, each.num + 1))
        for share in (0.5, 1.5):
            size = share * each.most * direction
            made = replace(silent, residual_m=each.effect.columns @ size, prior_residual=each.effect.priors @ size)
            [test] = Factorization(made).test([each], 0)
            if np.isfinite(test.smallest_detectable):
                told = row_of(test).size
                signed = -share * each.most if each.num == 1 else share * each.most
                # Impossible sizes are not reported.
                assert told == (pytest.approx(signed, rel=1e-4) if share < 1 else None)


def test_hypotheses_that_explain_nearly_the_same_overlap_and_others_do_not(problem: Linearized) -> None:
    of_key = {each.key: each for each in hypotheses(problem)}
    bias, drift = of_key["common bias", ""], of_key["radio drift", ""]
    effect = Effect.of_sum([bias.effect, Effect(0.1 * drift.effect.columns, 0.1 * drift.effect.priors)])
    tests = Factorization(without_noise(problem)).test([bias, replace(bias, effect=effect), drift], 0)
    assert overlap(tests[0], tests[0]) == pytest.approx(1.0)
    assert 0.9 < overlap(tests[0], tests[1]) < 1.0
    assert overlap(tests[0], tests[2]) < 0.9


def test_the_effect_of_a_large_mistake_is_that_at_its_size(problem: Linearized) -> None:
    bias = next(each for each in hypotheses(problem) if each.key == ("common bias", ""))
    num = len(problem.on_map.problem.range_m)
    squared = replace(bias, correction=lambda size: Correction(longer_m=np.full(num, size[0] ** 2)))
    found = squared.at_size(problem, np.array([3.0]))
    np.testing.assert_allclose(found.effect.columns, 6 * bias.effect.columns, rtol=1e-3)
    turned = replace(bias, correction=lambda _: Correction(tag_moves_m={}))
    assert turned.at_size(problem, np.array([3.0])) is turned  # its effect is found on the map that it moves


def test_baardas_number() -> None:
    assert np.sqrt(noncentrality(1)) == pytest.approx(4.13, abs=0.005)
    assert stats.ncx2.sf(stats.chi2.isf(0.001, 3), 3, noncentrality(3)) == pytest.approx(0.8, abs=1e-6)


def test_all_together_alarm_for_nothing_as_seldom_as_they_say(
    problem: Linearized, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng, num = np.random.default_rng(1), 150
    factor, tried = np.linalg.cholesky(problem.errors.covariance_m2), hypotheses(problem)
    thresholds = np.array([test.threshold for test in Factorization(problem).test(tried, 0)])
    # The thresholds do not depend on the measurements, and they are most of the work.
    monkeypatch.setattr(hypothesis_tests, "_thresholds", lambda *_: thresholds)
    alarms = 0
    for _ in range(num):
        drawn = replace(
            problem,
            residual_m=factor @ rng.standard_normal(len(factor)),
            prior_residual=rng.standard_normal(problem.num_priors),
        )
        tests = Factorization(drawn).test(tried, 0)
        alarms += any(test.statistic > most for test, most in zip(tests, thresholds, strict=True))
    assert stats.binom.sf(alarms - 1, num, FALSE_ALARM_RATE) > 0.001


def of_columns(columns: Array, *, num_priors: int = 0, **attributes: Any) -> Hypothesis:
    """A mistake that changes the residuals by these (c, k) columns."""
    told = {
        "name": "bias",
        "words": lambda size: f"it is {size[0]:+.2f} m",
        "remedy": "measure",
        "correction": lambda _: Correction(),
        "most": np.inf,
        "effect": Effect(columns, np.zeros((num_priors, columns.shape[1]))),
    }
    return Hypothesis(**{**told, **attributes})


def made_test(
    *,
    sizes: Sequence[float] = (1.0,),
    stddevs: Sequence[float] = (0.25,),
    statistic: float = 16.0,
    threshold: float = 10.0,
    by_unknowns: Array | None = None,
    basis: Array | None = None,
    smallest_detectable: float = 0.8,
    effect_on_log_scale: float = 0.02,
    effect_on_place_m: float = 0.3,
    redundancy: float = 0.7,
    **of_hypothesis: Any,
) -> hypothesis_tests.Test:
    """A result of a test as no problem gave it; its hypothesis has no effect on anything."""
    num = len(stddevs)
    return hypothesis_tests.Test(
        sizes=np.array(sizes),
        root=np.diag(stddevs) if num else np.zeros((len(sizes), 0)),
        statistic=statistic,
        by_unknowns=np.zeros((7, len(sizes))) if by_unknowns is None else by_unknowns,
        basis=np.eye(9, num) if basis is None else basis,
        smallest_detectable=smallest_detectable,
        effect_on_log_scale=effect_on_log_scale,
        hypothesis=of_columns(np.zeros((9, len(sizes))), **of_hypothesis),
        threshold=threshold,
        redundancy=redundancy,
        effect_on_place_m=effect_on_place_m,
    )


NUM_BINS, NUM_PRIORS, NUM_UNKNOWNS = 12, 2, 3


def small_problem(seed: int = 0) -> Any:
    """A problem with numbers drawn at random."""
    rng = np.random.default_rng(seed)
    factor = rng.standard_normal((NUM_BINS, NUM_BINS))
    return SimpleNamespace(
        errors=SimpleNamespace(covariance_m2=factor @ factor.T + np.eye(NUM_BINS), unlikeliness=4.5),
        design=rng.standard_normal((NUM_BINS, NUM_UNKNOWNS)),
        residual_m=3 * rng.standard_normal(NUM_BINS),
        prior_design=rng.standard_normal((NUM_PRIORS, NUM_UNKNOWNS)),
        prior_residual=rng.standard_normal(NUM_PRIORS),
        place=rng.standard_normal((NUM_BINS, 3, NUM_UNKNOWNS)),
        columns=SimpleNamespace(num=NUM_UNKNOWNS),
    )


def in_stddevs(problem: Any, observations: Array, priors: Array | None = None) -> Array:
    """Observations and priors divided by their standard deviations, by another root of the covariance."""
    values, vectors = np.linalg.eigh(problem.errors.covariance_m2)
    whitened = vectors @ np.diag(values**-0.5) @ vectors.T @ observations
    return np.concatenate([whitened, np.zeros((NUM_PRIORS, *observations.shape[1:])) if priors is None else priors])


def best_step(problem: Any, residual_m: Array) -> tuple[Array, float]:
    """Return the likeliest step and the sum of squares that it leaves, by least squares."""
    by = in_stddevs(problem, problem.design, problem.prior_design)
    off = in_stddevs(problem, residual_m, problem.prior_residual)
    step, squares, *_ = np.linalg.lstsq(by, -off, rcond=None)
    return np.asarray(step, np.float64), float(squares[0])


def test_the_deviance_is_that_of_a_normal_density_and_of_the_errors_that_were_learnt() -> None:
    problem = small_problem()
    squares = best_step(problem, problem.residual_m)[1]
    expected = squares + np.linalg.slogdet(problem.errors.covariance_m2)[1] + 4.5
    solved = Factorization(problem)
    assert solved.deviance() == pytest.approx(expected)
    assert solved.deviance(made_test(statistic=2.5)) == pytest.approx(expected - 2.5)


def test_a_mistake_takes_from_the_deviance_what_it_explains_and_moves_the_map_back() -> None:
    problem = small_problem()
    columns = np.random.default_rng(1).standard_normal((NUM_BINS, 2))
    solved, mistake = Factorization(problem), of_columns(columns, num_priors=NUM_PRIORS)
    [found] = solved.estimates([mistake])
    step, squares = best_step(problem, problem.residual_m - columns @ found.sizes)
    np.testing.assert_allclose(solved.step_with(mistake.effect, found.sizes), step)
    assert solved.deviance() - solved.deviance(found) == pytest.approx(
        best_step(problem, problem.residual_m)[1] - squares
    )
    # Any other size explains less.
    for other in found.sizes + 0.1 * np.array([[1, 0], [-1, 0], [0, 1], [0, -1]]):
        assert best_step(problem, problem.residual_m - columns @ other)[1] > squares


def test_hypotheses_that_are_tested_together_have_the_results_that_each_has_alone() -> None:
    rng, solved = np.random.default_rng(2), Factorization(small_problem())
    several = [of_columns(rng.standard_normal((NUM_BINS, num)), num_priors=NUM_PRIORS) for num in (2, 1, 3)]
    for each, found in zip(several, solved.estimates(several), strict=True):
        [alone] = solved.estimates([each])
        assert found.hypothesis is each
        np.testing.assert_allclose(found.sizes, alone.sizes)
        assert found.threshold == np.inf
        for name in ("statistic", "redundancy", "effect_on_place_m", "effect_on_log_scale", "smallest_detectable"):
            assert getattr(found, name) == pytest.approx(getattr(alone, name))


def test_the_effect_on_the_place_is_the_displacement_by_the_worst_mistake_that_is_just_found() -> None:
    """The largest root mean square along the path, over mistakes that raise the statistic as much."""
    problem = small_problem()
    columns = np.random.default_rng(3).standard_normal((NUM_BINS, 2))
    solved = Factorization(problem)
    [found] = solved.estimates([of_columns(columns, num_priors=NUM_PRIORS)])
    turns = np.linspace(0, np.pi, 101)
    displacements_m = []
    for direction in np.column_stack([np.cos(turns), np.sin(turns)]):
        size = np.sqrt(noncentrality(2)) * found.root @ direction
        moved = best_step(problem, problem.residual_m + columns @ size)[0] - best_step(problem, problem.residual_m)[0]
        displacements_m.append(np.sqrt(np.mean(np.sum((problem.place @ moved) ** 2, axis=1))))
    assert found.effect_on_place_m == pytest.approx(max(displacements_m), rel=1e-3)


def test_of_a_mistake_that_the_unknowns_absorb_nothing_is_known() -> None:
    problem = small_problem()
    absorbed = of_columns(problem.design[:, :1], num_priors=NUM_PRIORS, most=50.0)
    problem.prior_design[:, 0] = 0.0
    [found] = Factorization(problem).test([absorbed], 0)
    assert (found.num, found.redundancy, found.effect_on_place_m, found.threshold) == (0, 0.0, np.inf, np.inf)
    assert not found.is_checked


def test_redundancy_is_that_of_the_worst_direction() -> None:
    """Two directions of which a half and a tenth of the squared length are left, in coordinates that mix them."""
    mixed = np.array([[1.0, 2.0], [-0.5, 3.0]])
    seen = np.eye(6, 2) @ mixed
    left = np.vstack([np.diag([np.sqrt(0.5), np.sqrt(0.1)]), np.zeros((5, 2))]) @ mixed
    assert hypothesis_tests._redundancy(left, seen) == pytest.approx(0.1)
    assert hypothesis_tests._redundancy(left[:, :1], seen[:, :1]) == pytest.approx((0.5 + 0.1 * 0.25) / 1.25)
    assert hypothesis_tests._redundancy(seen, seen) == pytest.approx(1.0)
    assert hypothesis_tests._redundancy(2 * seen, seen) == 1.0
    assert hypothesis_tests._redundancy(0 * seen, seen) == 0.0


def test_a_mistake_without_an_effect_in_some_direction_is_not_checked_at_all() -> None:
    """Below a squared length of 1e-7 of the longest, an effect is rounding."""
    left = np.eye(5, 2)
    assert hypothesis_tests._redundancy(left, np.diag([1.0, 2e-4])) == 0.0
    assert hypothesis_tests._redundancy(left, np.diag([1.0, 4e-4])) == pytest.approx(1.0)
    assert hypothesis_tests._redundancy(left, np.zeros((5, 2))) == 0.0


def test_the_effect_on_ranges_of_a_known_map_may_be_another_than_on_their_residuals() -> None:
    problem = small_problem()
    rng = np.random.default_rng(4)
    mistake = of_columns(rng.standard_normal((NUM_BINS, 1)), num_priors=NUM_PRIORS)
    weak = replace(mistake, seen=2 * mistake.effect.columns)
    alone, doubled = Factorization(problem).estimates([mistake, weak])
    assert doubled.redundancy == pytest.approx(alone.redundancy / 4)
    whitened = in_stddevs(problem, mistake.effect.columns)
    by = in_stddevs(problem, problem.design, problem.prior_design)
    left = whitened - by @ np.linalg.lstsq(by, whitened, rcond=None)[0]
    assert alone.redundancy == pytest.approx(float(np.sum(left**2) / np.sum(whitened[:NUM_BINS] ** 2)))


def bases_of(nums: Sequence[int], together: int = 0) -> list[Array]:
    """Orthonormal bases of independent tests; the first ``together`` of them are one test that is made again."""
    unit, ends = np.eye(40), np.cumsum(nums)
    bases = [unit[:, end - num : end] for num, end in zip(nums, ends, strict=True)]
    return [bases[0]] * together + bases[together:]


@pytest.mark.parametrize(
    ("nums", "together", "num_independent"),
    [([1], 0, 1), ([3], 0, 1), ([2] * 8, 0, 8), ([3, 0, 1, 2, 1], 0, 4), ([2] * 8, 8, 1)],
)
def test_thresholds_are_exceeded_in_2_percent_of_the_surveys_by_any_of_the_tests(
    nums: list[int], together: int, num_independent: int
) -> None:
    """The right threshold is exceeded by 20 +- 4.5 of 1000 draws."""
    found = hypothesis_tests._thresholds(bases_of(nums, together), np.array(nums), 0)
    p_values = [stats.chi2.sf(most, num) for most, num in zip(found, nums, strict=True) if num]
    np.testing.assert_allclose(p_values, p_values[0])  # all tests are as significant
    rate = 1 - (1 - p_values[0]) ** num_independent
    assert 0.01 < rate < 0.035
    assert all(most == np.inf for most, num in zip(found, nums, strict=True) if not num)


def test_thresholds_depend_on_the_seed_alone_by_chance() -> None:
    bases, nums = bases_of([2, 1]), np.array([2, 1])
    np.testing.assert_array_equal(
        hypothesis_tests._thresholds(bases, nums, 5), hypothesis_tests._thresholds(bases, nums, 5)
    )
    assert not np.allclose(hypothesis_tests._thresholds(bases, nums, 5), hypothesis_tests._thresholds(bases, nums, 6))


def test_overlap_is_the_share_of_the_smaller_hypothesis_that_lies_in_the_other() -> None:
    unit = np.eye(9)
    turned = np.array([[0.6], [0.0], [0.8], *[[0.0]] * 6])

    def of(basis: Array) -> hypothesis_tests.Test:
        return made_test(stddevs=[1.0] * basis.shape[1], basis=basis)

    assert overlap(of(unit[:, :1]), of(unit[:, :3])) == pytest.approx(1.0)
    assert overlap(of(unit[:, :3]), of(unit[:, :1])) == pytest.approx(1.0)
    assert overlap(of(unit[:, :2]), of(unit[:, 2:4])) == pytest.approx(0.0)
    assert overlap(of(unit[:, :1]), of(turned)) == pytest.approx(0.6)
    assert overlap(of(unit[:, :2]), of(unit[:, 1:4])) == pytest.approx(np.sqrt(0.5))
    assert overlap(of(unit[:, :0]), of(unit[:, :1])) == 0.0
    assert overlap(of(unit[:, :1]), of(unit[:, :0])) == 0.0


def test_a_test_is_rejected_if_its_size_is_possible_and_its_statistic_above_the_threshold() -> None:
    assert made_test(statistic=10.1).is_rejected
    assert not made_test(statistic=9.9).is_rejected
    assert not made_test(statistic=10.0).is_rejected
    impossible = made_test(sizes=(3.0, 4.1), stddevs=(1.0, 1.0), most=5.0)
    assert (impossible.is_possible, impossible.is_rejected) == (False, False)
    assert made_test(sizes=(3.0, 4.0), stddevs=(1.0, 1.0), most=5.01).is_rejected
    assert made_test(smallest_detectable=5.0, most=5.0).is_checked
    assert not made_test(smallest_detectable=5.1, most=5.0).is_checked
    by_unknowns = np.zeros((7, 2))
    by_unknowns[:2] = [[0.3, -0.4], [9.0, 9.0]]
    assert made_test(sizes=(1.0, 1.0), stddevs=(1, 1), by_unknowns=by_unknowns).log_scale_by_unit == pytest.approx(0.5)


def test_a_row_has_the_numbers_of_its_test() -> None:
    row = row_of(made_test(sizes=(-1.5,), subject="A2", unit="s"))
    assert (row.name, row.subject, row.words, row.remedy) == ("bias", "A2", "it is -1.50 m", "measure")
    assert (row.statistic, row.threshold, row.unit, row.rejected) == (16.0, 10.0, "s", True)
    assert (row.size, row.stddev, row.smallest_detectable) == (-1.5, 0.25, 0.8)
    assert (row.effect_on_scale, row.effect_on_place_m, row.redundancy, row.is_checked) == (0.02, 0.3, 0.7, True)
    vector = row_of(made_test(sizes=(-3.0, 4.0), stddevs=(0.6, 0.8)))
    assert vector.size == pytest.approx(5.0)
    assert vector.stddev == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("unit", "words"),
    [
        ("m", "no bias A2 that can happen (1.2 m at most) explains the ranges"),
        ("1", "no bias A2 that can happen (1.2 at most) explains the ranges"),
    ],
)
def test_a_row_of_an_impossible_size_says_so_and_shows_none(unit: str, words: str) -> None:
    row = row_of(made_test(sizes=(-1.5,), subject="A2", most=1.234, unit=unit))
    assert (row.words, row.statistic, row.size, row.stddev) == (words, 0.0, None, None)
    assert (row.threshold, row.smallest_detectable) == (10.0, 0.8)
    assert not row.rejected


def test_what_is_unlimited_or_unknown_is_none_in_a_row() -> None:
    hidden = made_test(
        sizes=(1.0,),
        stddevs=(),
        statistic=0.0,
        threshold=np.inf,
        smallest_detectable=np.inf,
        effect_on_log_scale=np.inf,
        effect_on_place_m=np.inf,
    )
    row = row_of(replace(hidden, basis=np.zeros((9, 0))))
    assert (row.size, row.stddev, row.smallest_detectable) == (None, None, None)
    assert (row.effect_on_scale, row.effect_on_place_m) == (None, None)
    assert row.threshold == 0.0
    assert not row.rejected
    assert (finite(np.inf), finite(-np.inf), finite(np.nan), finite(0.0)) == (None, None, None, 0.0)


def test_a_row_of_a_mistake_is_in_metres_unless_it_is_said() -> None:
    found = EstimatedMistake(np.array([2.0]), np.array([[0.5]]), 16.0, np.zeros((7, 1)), np.eye(9, 1), 1.0, 0.1)
    row = row_of_mistake("arm", "t1", found, 11.0, "words", "remedy")
    assert (row.unit, row.size, row.stddev, row.statistic, row.threshold) == ("m", 2.0, 0.5, 16.0, 11.0)
    assert (row.redundancy, row.is_checked, row.effect_on_place_m) == (None, None, None)
    assert not replace(row, statistic=11.0).rejected

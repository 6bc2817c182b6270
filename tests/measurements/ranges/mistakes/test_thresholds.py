"""Tests of mistakes: their statistic, their power, and the rate of false alarms of all together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from tests.simulated.runs import run
from tests.simulated.surveys import SITES, surveyed

from rangesfm.arrays import Array
from rangesfm.measurements.mistakes import FALSE_ALARM_RATE, Correction, Mistake, noncentrality
from rangesfm.measurements.ranges.mistakes import thresholds as module
from rangesfm.measurements.ranges.mistakes.catalogue import STANDING
from rangesfm.measurements.ranges.mistakes.effects import at_size
from rangesfm.measurements.ranges.mistakes.find_mistakes import find_mistakes
from rangesfm.measurements.ranges.mistakes.linearized import Linearized
from rangesfm.measurements.ranges.mistakes.thresholds import judged, overlap
from rangesfm.measurements.ranges.mistakes.timed_mistakes import SCANNING


@pytest.fixture(scope="module")
def problem() -> Linearized:
    """The linearized problem of a clean survey, with the noise that was learnt."""
    on_map = run(surveyed(SITES[2], 3), 3).on_map
    assert on_map is not None
    return find_mistakes(on_map).problem


def possible_mistakes(problem: Linearized) -> list[Mistake]:
    return [each for of_kind in (*STANDING, *SCANNING) for each in of_kind(problem)]


def with_mistake(problem: Linearized, mistake: Array) -> Linearized:
    """The problem without noise, with the effect of a mistake (c + r,) on bins and priors, or (c,) on bins alone."""
    num, off = len(problem.bins), np.zeros(len(problem.residual))
    off[: len(mistake)] = mistake
    return replace(problem, residual_m=off[:num], prior_residual=off[num:])


def without_noise(problem: Linearized) -> Linearized:
    return with_mistake(problem, np.zeros(len(problem.bins) + len(problem.prior_residual)))


def test_a_mistake_without_noise_is_estimated_exactly(problem: Linearized) -> None:
    silent = without_noise(problem)
    for each in possible_mistakes(problem):
        size = np.arange(1.0, each.num + 1)
        made = with_mistake(silent, each.columns @ size)
        [test] = judged(made, [each], 0)
        if np.isfinite(test.smallest_detectable):
            np.testing.assert_allclose(test.sizes, size, rtol=1e-5)


def test_the_smallest_detectable_mistake_raises_the_statistic_as_it_must(problem: Linearized) -> None:
    silent = without_noise(problem)
    for each in possible_mistakes(problem):
        [test] = judged(silent, [each], 0)
        if each.num == 1 and np.isfinite(test.smallest_detectable):
            size = np.array([test.smallest_detectable])
            made = with_mistake(silent, each.columns @ size)
            [found] = judged(made, [each], 0)
            assert found.statistic == pytest.approx(noncentrality(1), rel=1e-4)
            moved = made.solution.step[0]
            assert abs(moved) == pytest.approx(found.effect_on_log_scale, rel=1e-3, abs=1e-9)


def test_the_size_of_one_number_keeps_its_sign_and_that_of_more_is_their_length(problem: Linearized) -> None:
    silent = without_noise(problem)
    for each in possible_mistakes(problem):
        direction = -np.arange(1.0, each.num + 1) / np.linalg.norm(np.arange(1.0, each.num + 1))
        for share in (0.5, 1.5):
            size = share * each.most * direction
            made = with_mistake(silent, each.columns @ size)
            [test] = judged(made, [each], 0)
            if np.isfinite(test.smallest_detectable):
                told = test.row.size
                signed = -share * each.most if each.num == 1 else share * each.most
                # Impossible sizes are not reported.
                assert told == pytest.approx(signed if share < 1 else np.nan, rel=1e-4, nan_ok=True)


def test_mistakes_that_explain_nearly_the_same_overlap_and_others_do_not(problem: Linearized) -> None:
    of_key = {each.key: each for each in possible_mistakes(problem)}
    bias, drift = of_key["common bias", ""], of_key["radio drift", ""]
    both = replace(bias, columns=bias.columns + 0.1 * drift.columns)
    tests = judged(without_noise(problem), [bias, both, drift], 0)
    assert overlap(tests[0], tests[0]) == pytest.approx(1.0)
    assert 0.9 < overlap(tests[0], tests[1]) < 1.0
    assert overlap(tests[0], tests[2]) < 0.9


def test_the_effect_of_a_large_mistake_is_that_at_its_size(problem: Linearized) -> None:
    bias = next(each for each in possible_mistakes(problem) if each.key == ("common bias", ""))
    num = len(problem.on_map.problem.range_m)
    squared = replace(bias, correction=lambda size: Correction(longer_m=np.full(num, size[0] ** 2)))
    found = at_size(squared, problem, np.array([3.0]))
    np.testing.assert_allclose(found.columns, 6 * bias.columns, rtol=1e-3)
    turned = replace(bias, correction=lambda _: Correction(tag_moves_m={}))
    assert at_size(turned, problem, np.array([3.0])) is turned  # its effect is found on the map that it moves


def test_baardas_number() -> None:
    assert np.sqrt(noncentrality(1)) == pytest.approx(4.13, abs=0.005)
    assert stats.ncx2.sf(stats.chi2.isf(0.001, 3), 3, noncentrality(3)) == pytest.approx(0.8, abs=1e-6)


def test_all_together_alarm_for_nothing_as_seldom_as_they_say(
    problem: Linearized, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng, num = np.random.default_rng(1), 150
    factor, tried = np.linalg.cholesky(problem.noise.covariance_m2), possible_mistakes(problem)
    thresholds = np.array([test.threshold for test in judged(problem, tried, 0)])
    # The thresholds do not depend on the measurements, and they are most of the work.
    monkeypatch.setattr(module, "_thresholds", lambda *_: thresholds)
    alarms = 0
    for _ in range(num):
        num_priors = len(problem.prior_residual)
        off = np.append(factor @ rng.standard_normal(len(factor)), rng.standard_normal(num_priors))
        drawn = with_mistake(problem, off)
        tests = judged(drawn, tried, 0)
        alarms += any(test.statistic > most for test, most in zip(tests, thresholds, strict=True))
    assert stats.binom.sf(alarms - 1, num, FALSE_ALARM_RATE) > 0.001


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
    found = module._thresholds(bases_of(nums, together), np.array(nums), 0)
    p_values = [stats.chi2.sf(most, num) for most, num in zip(found, nums, strict=True) if num]
    np.testing.assert_allclose(p_values, p_values[0])  # all tests are as significant
    rate = 1 - (1 - p_values[0]) ** num_independent
    assert 0.01 < rate < 0.035
    assert all(most == np.inf for most, num in zip(found, nums, strict=True) if not num)

"""Seconds of erring ranges are no mistake, and hide none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tests.diagnostics.test_linearized import small_map
from tests.known import known
from tests.studies.erring_surveys import SITES, Given, run, surveyed

from rangesfm.diagnostics.error_bursts import Burst, likeliest_burst, without
from rangesfm.diagnostics.hypothesis_tests import Factorization
from rangesfm.diagnostics.linearized import Linearized, linearized

DRONE = SITES[2]
SEED = 3
# Two seconds in the path's last tenth, where a clock or a length that jumps would show in few other ranges.
BEGIN_S, END_S = 91.0, 93.0


def with_burst(longer_m: float) -> Given:
    given = surveyed(DRONE, SEED)
    given.range_m = given.range_m + longer_m * ((given.time_s > BEGIN_S) & (given.time_s < END_S))
    return given


@pytest.fixture(scope="module")
def problem() -> Linearized:
    return linearized(known(run(with_burst(0.6), SEED).on_map)).with_learnt_errors()


@pytest.mark.parametrize("longer_m", [0.6, -0.6])
def test_ranges_that_err_for_two_seconds_are_no_mistake(longer_m: float) -> None:
    found = known(run(with_burst(longer_m), SEED).diagnosis)
    assert found.causes == ()
    assert not any(test.rejected for test in found.tests)


def test_a_mistake_beside_a_burst_is_found() -> None:
    given = with_burst(0.6)
    given.time_offset_s = 0.15
    found = known(run(given, SEED).diagnosis)
    assert [cause.name for cause in found.causes] == ["clock offset"]


def test_the_burst_is_found_where_it_was(problem: Linearized) -> None:
    burst = likeliest_burst(Factorization(problem))
    assert burst.statistic > burst.threshold
    time_s = problem.bins.time_s[burst.bins]
    assert BEGIN_S - 1.0 < time_s.min() <= time_s.max() < END_S + 1.0


def test_ranges_without_a_burst_show_none() -> None:
    clean = linearized(known(run(surveyed(DRONE, SEED), SEED).on_map)).with_learnt_errors()
    burst = likeliest_burst(Factorization(clean))
    assert burst.statistic < burst.threshold


def test_what_is_left_out_says_nothing(problem: Linearized) -> None:
    burst = likeliest_burst(Factorization(problem))
    left_out = without(problem, burst).with_usual_errors()
    moved_m = left_out.residual_m.copy()
    moved_m[burst.bins] += 1.0
    moved = replace(left_out, residual_m=moved_m)
    np.testing.assert_allclose(Factorization(moved).step, Factorization(left_out).step, atol=2e-3)


@pytest.fixture(scope="module")
def of_small() -> Linearized:
    """Two ranges of each of three anchors are a bin, each half a second."""
    return linearized(small_map())


def longer(problem: Linearized, bins: list[int], by_m: float) -> Linearized:
    residual_m = problem.residual_m.copy()
    residual_m[bins] -= by_m
    return replace(problem, residual_m=residual_m)


def test_bins_of_a_burst_that_is_left_out_are_off_by_as_much_as_a_range_can(of_small: Linearized) -> None:
    first = without(of_small, Burst(np.array([3, 4]), 0.0, 0.0))
    both = without(first, Burst(np.array([4, 7]), 0.0, 0.0))
    of_one = float(np.max(of_small.on_map.problem.range_m)) ** 2
    for problem, expected in ((first, {3: of_one, 4: of_one}), (both, {3: of_one, 4: 2 * of_one, 7: of_one})):
        variances = np.array([expected.get(k, 0.0) for k in range(60)])
        np.testing.assert_allclose(problem.expected.known["bursts"], np.diag(variances))
        assert set(problem.expected.known) == {"bursts", *of_small.expected.known}
    assert "bursts" not in of_small.expected.known
    # What is left out says nothing of the map.
    still, moved = (Factorization(longer(first, [3, 4], by_m).with_usual_errors()).step for by_m in (0.0, 1.0))
    np.testing.assert_allclose(moved, still, atol=2e-3)

"""Seconds of erring ranges are no mistake, and hide none."""

from __future__ import annotations

import pytest
from tests.known import known
from tests.simulated.runs import run
from tests.simulated.surveys import SITES, MadeSurvey, surveyed

from rangesfm.measurements.ranges.mistakes.error_bursts import likeliest_burst
from rangesfm.measurements.ranges.mistakes.hypothesis_tests import Factorization
from rangesfm.measurements.ranges.mistakes.linearized import Linearized, linearized

DRONE = SITES[2]
SEED = 3
# Two seconds in the path's last tenth, where a clock or a length that jumps would show in few other ranges.
BEGIN_S, END_S = 91.0, 93.0


def with_burst(longer_m: float) -> MadeSurvey:
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

"""Seconds of erring ranges are no mistake, and hide none."""

from __future__ import annotations

import numpy as np
import pytest
from tests.known import known
from tests.simulated.runs import run
from tests.simulated.surveys import SITES, MadeSurvey, surveyed

from rangesfm.arrays import Array
from rangesfm.measurements.ranges.errors.components import BURSTS
from rangesfm.measurements.ranges.mistakes.catalogue import STANDING
from rangesfm.measurements.ranges.mistakes.error_bursts import without_bursts
from rangesfm.measurements.ranges.mistakes.linearized import linearized

DRONE = SITES[2]
SEED = 3
# Two seconds in the path's last tenth, where a clock or a length that jumps would show in few other ranges.
BEGIN_S, END_S = 91.0, 93.0


def with_burst(longer_m: float) -> MadeSurvey:
    given = surveyed(DRONE, SEED)
    given.range_m = given.range_m + longer_m * ((given.time_s > BEGIN_S) & (given.time_s < END_S))
    return given


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


def times_left_out_s(survey: MadeSurvey) -> Array:
    problem = linearized(known(run(survey, SEED).on_map))
    mistakes = [each for of_kind in STANDING for each in of_kind(problem)]
    left = without_bursts(problem, mistakes, mistakes)
    bursts = [np.diag(each.alike) for each in left.components if each.name == BURSTS]
    return np.asarray(problem.bins.time_s[np.sum([*bursts, np.zeros(len(problem.bins))], axis=0) > 0])


def test_the_burst_is_left_out_where_it_was() -> None:
    time_s = times_left_out_s(with_burst(0.6))
    assert len(time_s)
    assert BEGIN_S - 1.0 < time_s.min() <= time_s.max() < END_S + 1.0


def test_of_ranges_without_a_burst_none_is_left_out() -> None:
    assert not len(times_left_out_s(surveyed(DRONE, SEED)))

"""A solver that has come to rest is distinguished from one that cannot take the steps it needs."""

from __future__ import annotations

import pytest
from tests.refine.test_bundle_adjustment import orbit

from rangesfm.ceres import Step
from rangesfm.refine.bundle_adjustment import ConvergenceMonitor

FREE, TIMID = 1e10, 1e2


def after(*steps: Step) -> ConvergenceMonitor:
    """Return the state after these steps on a map that does not move."""
    monitor = ConvergenceMonitor(orbit(), residual_stddev=0.5, tolerance_m=1e-3)
    for step in steps:
        monitor.is_over(step)
    return monitor


def kept(radius: float, gain: float) -> Step:
    return Step(True, radius, cost=1e4, gain=gain, expected_gain=gain)


def refused(radius: float, expected_gain: float) -> Step:
    return Step(False, radius, cost=1e12, gain=-1e12, expected_gain=expected_gain)


def test_free_steps_that_gain_nothing_mean_convergence() -> None:
    found = after(kept(FREE, 1e-6))
    assert found.is_still
    assert not found.is_stuck


def test_what_free_steps_promise_and_timid_ones_do_not_reach_is_none() -> None:
    found = after(refused(FREE, 250.0), refused(1e6, 250.0), kept(TIMID, 1e-6))
    assert not found.is_still
    assert found.is_stuck


@pytest.mark.parametrize(("gain", "is_stuck"), [(249.9, False), (249.0, True)])
def test_smaller_steps_may_get_there(gain: float, is_stuck: bool) -> None:
    """A cost of up to half a squared stddev (here 0.125) may remain."""
    assert after(refused(FREE, 250.0), kept(TIMID, gain)).is_stuck == is_stuck


def test_rounding_in_a_map_without_noise_is_no_promise() -> None:
    assert not after(refused(FREE, 1e-20)).is_stuck


def test_a_free_step_that_is_taken_keeps_its_promise() -> None:
    assert not after(refused(FREE, 250.0), kept(FREE, 250.0)).is_stuck

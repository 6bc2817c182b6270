"""A solver that has come to rest is distinguished from one that cannot take the steps it needs."""

from __future__ import annotations

import numpy as np
import pytest
from tests.refine.test_bundle_adjustment import orbit

from rangesfm.ceres import Step
from rangesfm.geometry.trajectory import pose_of, trajectory_from_reconstruction
from rangesfm.refine.bundle_adjustment import ConvergenceMonitor, farthest, keyframe_centers, still_to_come

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


@pytest.mark.parametrize(
    ("now", "last", "expected"),
    [
        (1.0, 2.0, 1.0),  # 1/2 + 1/4 + 1/8 + ...
        (1.0, 3.0, 0.5),  # 1/3 + 1/9 + ...
        (2.0, 3.0, 4.0),  # 4/3 + 8/9 + ...
        (10.0, 11.0, 100.0),
        (10.0, 10.9, 100.0),  # at most ten more like the last one
        (3.0, 3.0, 30.0),
        (3.0, 2.0, 30.0),
        (1.0, 11.0, 0.1),
        (1.0, 12.0, 0.1),  # at least a tenth of the last one
        (0.0, 1.0, 0.0),
        (0.0, 0.0, 0.0),
    ],
)
def test_steps_to_come_shrink_like_the_last_two(now: float, last: float, expected: float) -> None:
    assert still_to_come(now, last) == pytest.approx(expected)


def test_the_keyframe_that_moved_most_counts() -> None:
    before = np.array([[1.0, 2.0, 3.0], [0.0, 0.0, 0.0], [5.0, 5.0, 5.0]])
    assert farthest(before, before + np.array([[0.1, 0.0, 0.0], [0.0, 3.0, -4.0], [1.0, 1.0, 1.0]])) == 5.0
    assert farthest(before, before) == 0.0


def test_centers_of_keyframes_are_those_of_the_path() -> None:
    model = orbit()
    expected = trajectory_from_reconstruction(model).centers
    np.testing.assert_allclose(keyframe_centers(model), expected, atol=1e-12)


class Moving:
    """A map whose first keyframe moves with each step, and whose cost falls by too much to be at rest."""

    def __init__(self) -> None:
        self.model = orbit()
        self.monitor = ConvergenceMonitor(self.model, residual_stddev=0.5, tolerance_m=0.01)

    def step(
        self, moved_m: float, *, gain: float = 1.0, cost: float = 1e5, radius: float = FREE, is_successful: bool = True
    ) -> bool:
        """Take a step and return whether it is the last one."""
        pose_of(self.model.frame(min(self.model.reg_frame_ids()))).params[4] += moved_m
        return self.monitor.is_over(Step(is_successful, radius, cost=cost, gain=gain, expected_gain=gain))


@pytest.mark.parametrize(("moved_m", "is_over"), [(0.99e-3, True), (1.01e-3, False)])
def test_a_first_step_counts_tenfold(moved_m: float, is_over: bool) -> None:
    moving = Moving()
    assert moving.step(moved_m) == is_over
    assert moving.monitor.is_still == is_over


@pytest.mark.parametrize(("moved_m", "is_over"), [(4.9e-3, True), (5.1e-3, False)])
def test_keyframes_rest_when_the_steps_to_come_are_within_the_tolerance(moved_m: float, is_over: bool) -> None:
    """After steps of 7.5 and 5 mm, 10 mm are still to come, which is the tolerance."""
    moving = Moving()
    assert not moving.step(1.5 * moved_m)
    assert moving.step(moved_m) == is_over
    assert moving.monitor.is_still == is_over


def test_after_a_step_that_failed_the_next_one_counts_tenfold() -> None:
    moving = Moving()
    assert not moving.step(0.1)
    assert not moving.step(0.0, is_successful=False)
    assert not moving.step(5e-3)
    assert moving.step(1e-3)


@pytest.mark.parametrize(("gain", "is_over"), [(3.1e-5, True), (3.2e-5, False)])
def test_a_cost_that_hardly_falls_is_enough(gain: float, is_over: bool) -> None:
    """Ten such steps change half the sum of squares, in standard deviations, by half the square of 0.05."""
    moving = Moving()
    assert moving.step(1.0, gain=gain) == is_over
    assert moving.monitor.is_still == is_over


@pytest.mark.parametrize(("gain", "is_over"), [(3.1e-4, True), (3.2e-4, False)])
def test_a_cost_that_falls_less_and_less_is_enough(gain: float, is_over: bool) -> None:
    """A step that gains half of what the one before gained leaves as much to come as it gained itself."""
    moving = Moving()
    assert not moving.step(1.0, gain=2 * gain)
    assert moving.step(2.0, gain=gain) == is_over


def test_after_a_step_that_failed_the_cost_has_to_fall_anew() -> None:
    moving = Moving()
    assert not moving.step(1.0, gain=6e-4)
    assert not moving.step(0.0, is_successful=False)
    assert not moving.step(2.0, gain=3e-4)


@pytest.mark.parametrize(("cost", "is_over"), [(1.01e4, True), (0.99e4, False)])
def test_a_cost_that_falls_by_a_ten_thousandth_of_itself_is_not_at_rest(cost: float, is_over: bool) -> None:
    moving = Moving()
    assert moving.step(0.0, gain=1.0, cost=cost) == is_over
    assert moving.monitor.is_still == is_over


@pytest.mark.parametrize(("radius", "is_still"), [(1e8, True), (0.99e8, False)])
def test_only_a_free_step_shows_that_keyframes_rest(radius: float, is_still: bool) -> None:
    moving = Moving()
    assert moving.step(0.0, radius=radius)
    assert moving.monitor.is_still == is_still


@pytest.mark.parametrize(("radius", "is_stuck"), [(1e8, True), (0.99e8, False)])
def test_only_a_free_step_promises_anything(radius: float, is_stuck: bool) -> None:
    assert after(refused(radius, 1.0)).is_stuck == is_stuck


@pytest.mark.parametrize(("gain", "is_stuck"), [(0.126, True), (0.124, False)])
def test_half_a_squared_standard_deviation_may_stay_promised(gain: float, is_stuck: bool) -> None:
    assert after(refused(FREE, gain)).is_stuck == is_stuck


def test_a_later_promise_replaces_an_earlier_one() -> None:
    assert not after(refused(FREE, 250.0), refused(FREE, 0.1)).is_stuck


def test_a_map_is_neither_still_nor_stuck_before_any_step() -> None:
    found = after()
    assert not found.is_still
    assert not found.is_stuck

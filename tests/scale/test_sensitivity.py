"""The table of sensitivities agrees with the effect of errors of the range model on the scale."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation
from tests.scale.test_solution import BENT, errors_of, measured, problem_of, state_of

from rangesfm.options import RangeModelOptions
from rangesfm.ranging.association import associate
from rangesfm.scale.initialize import initialize_scale
from rangesfm.scale.range_equation import RangeProblem, predicted_ranges, solve
from rangesfm.scale.scale_estimate import ScaleSensitivity
from rangesfm.scale.sensitivity import scale_sensitivity
from rangesfm.scale.solution import Solution

if TYPE_CHECKING:
    from tests.scale.conftest import MakeSurvey

Array = npt.NDArray[np.float64]

HELD = RangeModelOptions(range_stddev_m=0.05, range_bias_stddev_m=0.0, common_bias_stddev_m=0.0)
FAR_ANCHORS_M = {"A": (9.0, 2.0, 2.5), "B": (-9.0, 1.0, 0.4), "C": (0.5, 9.0, 3.0), "D": (1.0, -9.0, 0.2)}


@pytest.mark.parametrize("frame", ["first_camera", "unknown"])
def test_biases_and_a_slope_change_the_scale_as_said(make_survey: MakeSurvey, frame: str) -> None:
    survey = make_survey(anchors_m=FAR_ANCHORS_M, num_epochs=2)
    base = survey.scale(frame, "ABCD", range_model=HELD)
    of_a = survey.simulated.log.anchor_index == 0
    true = survey.simulated.distance_m
    cases = {
        base.sensitivity.common_bias_per_cm: np.full(len(true), 0.01),
        base.sensitivity.anchor_bias_per_cm["A"]: 0.01 * of_a,
        # A tenth of a percent, because the robust loss is not linear for more.
        base.sensitivity.range_slope_per_percent / 10: 0.001 * true,
    }
    for expected, error in cases.items():
        changed = survey.scale(frame, "ABCD", survey.log_with(true + error), range_model=HELD)
        assert 100 * (changed.value / base.value - 1) == pytest.approx(expected, abs=0.02 + 0.05 * abs(expected))


def test_a_lever_arm_that_is_wrong_changes_the_scale_as_said(make_survey: MakeSurvey) -> None:
    survey = make_survey(anchors_m=FAR_ANCHORS_M, num_epochs=2)
    base = survey.scale("first_camera", "ABCD", range_model=HELD)
    for axis in range(3):
        # The tag sits a centimetre further out than the survey says.
        said = survey.tag_in_cam_m - 0.01 * np.eye(3)[axis]
        observations = associate(survey.simulated.log, survey.trajectory, said)
        anchors = survey.anchors("first_camera", "ABCD")
        wrong = initialize_scale(
            observations, survey.trajectory, anchors, anchor_frame="first_camera", range_model=HELD
        )
        expected = base.sensitivity.lever_arm_per_cm[axis]
        assert 100 * (wrong.value / base.value - 1) == pytest.approx(expected, abs=0.01 + 0.05 * abs(expected))


def test_ranges_one_percent_longer_make_a_map_of_unknown_anchors_one_percent_larger(make_survey: MakeSurvey) -> None:
    survey = make_survey(anchors_m=FAR_ANCHORS_M, num_epochs=2, tag_in_cam_m=(0.0, 0.0, 0.0))
    assert survey.scale("unknown", range_model=HELD).sensitivity.range_slope_per_percent == pytest.approx(1.0, abs=0.02)


def test_of_ranges_as_long_as_most_none_is_short(make_survey: MakeSurvey) -> None:
    """All ranges from a circle to one anchor are equal, and rounding puts some of them below their median."""
    angles = np.linspace(0.0, 6.0, 40)
    circle = np.stack([3.0 * np.cos(angles), 3.0 * np.sin(angles), np.zeros(40)], axis=1)
    anchors_m = {"A": (0.0, 0.0, 4.0), "B": (6.0, 0.0, 0.0)}
    in_many_worlds = [
        make_survey(centers_m=circle, anchors_m=anchors_m, tag_in_cam_m=(0, 0, 0), seed=seed)
        .scale("first_camera", "AB", range_model=HELD)
        .sensitivity.short_range_per_cm
        for seed in range(3)
    ]
    np.testing.assert_allclose(in_many_worlds, in_many_worlds[0], rtol=1e-6)


TURNS = Rotation.from_rotvec(np.linspace(0.0, 2.0, 40)[:, None] * [0.5, -1.0, 0.4]).as_matrix()
ARMS_M = TURNS @ [0.1, -0.2, 0.3]
TRUTH = state_of(2.0, Rotation.from_rotvec([0.4, -1.1, 2.0]).as_matrix(), np.array([0.5, -0.3, 1.2]))


def placed_problem() -> RangeProblem:
    """Return exact ranges in a site, with biases that are estimated and a lever arm."""
    problem = replace(problem_of(BENT), tag_from_center=ARMS_M, stddev_m=np.linspace(0.05, 0.2, 40))
    return measured(replace(problem, bias_stddev_m=np.full(5, 0.1), common_bias_stddev_m=0.05), TRUTH)


def sensitivity_of(problem: RangeProblem, best_by_bins: Array) -> ScaleSensitivity:
    """Return the table for bins of eight ranges in turn, and gains of the bins with the best weights."""
    fit = solve(problem, TRUTH)
    log: Any = SimpleNamespace(anchor_ids=("A", "B", "C", "D", "E"))
    posed: Any = SimpleNamespace(model_from_cam=TURNS, observations=SimpleNamespace(log=log))
    bins: Any = SimpleNamespace(mean=lambda values: values.reshape(5, 8).mean(axis=1))
    known: Any = SimpleNamespace(best_by_bins=best_by_bins)
    return scale_sensitivity(Solution(problem, fit, errors_of(problem), 0.1), posed, known, bins)


def percent_by(problem: RangeProblem, error_m: Array) -> float:
    """Return the change of the scale in percent by solving again with a thousandth of these errors of the ranges."""
    found = solve(replace(problem, range_m=problem.range_m + 1e-3 * error_m), TRUTH).state.metric_from_model.scale
    return float(1e5 * np.log(found / 2.0))


def test_half_of_every_number_is_the_change_that_solving_again_shows() -> None:
    """The other half is by the best weights, which are told to have no effect here."""
    problem = placed_problem()
    table = sensitivity_of(problem, np.zeros(5))
    distance = problem.range_m
    assert table.common_bias_per_cm == pytest.approx(percent_by(problem, np.full(40, 0.01)) / 2, rel=1e-4)
    assert table.range_slope_per_percent == pytest.approx(percent_by(problem, 0.01 * distance) / 2, rel=1e-4)
    shorter = np.where(distance < np.median(distance), 0.01, 0.0)
    assert table.short_range_per_cm == pytest.approx(percent_by(problem, shorter) / 2, rel=1e-4)
    for k, name in ((0, "A"), (3, "D")):
        of_anchor = np.where(np.arange(40) % 5 == k, 0.01, 0.0)
        assert table.anchor_bias_per_cm[name] == pytest.approx(percent_by(problem, of_anchor) / 2, rel=1e-4)
    for axis in range(3):
        further = replace(problem, tag_from_center=ARMS_M + 1e-6 * TURNS[:, :, axis])
        longer = 1e4 * (predicted_ranges(further, TRUTH) - problem.range_m)
        assert table.lever_arm_per_cm[axis] == pytest.approx(percent_by(problem, longer) / 2, rel=1e-3)


def test_the_other_half_is_the_mean_error_of_each_bin_times_its_gain() -> None:
    problem = placed_problem()
    without, gained = (sensitivity_of(problem, factor * np.array([1.0, 2.0, 0.0, -1.0, 3.0])) for factor in (0.0, 1.0))
    # A centimetre in all bins, whose gains sum to 5 per metre: half of 5 %.
    assert gained.common_bias_per_cm - without.common_bias_per_cm == pytest.approx(2.5)
    # A bin of eight ranges has 2, 2, 2, 1, 1 of the five anchors; the next one begins three anchors on.
    share = np.array([[2, 2, 2, 1, 1], [2, 1, 1, 2, 2], [1, 2, 2, 2, 1], [2, 2, 1, 1, 2], [1, 1, 2, 2, 2]]) / 8
    for k, name in enumerate("ABCDE"):
        added = gained.anchor_bias_per_cm[name] - without.anchor_bias_per_cm[name]
        assert added == pytest.approx(0.5 * share[:, k] @ [1.0, 2.0, 0.0, -1.0, 3.0])

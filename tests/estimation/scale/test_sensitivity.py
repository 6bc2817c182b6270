"""The table of sensitivities agrees with the effect of errors of the range model on the scale."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from rangesfm.estimation.scale.initialize import initialize_scale
from rangesfm.measurements.ranges.association import associate
from rangesfm.options import RangeModelOptions

if TYPE_CHECKING:
    from tests.estimation.scale.conftest import MakeSurvey

HELD = RangeModelOptions(range_stddev_m=0.05, range_bias_stddev_m=0.0, common_bias_stddev_m=0.0)
FAR_ANCHORS_M = {"A": (9.0, 2.0, 2.5), "B": (-9.0, 1.0, 0.4), "C": (0.5, 9.0, 3.0), "D": (1.0, -9.0, 0.2)}


@pytest.mark.parametrize("frame", ["first_camera", "unknown"])
def test_biases_and_a_slope_change_the_scale_as_said(make_survey: MakeSurvey, frame: str) -> None:
    survey = make_survey(anchors_m=FAR_ANCHORS_M, num_epochs=2)
    base = survey.scale(frame, "ABCD", range_model=HELD)
    of_a = survey.log.anchor_index == 0
    true = survey.distance_m
    cases = {
        base.ranges.sensitivity.common_bias_per_cm: np.full(len(true), 0.01),
        base.ranges.sensitivity.anchor_bias_per_cm["A"]: 0.01 * of_a,
        # A tenth of a percent, because the robust loss is not linear for more.
        base.ranges.sensitivity.range_slope_per_percent / 10: 0.001 * true,
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
        observations = associate(survey.log, survey.trajectory, said)
        anchors = survey.anchors("first_camera", "ABCD")
        wrong = initialize_scale(
            observations, survey.trajectory, anchors, anchor_frame="first_camera", range_model=HELD
        )
        expected = base.ranges.sensitivity.lever_arm_per_cm[axis]
        assert 100 * (wrong.value / base.value - 1) == pytest.approx(expected, abs=0.01 + 0.05 * abs(expected))


def test_ranges_one_percent_longer_make_a_map_of_unknown_anchors_one_percent_larger(make_survey: MakeSurvey) -> None:
    survey = make_survey(anchors_m=FAR_ANCHORS_M, num_epochs=2, tag_in_cam_m=(0.0, 0.0, 0.0))
    assert survey.scale("unknown", range_model=HELD).ranges.sensitivity.range_slope_per_percent == pytest.approx(
        1.0, abs=0.02
    )


def test_of_ranges_as_long_as_most_none_is_short(make_survey: MakeSurvey) -> None:
    """All ranges from a circle to one anchor are equal, and rounding puts some of them below their median."""
    angles = np.linspace(0.0, 6.0, 40)
    circle = np.stack([3.0 * np.cos(angles), 3.0 * np.sin(angles), np.zeros(40)], axis=1)
    anchors_m = {"A": (0.0, 0.0, 4.0), "B": (6.0, 0.0, 0.0)}
    in_many_worlds = [
        make_survey(centers_m=circle, anchors_m=anchors_m, tag_in_cam_m=(0, 0, 0), seed=seed)
        .scale("first_camera", "AB", range_model=HELD)
        .ranges.sensitivity.short_range_per_cm
        for seed in range(3)
    ]
    np.testing.assert_allclose(in_many_worlds, in_many_worlds[0], rtol=1e-6)

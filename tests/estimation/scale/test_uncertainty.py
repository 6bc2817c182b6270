"""The stated uncertainty of the scale is honest."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation
from tests.simulated.radio_errors import lasting

from rangesfm.demo.simulated_radio import Radio
from rangesfm.estimation.scale.initialize import initialize_scale
from rangesfm.estimation.scale.scale_estimate import ScaleEstimate
from rangesfm.measurements.ranges.association import associate
from rangesfm.measurements.ranges.errors.components import CLOCKS
from rangesfm.options import RangeModelOptions, ScaleOptions
from rangesfm.solver.bending import Bending
from rangesfm.solver.posterior import ScaleUncertainty
from rangesfm.util.geometry.trajectory import Trajectory

if TYPE_CHECKING:
    from tests.estimation.scale.conftest import MakeSurvey, Survey

Array = npt.NDArray[np.float64]

WITHOUT_BIASES = RangeModelOptions(range_bias_stddev_m=0.0, common_bias_stddev_m=0.0)
FAR_ANCHORS_M = {"A": (9.0, 2.0, 2.5), "B": (-9.0, 1.0, 0.4), "C": (0.5, 9.0, 3.0), "D": (1.0, -9.0, 0.2)}
IN_TIME = ("white", "time", "place", "view")


@dataclass(frozen=True)
class Rigid:
    """The bending of a map that is known not to be bent."""

    path: Trajectory

    def of_functions(self, by_pose: Array, *, frame_is_free: bool) -> Bending:
        return Bending((), np.zeros((len(by_pose), len(by_pose))), np.zeros(len(by_pose)))


def drifting_errors(survey: Survey, seed: int) -> Array:
    """(n,) errors of each anchor that come and go over some seconds."""
    log, rng = survey.log, np.random.default_rng(seed)
    errors_m = np.zeros(len(log))
    for k in range(len(log.anchor_ids)):
        rows = log.anchor_index == k
        errors_m[rows] = 0.1 * lasting(log.timestamp_s[rows], 4.0, rng)
    return errors_m


def in_time(uncertainty: ScaleUncertainty) -> float:
    """Return the uncertainty from all errors that change over time."""
    return float(np.linalg.norm([uncertainty.components.get(name, 0.0) for name in IN_TIME]))


def test_with_independent_errors_the_formal_stddev_is_the_scatter(make_survey: MakeSurvey) -> None:
    surveys = [make_survey(anchors_m=FAR_ANCHORS_M, radio=Radio(range_stddev_m=0.1), seed=seed) for seed in range(32)]
    estimates = [
        survey.scale("first_camera", "ABCD", range_model=WITHOUT_BIASES, bending=Rigid(survey.trajectory))
        for survey in surveys
    ]
    errors = [survey.relative_error(estimate) for survey, estimate in zip(surveys, estimates, strict=True)]
    formal = float(np.median([estimate.uncertainty.formal for estimate in estimates]))
    assert np.std(errors) / formal == pytest.approx(1.0, abs=0.25)
    seen = float(np.median([in_time(estimate.uncertainty) for estimate in estimates]))
    assert 1.0 < seen / formal < 1.5


def test_with_errors_that_last_the_stddev_grows_and_is_the_scatter(make_survey: MakeSurvey) -> None:
    errors, formals, seen = [], [], []
    for seed in range(20):
        survey = make_survey(anchors_m=FAR_ANCHORS_M, num_keyframes=100, seed=seed)
        log = survey.log_with(survey.distance_m + drifting_errors(survey, seed))
        estimate = survey.scale("first_camera", "ABCD", log, range_model=WITHOUT_BIASES)
        errors.append(survey.relative_error(estimate))
        formals.append(estimate.uncertainty.formal)
        seen.append(in_time(estimate.uncertainty))
    # About ten ranges in a row, at 2.5 a second, have correlated errors.
    assert np.median(seen) > 1.5 * np.median(formals)
    assert np.std(errors) > 1.5 * np.median(formals)
    assert np.std(errors) / np.median(seen) == pytest.approx(1.0, abs=0.4)


def test_the_components_add_as_variances_and_are_never_less_than_the_formal_stddev() -> None:
    assert ScaleUncertainty(0.001, {"a": 0.003, "b": 0.004}).empirical == pytest.approx(0.005)
    assert ScaleUncertainty(0.01, {"a": 0.003}).empirical == 0.01
    assert ScaleUncertainty(0.001, {"a": 0.003, "b": 0.004}).half_width_95 == pytest.approx(1.96 * 0.005)


def test_four_times_the_ranges_halve_what_is_noise(make_survey: MakeSurvey) -> None:
    few, many = (
        make_survey(anchors_m=FAR_ANCHORS_M, radio=Radio(range_stddev_m=0.1), num_epochs=num).scale(
            "first_camera", "ABCD", range_model=WITHOUT_BIASES
        )
        for num in (2, 8)
    )
    assert many.uncertainty.formal / few.uncertainty.formal == pytest.approx(0.5, rel=0.2)
    assert many.uncertainty.components["white"] < 0.8 * few.uncertainty.components["white"]


def test_an_error_curve_that_nobody_knows_widens_the_interval_and_a_known_one_hardly(make_survey: MakeSurvey) -> None:
    survey = make_survey(radio=Radio(range_stddev_m=0.03), num_epochs=5)
    log = survey.log
    calibrated = replace(log, shared_stddev_m=np.full(len(log), 0.005))
    unknown, known = (survey.scale("unknown", (), each).uncertainty for each in (log, calibrated))
    assert known.components["curve"] < 0.7 * unknown.components["curve"]
    assert known.components["learnt_curve"] < known.components["curve"]
    assert known.half_width_95 < unknown.half_width_95


def test_biases_that_are_ruled_out_are_no_part_of_it(make_survey: MakeSurvey) -> None:
    survey = make_survey(radio=Radio(range_stddev_m=0.05))
    assert "bias" in survey.scale("first_camera", "ABCDE").uncertainty.components
    without = survey.scale("first_camera", "ABCDE", range_model=WITHOUT_BIASES).uncertainty.components
    assert not {"bias", "common_bias"} & set(without)


def test_a_map_that_bends_is_not_known_as_well_as_one_that_does_not(make_survey: MakeSurvey) -> None:
    survey = make_survey(anchors_m=FAR_ANCHORS_M, radio=Radio(range_stddev_m=0.03), num_keyframes=100, num_epochs=3)
    along = np.linspace(0, 1, 100)
    bend_m = 0.4 * np.column_stack([np.sin(7 * along), np.cos(5 * along), 0.3 * np.sin(11 * along)])
    path = survey.trajectory
    bent = replace(survey, trajectory=replace(path, centers=path.centers + bend_m / survey.site_from_sfm.scale))
    options = ScaleOptions(max_relative_stddev=0.5)
    true, wrong = (each.scale("first_camera", "ABCD", options=options) for each in (survey, bent))
    assert wrong.ranges.error_stddevs["bending"] > 5 * true.ranges.error_stddevs["bending"]
    assert wrong.uncertainty.half_width_95 > 1.5 * true.uncertainty.half_width_95
    assert abs(bent.relative_error(wrong)) < wrong.uncertainty.half_width_95


def test_an_offset_that_the_clocks_leave_open_is_taken_out_of_scale_and_place(make_survey: MakeSurvey) -> None:
    survey, off_s = make_survey(), 0.5
    anchors, truth = survey.anchors("site", survey.anchors_m), survey.truth("site")

    def estimate(stddev_s: float) -> tuple[ScaleEstimate, float]:
        """Return the estimate with clocks that are off, and the error of its heading in standard deviations."""
        placed = associate(survey.log, survey.trajectory, survey.tag_in_cam_m, time_offset_s=off_s)
        placed = replace(placed, time_offset_stddev_s=stddev_s)
        found = initialize_scale(placed, survey.trajectory, anchors, anchor_frame="site")
        assert found.placement is not None
        turn = Rotation.from_matrix(found.metric_from_sfm.rotation @ truth.rotation.T).as_rotvec()
        return found, float(abs(turn[2]) / np.sqrt(found.placement[3, 3]))

    ruled_out, heading_off = estimate(0.0)
    assert CLOCKS not in ruled_out.uncertainty.components
    # Half a second later, the whole map is turned along its loop by 5 degrees. Ranges show the offset that does so.
    assert heading_off > 10
    known, heading_off = estimate(off_s)
    assert known.uncertainty.components[CLOCKS] > 0
    assert heading_off < 2
    assert abs(survey.relative_error(known)) < known.uncertainty.half_width_95

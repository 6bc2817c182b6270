"""A clean survey of a drifting map is good: drift is not a mistake, and the verdict is about the delivered map."""

from __future__ import annotations

import numpy as np
import pytest
from tests.known import known
from tests.known_errors import predicted_by_model
from tests.simulated.runs import run_stages
from tests.simulated.surveys import MadeSurvey
from tests.studies.drifting_maps import lap_of_drift, without_points

from rangesfm.pipeline.metric_result import MetricResult
from rangesfm.util.geometry.similarity import align_points, rmse

NUM_KEYFRAMES = 100


@pytest.fixture(scope="module", params=[(0.5, "first_camera"), (5.0, "first_camera"), (5.0, "unknown"), (2.0, "site")])
def lap(request: pytest.FixtureRequest) -> MadeSurvey:
    drift_m, frame = request.param
    return lap_of_drift(drift_m, 1, frame, num_keyframes=NUM_KEYFRAMES)


@pytest.fixture(scope="module")
def refined(lap: MadeSurvey) -> MetricResult:
    return run_stages(lap, 0)


def error_m(lap: MadeSurvey, found: MetricResult) -> float:
    return rmse(found.trajectory.as_in(found.final).centers - lap.true_centers_m)


def test_a_refinement_that_bends_drift_back_is_kept_however_far_it_changes_the_scale(
    lap: MadeSurvey, refined: MetricResult
) -> None:
    assert refined.kept is not None
    scaled_m = rmse(refined.trajectory.as_in(refined.scaled).centers - lap.true_centers_m)
    assert error_m(lap, refined) < 0.8 * scaled_m


def test_no_mistake_is_named_that_nobody_made(refined: MetricResult) -> None:
    assert refined.diagnosis.causes == ()
    assert refined.estimate.verdict == "good", refined.estimate.reasons


def test_the_scale_that_is_stated_is_the_refined_maps_and_the_truth_is_in_its_interval(
    lap: MadeSurvey, refined: MetricResult
) -> None:
    assert refined.estimate.value == known(refined.kept).scale
    low, high = refined.estimate.interval_95
    assert low < lap.metres_per_unit < high
    assert refined.estimate.uncertainty.half_width_95 < 0.02


def test_scale_and_ranges_are_those_of_the_delivered_map(lap: MadeSurvey, refined: MetricResult) -> None:
    """After the refinement the map is moved as a whole, and its ranges with it."""
    centers_m = refined.trajectory.as_in(refined.final).centers
    assert align_points(refined.trajectory.centers, centers_m).scale == pytest.approx(refined.estimate.value, rel=1e-9)
    predicted_m = predicted_by_model(
        refined.final,
        refined.trajectory,
        refined.observations,
        refined.estimate.metric_from_sfm,
        lap.tag_in_cam_m,
        refined.anchors,
    )
    assert refined.ranges.predicted_m == pytest.approx(predicted_m, abs=1e-6, nan_ok=True)


def test_keyframes_err_as_their_covariances_say(lap: MadeSurvey, refined: MetricResult) -> None:
    covariances = np.array([refined.center_covariance_m2[name] for name in refined.trajectory.image_names])
    off_m = refined.trajectory.as_in(refined.final).centers - lap.true_centers_m
    stated_m = float(np.sqrt(np.mean(np.trace(covariances, axis1=1, axis2=2))))
    assert 0.1 * stated_m < rmse(off_m) < 2 * stated_m


def test_a_path_of_poses_is_scaled_to_where_ranges_bend_it_back() -> None:
    """The likeliest similarity is used, and the drift from there is stated as a fact."""
    lap = without_points(lap_of_drift(5.0, 2, "site", num_keyframes=NUM_KEYFRAMES))
    found = run_stages(lap, 0)
    assert found.diagnosis.causes == ()
    low, high = found.estimate.interval_95
    assert low < lap.metres_per_unit < high
    assert found.estimate.uncertainty.half_width_95 < 0.02
    best_m = rmse(
        align_points(lap.trajectory.centers, lap.true_centers_m).apply(lap.trajectory.centers) - lap.true_centers_m
    )
    assert error_m(lap, found) < 1.1 * best_m + 0.1
    assert any("drifts" in reason for reason in found.estimate.reasons)
    assert known(found.place).worst_keyframe_stddev_m > 0.5 * best_m


@pytest.mark.parametrize(("drift_m", "seed"), [(3.0, 1), (3.0, 6), (15.0, 11)])
def test_a_path_that_fits_better_turned_over_is_placed_the_right_way_up(drift_m: float, seed: int) -> None:
    """A rigid path fits better with the anchors on its wrong side; a path that drifts does not."""
    lap = without_points(lap_of_drift(drift_m, seed, "site", with_radio=True, num_keyframes=NUM_KEYFRAMES))
    found = run_stages(lap, 0)
    best_m = rmse(
        align_points(lap.trajectory.centers, lap.true_centers_m).apply(lap.trajectory.centers) - lap.true_centers_m
    )
    assert error_m(lap, found) < 1.1 * best_m


def test_a_path_that_drifts_by_a_hundred_times_the_usual_has_no_mistake_named() -> None:
    """However far it drifts, drift is no mistake, and all ranges that fit the bent path are used."""
    lap = without_points(lap_of_drift(15.0, 10, "site", with_radio=True, num_keyframes=NUM_KEYFRAMES))
    found = run_stages(lap, 0)
    assert found.diagnosis.causes == ()
    assert found.estimate.verdict == "good"
    low, high = found.estimate.interval_95
    assert low < lap.metres_per_unit < high

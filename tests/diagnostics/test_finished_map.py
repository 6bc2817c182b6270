"""Evidence against a finished map is named with its numbers, and a clean map causes no doubt."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from tests.estimation.scale.conftest import MakeSurvey, Survey, make_survey
from tests.known import known

from rangesfm.colmap.reprojection import PointErrors
from rangesfm.demo.simulated_radio import Radio
from rangesfm.diagnostics.finished_map import doubts_of_points, place_of_map
from rangesfm.estimation.scale.initialize import initialize_scale
from rangesfm.estimation.scale.scale_estimate import ScaleEstimate
from rangesfm.options import ScaleOptions
from rangesfm.util.geometry.map_errors import UNKNOWN_ERRORS
from rangesfm.util.geometry.similarity import similarity_motions
from rangesfm.util.geometry.trajectory import Trajectory

__all__ = ["make_survey"]

Array = npt.NDArray[np.float64]
GOOD_POINTS = PointErrors(np.full(100, 0.6), np.zeros((100, 3)), 4.0)
COMMON_BIAS_STDDEV_M = 0.1


OPTIONS = ScaleOptions()
RADIO = Radio(range_stddev_m=0.06)


@pytest.fixture(scope="module")
def walked(make_survey: MakeSurvey) -> Survey:
    return make_survey(num_epochs=4, radio=RADIO)


NOT_BENT = np.zeros(0)


@pytest.fixture(scope="module")
def estimate(walked: Survey) -> ScaleEstimate:
    """The estimate of a clean survey with five surveyed anchors."""
    anchors = [replace(anchor, position_stddev_m=0.02) for anchor in walked.anchors("site", tuple(walked.anchors_m))]
    return initialize_scale(walked.observations(), walked.trajectory, anchors, anchor_frame="site", options=OPTIONS)


def path_in_site(walked: Survey, estimate: ScaleEstimate) -> Trajectory:
    moved = estimate.metric_from_sfm
    return walked.trajectory.transformed(moved)


@pytest.mark.parametrize("seed", range(2))
def test_a_clean_map_is_doubted_of_nothing_and_its_place_is_good(make_survey: MakeSurvey, seed: int) -> None:
    walked = make_survey(num_epochs=4, radio=RADIO, seed=seed)
    estimate = walked.scale("site", tuple(walked.anchors_m), options=OPTIONS)
    assert doubts_of_points(GOOD_POINTS) == ()
    place = known(place_of_map(estimate, UNKNOWN_ERRORS, path_in_site(walked, estimate), [], NOT_BENT))
    assert place.verdict == "good"
    off_m = path_in_site(walked, estimate).centers - walked.centers_m
    assert np.all(np.abs(off_m.mean(axis=0)) < 4 * np.array(place.stddev_m))
    assert np.linalg.norm(off_m, axis=1).max() < 3 * place.worst_keyframe_stddev_m


def test_points_that_are_not_of_the_photos_are_said_of_the_place_too(walked: Survey, estimate: ScaleEstimate) -> None:
    (doubt,) = doubts_of_points(PointErrors(np.full(9, 82.0), np.zeros((9, 3)), 4.8))
    assert doubt.reason.startswith("the map's points lie 82 px (median) from where the photos show them")
    assert doubt.advice
    place = known(place_of_map(estimate, UNKNOWN_ERRORS, path_in_site(walked, estimate), [doubt.reason], NOT_BENT))
    assert (place.verdict, place.reasons) == ("doubtful", (doubt.reason,))


@pytest.mark.parametrize("what", ["shift", "heading"])
def test_a_wide_place_is_doubtful(walked: Survey, estimate: ScaleEstimate, what: str) -> None:
    placement = np.zeros((7, 7))
    placement[(slice(4, 7),) * 2 if what == "shift" else (3, 3)] = np.eye(3) * 0.5**2 if what == "shift" else 0.03**2
    place = known(
        place_of_map(
            replace(estimate, placement=placement), UNKNOWN_ERRORS, path_in_site(walked, estimate), [], NOT_BENT
        )
    )
    assert place.verdict == "doubtful"
    if what == "shift":
        assert place.stddev_m == pytest.approx((0.5, 0.5, 0.5))
        assert place.worst_keyframe_stddev_m == pytest.approx(np.sqrt(3) * 0.5)
    else:
        assert place.heading_stddev_deg == pytest.approx(np.degrees(0.03))


def test_a_scaled_maps_place_errs_as_its_stddevs_say(make_survey: MakeSurvey) -> None:
    """This tests the formal part of the stddevs; they are widened in the same way as the scale's interval."""
    squares, rng = [], np.random.default_rng(0)
    for seed in range(6):
        walked = make_survey(num_epochs=4, radio=RADIO, seed=seed)
        log = walked.log
        # The biases are drawn with the stddevs that the range model assumes.
        bias_m = COMMON_BIAS_STDDEV_M * rng.standard_normal() + 0.01 * rng.standard_normal(len(log.anchor_ids))
        log = walked.log_with(log.range_m + bias_m[log.anchor_index])
        estimate = walked.scale("site", tuple(walked.anchors_m), log=log, options=OPTIONS)
        uncertainty = estimate.uncertainty
        widening = uncertainty.half_width_95 / (1.96 * uncertainty.formal)
        place = known(place_of_map(estimate, UNKNOWN_ERRORS, path_in_site(walked, estimate), [], NOT_BENT))
        off_m = (path_in_site(walked, estimate).centers - walked.centers_m).mean(axis=0)
        squares.append((off_m / (np.array(place.stddev_m) / widening)) ** 2)
    # The mean of 18 chi-squares with one degree of freedom each is beyond this in one case of a thousand.
    assert 0.2 < np.mean(squares) < 2.5


def test_a_map_in_the_first_cameras_frame_has_no_place(walked: Survey) -> None:
    estimate = walked.scale("unknown")
    assert place_of_map(estimate, UNKNOWN_ERRORS, path_in_site(walked, estimate), [], NOT_BENT) is None


def test_motions_of_a_similarity_are_its_derivatives() -> None:
    points = np.random.default_rng(0).normal(size=(5, 3))
    motions = similarity_motions(points)
    np.testing.assert_allclose(motions @ np.eye(7)[0], points)
    np.testing.assert_allclose(motions @ [0, 0.1, 0.2, 0.3, 0, 0, 0], np.cross([0.1, 0.2, 0.3], points))
    np.testing.assert_allclose(motions @ np.eye(7)[5], np.tile(np.eye(3)[1], (5, 1)))

"""Models on which a refinement breaks leave the scaled map, or none; models that it repairs stay good."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import pycolmap
import pytest
from tests.known import known

from rangesfm.colmap.model_files import read_model
from rangesfm.errors import SolverError
from rangesfm.pipeline.run import refine_model, scale_model
from rangesfm.progress import Progress
from rangesfm.result.result_folder import ResultFolder, is_refined_model, read_result_folder
from rangesfm.result.result_tables import RangesAsUsed
from rangesfm.survey.settings import Survey
from rangesfm.util.geometry.trajectory import trajectory_from_reconstruction

if TYPE_CHECKING:
    from tests.conftest import WalkedSurvey

Array = npt.NDArray[np.float64]
Spoil = Callable[[pycolmap.Reconstruction], None]


def throw_points(model: pycolmap.Reconstruction) -> None:
    """Move one point in twenty some thousand units away from the path."""
    rng = np.random.default_rng(0)
    for _, point in sorted(model.points3D.items()):
        if rng.random() < 0.05:
            point.xyz = point.xyz + 1000 * rng.standard_normal(3)


def mix_points(model: pycolmap.Reconstruction) -> None:
    places = np.random.default_rng(0).permutation([point.xyz for point in model.points3D.values()])
    for point, place in zip(model.points3D.values(), places, strict=True):
        point.xyz = place


def shorten_focal_length(model: pycolmap.Reconstruction) -> None:
    for camera in model.cameras.values():
        camera.params = np.array(camera.params) * [0.7, 0.7, 1.0, 1.0]


def throw_camera(model: pycolmap.Reconstruction, by: Array) -> None:
    frame = model.frame(sorted(model.reg_frame_ids())[20])
    pose = known(frame.rig_from_world)
    frame.rig_from_world = pycolmap.Rigid3d(pose.rotation, pose.translation + by)


def throw_camera_a_little(model: pycolmap.Reconstruction) -> None:
    throw_camera(model, np.array([5.0, 3.0, 0.0]))


def leave_as_it_is(model: pycolmap.Reconstruction) -> None:
    assert model.num_reg_images()


@pytest.fixture(scope="module")
def walked_survey(dense_survey: WalkedSurvey) -> WalkedSurvey:
    return dense_survey


@pytest.fixture
def survey(own_survey: WalkedSurvey) -> Survey:
    changes = {"refine.max_num_iterations": 40, "report.enabled": False}
    return own_survey.survey(own_survey.folder / "out").changed(changes)


def spoilt(survey: Survey, spoil: Spoil) -> Survey:
    path = known(survey.images.model)
    model = read_model(path)
    spoil(model)
    model.write(path)
    return survey


def refined(survey: Survey) -> ResultFolder:
    return refine_model(survey, progress=Progress())


def centers(path_of_model: str, survey: Survey) -> Array:
    return trajectory_from_reconstruction(read_model(survey.output.path / path_of_model / "0")).centers


@pytest.mark.parametrize("spoil", [leave_as_it_is, throw_camera_a_little])
def test_a_refinement_that_did_its_work_is_kept(survey: Survey, spoil: Spoil, own_survey: WalkedSurvey) -> None:
    summary = refined(spoilt(survey, spoil)).summary
    refine, place = known(summary.refine), known(summary.place)
    assert place.verdict == "good"
    # A camera that was out of place before is reported, though it is in place now.
    assert (summary.scale.verdict == "good") == (not summary.warnings) == (spoil is leave_as_it_is)
    assert refine.kept
    assert refine.converged
    assert refine.why_not_kept == ()
    low, high = known(summary.scale.interval_95)
    assert low < known(refine.scale_value) < high
    off_m = np.linalg.norm(centers("sparse_metric", survey) - own_survey.centers_m, axis=1)
    assert off_m.max() < 3 * place.worst_keyframe_stddev_m


def test_where_it_breaks_the_scaled_map_is_the_result_and_says_so(survey: Survey, own_survey: WalkedSurvey) -> None:
    done = refined(spoilt(survey, throw_points))
    summary, refine, place = done.summary, known(done.summary.refine), known(done.summary.place)
    assert not refine.kept
    assert refine.why_not_kept
    assert not is_refined_model(survey.output.path / "sparse_metric" / "0")
    (reason,) = (reason for reason in summary.scale.reasons if reason.startswith("the refinement broke the map"))
    assert reason in summary.warnings
    assert reason in place.reasons
    assert (summary.scale.verdict, place.verdict) == ("doubtful", "doubtful")
    np.testing.assert_array_equal(centers("sparse_metric", survey), centers("sparse_scaled", survey))
    off_m = np.linalg.norm(centers("sparse_metric", survey) - own_survey.centers_m, axis=1)
    assert off_m.max() < 3 * place.worst_keyframe_stddev_m
    # All other outputs belong to the scaled map too.
    result = read_result_folder(survey.output.path)
    ranges = known(result.read(RangesAsUsed))
    np.testing.assert_allclose(ranges.residual_m, ranges.predicted_scaled_m - ranges.range_m, atol=1e-4)
    assert known(summary.ranges.rms_m) < 0.2
    assert "the refinement broke the map: the result is the scaled map" in done.lines


@pytest.mark.parametrize("spoil", [mix_points, shorten_focal_length])
def test_where_the_model_was_none_before_nothing_is_left(survey: Survey, spoil: Spoil) -> None:
    with pytest.raises(SolverError, match=r"the refinement broke the map: .*nor do the points of the model") as caught:
        refined(spoilt(survey, spoil))
    assert caught.value.exit_status == 4
    assert not (survey.output.path / "result.json").exists()


def test_the_path_of_such_a_model_is_scaled_with_a_warning_about_its_points(survey: Survey) -> None:
    scaled = scale_model(spoilt(survey, mix_points), progress=Progress()).summary
    assert scaled.scale.verdict == "doubtful"
    assert any(warning.startswith("the model's points lie") for warning in scaled.warnings)


def test_one_that_stops_before_its_end_is_doubted(survey: Survey) -> None:
    summary = refined(survey.changed({"refine.max_num_iterations": 1})).summary
    assert not known(summary.refine).converged
    assert summary.scale.verdict == "doubtful"
    assert any(reason.startswith("the refinement stopped before it converged") for reason in summary.scale.reasons)

"""Ranges in the growing map reduce its drift, wait until they can, and include none that are held out."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import pycolmap
import pytest

from rangesfm.demo.survey import TIME_OFFSET_S
from rangesfm.geometry.similarity import align_points, rmse
from rangesfm.geometry.trajectory import trajectory_from_reconstruction
from rangesfm.progress import SilentProgress
from rangesfm.ranging.association import associate
from rangesfm.ranging.range_observations import RangeStatus, hold_out
from rangesfm.survey.inputs import read_ranging_inputs
from rangesfm.survey.settings import Survey, read_survey
from rangesfm.vision.image_times import read_image_times_csv
from rangesfm.workflows.map_photos import AdjustmentWithRanges
from rangesfm.workflows.run import run_survey

if TYPE_CHECKING:
    from tests.conftest import PhotoRun, WalkedSurvey

Array = npt.NDArray[np.float64]


@pytest.fixture
def survey(walked_survey: WalkedSurvey, tmp_path: Path) -> Survey:
    """The walked survey with anchors in the site frame, a known time offset, and every third of its ranges."""
    folder = walked_survey.folder
    header, *rows = (folder / "uwb.csv").read_text().splitlines(keepends=True)
    (tmp_path / "uwb.csv").write_text(header + "".join(rows[::3]))
    return Survey().changed(
        {
            "images.times": folder / "images.csv",
            "ranges.path": tmp_path / "uwb.csv",
            "ranges.time_offset": 2.0,
            "anchors.path": folder / "anchors.csv",
            "tag.tag_in_cam_m": (0.03, -0.12, -0.05),
            "output.path": tmp_path / "out",
        }
    )


@pytest.fixture(scope="session")
def mapped_alone(walked_survey: WalkedSurvey) -> pycolmap.Reconstruction:
    """The walk adjusted to noisy features alone, so that it drifts. Tests must not write to it."""
    model = pycolmap.Reconstruction(walked_survey.folder / "sparse" / "0")
    rng = np.random.default_rng(0)
    for _, image in sorted(model.images.items()):
        for point in image.points2D:
            point.xy = point.xy + 8.0 * rng.standard_normal(2)
    options = pycolmap.BundleAdjustmentOptions(
        print_summary=False, refine_focal_length=False, refine_extra_params=False
    )
    pycolmap.bundle_adjustment(model, options)
    return model


@pytest.fixture
def model(mapped_alone: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    return pycolmap.Reconstruction(mapped_alone)


def adjustment(survey: Survey) -> AdjustmentWithRanges:
    assert survey.images.times is not None
    times = read_image_times_csv(survey.images.times)
    return AdjustmentWithRanges(survey, read_ranging_inputs(survey), times.image_names[0], times)


def centers(model: pycolmap.Reconstruction) -> Array:
    return trajectory_from_reconstruction(model).centers


def distortion_m(model: pycolmap.Reconstruction, walked: WalkedSurvey) -> float:
    """Return the root mean square error after the best similarity."""
    found = centers(model)
    return rmse(align_points(found, walked.centers_m).apply(found) - walked.centers_m)


def only_first(model: pycolmap.Reconstruction, num: int) -> None:
    """Deregister all frames but the first ones."""
    for frame_id in sorted(model.reg_frame_ids())[num:]:
        model.deregister_frame(frame_id)


def test_drift_is_bent_back(survey: Survey, model: pycolmap.Reconstruction, walked_survey: WalkedSurvey) -> None:
    drift_m = distortion_m(model, walked_survey)
    adjust = adjustment(survey)
    assert adjust.adjust(model)
    assert distortion_m(model, walked_survey) < 0.5 * drift_m
    assert adjust.note() == "ranges were used in 1 of 1 global adjustments of the map while it grew"


@pytest.mark.parametrize(
    ("num_keyframes", "max_relative_stddev"), [(4, 0.1), (40, 1e-6)], ids=["few keyframes", "scale not certain"]
)
def test_a_map_whose_scale_is_open_is_left_to_colmap_as_it_is(
    survey: Survey, model: pycolmap.Reconstruction, num_keyframes: int, max_relative_stddev: float
) -> None:
    only_first(model, num_keyframes)
    before = centers(model)
    adjust = adjustment(survey.changed({"scale.max_relative_stddev": max_relative_stddev}))
    assert not adjust.adjust(model)
    assert np.array_equal(centers(model), before)
    assert adjust.note() == "ranges were used in 0 of 1 global adjustments of the map while it grew"


def test_anchors_in_the_first_camera_serve_as_unknown_ones_until_it_is_there(
    survey: Survey, model: pycolmap.Reconstruction, walked_survey: WalkedSurvey
) -> None:
    """Positions that refer to a photo which is not in the map yet would bend it wrongly."""
    drift_m = distortion_m(model, walked_survey)
    path = walked_survey.folder / "anchors_first_camera.csv"
    anchors = survey.changed({"anchors.path": path, "anchors.frame": "first_camera"})
    assert anchors.images.times is not None
    times = read_image_times_csv(anchors.images.times)
    adjust = AdjustmentWithRanges(anchors, read_ranging_inputs(anchors), "another.jpg", times)
    assert adjust.adjust(model)
    assert distortion_m(model, walked_survey) < 0.5 * drift_m


def test_ranges_held_out_of_the_result_have_no_say_while_the_map_is_a_part_of_it(
    survey: Survey, model: pycolmap.Reconstruction
) -> None:
    survey = survey.changed({"ranges.check_share": 0.2})
    adjust = adjustment(survey)
    assert survey.images.times is not None
    whole = trajectory_from_reconstruction(model, read_image_times_csv(survey.images.times).by_name())
    log = read_ranging_inputs(survey).log
    placed = hold_out(
        associate(log, whole, survey.tag.tag_in_cam_m, time_offset_s=2.0), survey.ranges, survey.output.seed
    )
    is_check = placed.status == RangeStatus.CHECK
    assert np.mean(is_check) == pytest.approx(0.2, abs=0.03)
    only_first(model, 30)
    other = pycolmap.Reconstruction(model)
    assert adjust.adjust(model)
    spoilt = adjustment(survey)
    spoilt.measured = replace(spoilt.measured, log=replace(log, range_m=log.range_m + 0.5 * is_check))
    assert spoilt.adjust(other)
    assert np.array_equal(centers(other), centers(model))


def test_the_clocks_offset_is_found_on_the_way(survey: Survey, walked_survey: WalkedSurvey) -> None:
    model = pycolmap.Reconstruction(walked_survey.folder / "sparse" / "0")
    adjust = adjustment(survey.changed({"ranges.path": walked_survey.folder / "uwb.csv", "ranges.time_offset": "auto"}))
    assert adjust.adjust(model)
    assert distortion_m(model, walked_survey) < 0.02


def test_inputs_change_with_what_the_map_will_depend_on(survey: Survey, tmp_path: Path) -> None:
    inputs = adjustment(survey).inputs
    assert adjustment(survey.changed({"output.path": Path("elsewhere")})).inputs == inputs
    moved = Path(shutil.copy(tmp_path / "uwb.csv", tmp_path / "moved.csv"))
    assert adjustment(survey.changed({"ranges.path": moved})).inputs == inputs
    moved.write_text(moved.read_text().rstrip("\n").rpartition("\n")[0] + "\n")
    assert adjustment(survey.changed({"ranges.path": moved})).inputs != inputs
    assert adjustment(survey.changed({"refine.range_loss_scale": 9.0})).inputs != inputs


def test_a_run_maps_with_ranges_where_it_is_asked_to(photo_run: PhotoRun, tmp_path: Path) -> None:
    before = json.loads((photo_run.output_path / "result.json").read_text())
    output = shutil.copytree(photo_run.output_path, tmp_path / "out")
    asked = {
        "output.path": str(output),
        "ranges.time_offset": TIME_OFFSET_S,
        "mapper.num_threads": 1,
        # Fewer global adjustments than usual, to be quicker.
        "mapper.ba_global_max_refinements": 1,
        "mapper.ba_global_frames_ratio": 2.0,
        "mapper.ba_global_points_ratio": 10.0,
        "mapper.ranges_in_mapping": True,
        "report.enabled": False,
        "refine.covariance": False,
    }
    result = run_survey(read_survey(photo_run.survey.survey_path, asked), progress=SilentProgress()).summary
    assert set(result.seconds) >= {"mapping", "scale", "refinement"}
    assert "matching" not in result.seconds
    (note,) = [warning for warning in result.warnings if warning.startswith("ranges were used in")]
    num_with, num = (int(word) for word in note.split() if word.isdigit())
    assert 0 < num_with < num
    assert result.comparison[-1].rmse_m < 1.2 * before["comparison"][-1]["rmse_m"]

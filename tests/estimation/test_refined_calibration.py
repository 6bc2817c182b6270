"""A given calibration beside photos that determine a better one, or do not."""

from __future__ import annotations

import numpy as np
import pycolmap
import pytest
from tests.estimation.test_with_ranges import Survey, make_survey

from rangesfm.estimation.map_problem import add_calibration, parameter_stddevs
from rangesfm.options import CameraOptions, RefineOptions
from rangesfm.solver.bundle_adjustment import bundle_adjustment


@pytest.fixture(scope="module")
def survey() -> Survey:
    """A survey whose map was made with a focal length that is off by 2 %."""
    made = make_survey(pixel_stddev=0.5)
    camera = made.sfm.camera(1)
    params = np.array(camera.params)
    params[list(camera.focal_length_idxs())] *= 1.02
    camera.params = params.tolist()
    return made


def refined_focal_length(survey: Survey, **options: float | bool | None) -> float:
    camera = survey.sfm.camera(1)
    given = CameraOptions(model=camera.model_name, params=tuple(camera.params.tolist())).changed(**options)
    refined, _ = survey.refine(survey.anchors(0.0), camera=given)
    return refined.camera(1).mean_focal_length() / camera.mean_focal_length() * 1.02


def test_is_put_right_by_photos_that_know_better(survey: Survey) -> None:
    assert refined_focal_length(survey, focal_length_stddev_px=100.0) == pytest.approx(1.0, abs=3e-3)


def test_counts_for_as_much_as_it_is_certain(survey: Survey) -> None:
    found = [refined_focal_length(survey, focal_length_stddev_px=stddev) for stddev in (0.001, None, 15.0)]
    assert found[0] == pytest.approx(1.02, abs=1e-3)
    assert found[0] - 0.003 > found[1] > found[2] + 0.003


@pytest.mark.parametrize("kept", [{"focal_length_stddev_px": 0.0}, {"refine_intrinsics": False}])
def test_is_kept_to_the_digit_on_demand(survey: Survey, kept: dict[str, float | bool]) -> None:
    assert refined_focal_length(survey, **kept) == 1.02


def test_leaves_open_by_which_parameter_it_is_off_at_the_edge_of_the_photo() -> None:
    camera = pycolmap.Camera.create_from_model_name(1, "OPENCV", 400.0, 640, 480)
    found = parameter_stddevs(camera, 2.0)
    x, y = 320 / 400, 240 / 400
    r2, shift_px = x * x + y * y, 2.0 * np.hypot(x, y)
    assert found[:2] == pytest.approx([2.0, 2.0])
    assert found[4:6] == pytest.approx(
        [shift_px / (400 * np.hypot(x, y) * r2), shift_px / (400 * np.hypot(x, y) * r2**2)], rel=1e-4
    )


def test_of_several_tables_each_camera_has_its_own_or_none() -> None:
    options = pycolmap.SyntheticDatasetOptions(num_rigs=3, num_cameras_per_rig=1, num_frames_per_rig=3, num_points3D=50)
    model = pycolmap.synthesize_dataset(options)
    model_name, params = model.camera(1).model_name, tuple(model.camera(1).params.tolist())
    kept = CameraOptions(images="camera000001*", model=model_name, params=params, focal_length_stddev_px=0.0)
    drawn = CameraOptions(images="camera000002*", model=model_name, params=params, focal_length_stddev_px=5.0)
    camera = CameraOptions(others=(kept, drawn))
    bundle = bundle_adjustment(model, camera, RefineOptions(max_num_iterations=1), num_threads=1)
    problem, before = bundle.adjuster.problem, bundle.adjuster.problem.num_residuals()
    add_calibration(bundle, camera)
    assert problem.num_residuals() == before + len(params)
    found = [
        problem.has_parameter_block(block) and not problem.is_parameter_block_constant(block)
        for block in (model.camera(k).params for k in (1, 2, 3))
    ]
    assert found == [False, True, False]

"""A given calibration beside photos that know better, or do not."""

from __future__ import annotations

import numpy as np
import pycolmap
import pytest
from tests.refine.test_with_ranges import Survey, make_survey

from rangesfm.options import CameraOptions
from rangesfm.refine.calibration import parameter_stddevs


@pytest.fixture(scope="module")
def survey() -> Survey:
    """Its mapper kept to a calibration that is off by 2 %."""
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

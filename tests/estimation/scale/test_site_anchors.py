"""Few, coplanar or collinear site anchors: what gravity or the camera's side adds, and what stays open."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import pytest

from rangesfm.demo.simulated_radio import Radio
from rangesfm.diagnostics.place import by_similarity
from rangesfm.errors import GeometryError
from rangesfm.options import ScaleOptions

if TYPE_CHECKING:
    from tests.estimation.scale.conftest import MakeSurvey, Survey

Array = npt.NDArray[np.float64]

NOISE = Radio(range_stddev_m=0.03)
FLAT_ANCHORS_M = {"A": (6.0, 0.0, 1.0), "B": (-6.0, 1.0, 1.0), "C": (0.5, 6.0, 1.0), "D": (1.0, -6.0, 1.0)}
TWO_ANCHORS_M = {"A": (6.0, 0.0, 2.5), "B": (-6.0, 1.0, 0.4)}
ONE_ANCHOR_M = {"A": (6.0, 0.0, 2.5)}


def flat_loop(make_survey: MakeSurvey, slope: float = 0.0) -> Array:
    centers = make_survey().centers_m.copy()
    centers[:, 2] = 2.4 + slope * centers[:, 0]
    return centers


def up_of(survey: Survey, off_deg: float = 0.0) -> tuple[float, float, float]:
    """Return the upward direction in the first camera's frame, wrong by some degrees."""
    off = np.deg2rad(off_deg)
    x, y, z = survey.world_from_cam[0].T @ [np.sin(off), 0.0, np.cos(off)]
    return float(x), float(y), float(z)


def heights(survey: Survey, options: ScaleOptions) -> tuple[Array, float]:
    """Return the heights of the path, and the stated stddev of their mean."""
    estimate = survey.scale("site", "ABCD", options=options)
    assert survey.relative_error(estimate) == pytest.approx(0.0, abs=0.02)
    assert estimate.placement is not None
    centers_m = estimate.metric_from_sfm.apply(survey.trajectory.centers)
    return centers_m[:, 2], float(np.sqrt(by_similarity(estimate.placement, centers_m)[0][6, 6]))


def test_the_side_that_is_told_places_a_flat_path_among_anchors_in_a_plane(make_survey: MakeSurvey) -> None:
    # With the tag at the camera, the camera is mirrored exactly as the tag is.
    survey = make_survey(
        centers_m=flat_loop(make_survey), anchors_m=FLAT_ANCHORS_M, radio=NOISE, num_epochs=2, tag_in_cam_m=(0, 0, 0)
    )
    # The other side is the mirror image, which the ranges cannot distinguish.
    for options, height_m in ((ScaleOptions(camera_side="above"), 2.4), (ScaleOptions(camera_side="below"), -0.4)):
        above_m, stddev_m = heights(survey, options)
        assert stddev_m < 0.3
        assert abs(above_m.mean() - height_m) < 3 * stddev_m


def test_gravity_rules_out_the_mirror_image_of_a_slope_but_not_of_a_level_path(make_survey: MakeSurvey) -> None:
    slope = make_survey(centers_m=flat_loop(make_survey, 0.3), anchors_m=FLAT_ANCHORS_M, radio=NOISE, num_epochs=2)
    estimate = slope.scale("site", "ABCD", options=ScaleOptions(up_in_first_camera=up_of(slope, off_deg=2.0)))
    np.testing.assert_allclose(estimate.metric_from_sfm.apply(slope.trajectory.centers), slope.centers_m, atol=0.3)
    level = make_survey(centers_m=flat_loop(make_survey), anchors_m=FLAT_ANCHORS_M, radio=NOISE, num_epochs=2)
    of_scale = level.scale("site", "ABCD", options=ScaleOptions(up_in_first_camera=up_of(level)))
    assert of_scale.frame == "first_camera"
    assert any("mirror image" in reason and "camera_side" in reason for reason in of_scale.reasons)


@pytest.mark.parametrize(("tilt", "seed"), [(0.0, 0), (0.0, 1), (0.3, 0)], ids=["parallel", "again", "tilted"])
def test_a_flat_path_among_anchors_in_a_plane_has_a_scale_and_no_place(
    make_survey: MakeSurvey, tilt: float, seed: int
) -> None:
    """Its mirror image fits too; for a path parallel to the anchors' plane, that is the same map at another height."""
    survey = make_survey(centers_m=flat_loop(make_survey, tilt), anchors_m=FLAT_ANCHORS_M, radio=NOISE, seed=seed)
    estimate = survey.scale("site", "ABCD")
    assert estimate.frame == "first_camera"
    assert "the map gets metres, but no place in the site: the map and its mirror image" in estimate.reasons[-1]
    assert abs(survey.relative_error(estimate)) < estimate.uncertainty.half_width_95 < 0.1


def test_a_path_that_is_not_flat_contradicts_the_wrong_side(make_survey: MakeSurvey) -> None:
    centers = flat_loop(make_survey)
    centers[:, 2] += 0.8 * np.sin(np.linspace(0.0, 20.0, len(centers)))
    survey = make_survey(centers_m=centers, anchors_m=FLAT_ANCHORS_M, radio=NOISE, num_epochs=2)
    with pytest.raises(GeometryError, match="above the anchors' plane, not below as said"):
        survey.scale("site", "ABCD", options=ScaleOptions(camera_side="below"))


def test_beside_an_upright_plane_of_anchors_above_says_nothing(make_survey: MakeSurvey) -> None:
    wall = {"A": (7.0, -5.0, 0.5), "B": (7.0, 5.0, 0.3), "C": (7.0, 0.0, 4.0), "D": (7.0, 2.0, 2.0)}
    survey = make_survey(anchors_m=wall, radio=NOISE)
    with pytest.raises(GeometryError, match="upright plane"):
        survey.scale("site", "ABCD", options=ScaleOptions(camera_side="above"))


def test_two_anchors_and_gravity_fix_the_whole_map(make_survey: MakeSurvey) -> None:
    survey = make_survey(anchors_m=TWO_ANCHORS_M)
    estimate = survey.scale("site", "AB", options=ScaleOptions(up_in_first_camera=up_of(survey)))
    assert estimate.frame == "site"
    truth = survey.truth("site")
    np.testing.assert_allclose(estimate.metric_from_sfm.rotation, truth.rotation, atol=1e-5)
    centers = survey.trajectory.centers
    np.testing.assert_allclose(estimate.metric_from_sfm.apply(centers), truth.apply(centers), atol=1e-4)


def test_two_anchors_above_each_other_leave_the_heading_open(make_survey: MakeSurvey) -> None:
    survey = make_survey(anchors_m={"A": (6.0, 0.0, 0.2), "B": (6.0, 0.1, 4.0)})
    estimate = survey.scale("site", "AB", options=ScaleOptions(up_in_first_camera=up_of(survey)))
    assert estimate.frame == "first_camera"
    assert any("let the map turn about their line freely" in reason for reason in estimate.reasons)


def test_a_level_line_of_anchors_is_in_a_level_plane_where_gravity_is_known(make_survey: MakeSurvey) -> None:
    survey = make_survey(
        centers_m=flat_loop(make_survey),
        anchors_m={"A": (6.0, 0.0, 1.0), "B": (-6.0, 1.0, 1.0)},
        radio=NOISE,
        num_epochs=2,
        tag_in_cam_m=(0, 0, 0),
    )
    for side, height_m in (("above", 2.4), ("below", -0.4)):
        options = ScaleOptions.model_validate({"camera_side": side, "up_in_first_camera": up_of(survey)})
        estimate = survey.scale("site", "AB", options=options)
        np.testing.assert_allclose(estimate.metric_from_sfm.apply(survey.trajectory.centers)[:, 2], height_m, atol=0.15)


def test_one_anchor_and_gravity_give_the_cameras_height_and_its_distance(make_survey: MakeSurvey) -> None:
    survey = make_survey(anchors_m=ONE_ANCHOR_M)
    estimate = survey.scale("site", "A", options=ScaleOptions(up_in_first_camera=up_of(survey)))
    assert estimate.frame == "first_camera"
    (reason,) = (reason for reason in estimate.reasons if "site height" in reason)
    numbers = [float(number) for number in re.findall(r"\d+\.\d+", reason)]
    away = np.linalg.norm((survey.anchors_m["A"] - survey.centers_m[0])[:2])
    np.testing.assert_allclose(numbers, [survey.centers_m[0, 2], away], atol=0.006)
    assert "direction is not determined" in reason


def test_the_distance_between_two_surveyed_anchors_steadies_the_scale(make_survey: MakeSurvey) -> None:
    surveys = [make_survey(anchors_m=TWO_ANCHORS_M, radio=NOISE, seed=seed) for seed in range(4)]
    with_distance = [survey.scale("site", "AB") for survey in surveys]
    without = [survey.scale("unknown") for survey in surveys]
    formal = np.array([[e.uncertainty.formal for e in estimates] for estimates in (with_distance, without)])
    assert np.all(formal[0] < 0.8 * formal[1])
    errors = [survey.relative_error(e) / e.uncertainty.formal for survey, e in zip(surveys, with_distance, strict=True)]
    assert np.sqrt(np.mean(np.square(errors))) < 2.0


def test_a_path_in_the_plane_of_the_anchors_is_on_neither_side(make_survey: MakeSurvey) -> None:
    """Neither rounding nor the given side changes the result."""
    centers = make_survey().centers_m * [1.0, 1.0, 0.0] + [0.0, 0.0, 1.0]
    survey = make_survey(centers_m=centers, anchors_m=FLAT_ANCHORS_M, tag_in_cam_m=(0, 0, 0))
    for side in ("above", "below"):
        estimate = survey.scale("site", "ABCD", options=ScaleOptions(camera_side=side))
        np.testing.assert_allclose(estimate.metric_from_sfm.apply(survey.trajectory.centers), centers, atol=1e-6)

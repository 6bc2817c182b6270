"""Starts of the range equation where symmetry leaves two solutions that only rounding tells apart."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from rangesfm.demo.simulated_radio import Radio
from rangesfm.geometry.similarity import IDENTITY, path_shape
from rangesfm.options import RangeModelOptions
from rangesfm.scale.range_equation import RangeProblem, RangeState
from rangesfm.scale.scale_problem import scale_problem
from rangesfm.scale.starts import choose_sides, complete_unknown_anchors, sphere_swaps

if TYPE_CHECKING:
    from tests.scale.conftest import MakeSurvey, Survey


def unknown_anchors(survey: Survey) -> RangeProblem:
    anchors = survey.anchors("unknown", "")
    return scale_problem(survey.observations(), survey.trajectory, anchors, "unknown", RangeModelOptions()).ranges


@pytest.mark.parametrize("seed", range(4))
def test_on_which_side_of_a_flat_path_an_anchor_is_put_does_not_hang_on_rounding(
    make_survey: MakeSurvey, seed: int
) -> None:
    """Both sides fit alike; the side of the path's normal is taken, wherever the anchor was assumed to be."""
    centers = make_survey(seed=seed).centers_m * [1.0, 1.0, 0.0]
    survey = make_survey(
        scale=1.0, centers_m=centers, tag_in_cam_m=(0, 0, 0), radio=Radio(range_stddev_m=0.05), seed=seed
    )
    problem = unknown_anchors(survey)
    to_model = survey.frame_from_site("first_camera")
    shape = path_shape(problem.centers)
    for turned in (1.0, -1.0):
        thought = np.array(list(survey.anchors_m.values())) * [1.0, 1.0, turned]
        state, _, rise = choose_sides(problem, RangeState(IDENTITY, to_model.apply(thought), np.zeros(5)))
        heights = (state.anchors_m - shape.centroid) @ shape.axes[:, 2]
        assert heights.min() > -1e-3  # one anchor is in the plane
        assert heights.max() > 2.0
        np.testing.assert_allclose(rise, 0.0, atol=1e-6)


@pytest.mark.parametrize("turned", [1.0, -1.0])
def test_a_path_that_is_nearly_flat_tells_the_sides_of_its_anchors(make_survey: MakeSurvey, turned: float) -> None:
    centers = make_survey().centers_m * [1.0, 1.0, 0.1]
    anchors_m = {"A": (6.0, 0.0, 3.0 * turned), "B": (0.0, 6.0, -3.0 * turned)}
    survey = make_survey(scale=1.0, centers_m=centers, anchors_m=anchors_m)
    true_m = survey.frame_from_site("first_camera").apply(np.array(list(anchors_m.values())))
    state, _, rise = choose_sides(unknown_anchors(survey), RangeState(IDENTITY, true_m, np.zeros(2)))
    np.testing.assert_allclose(state.anchors_m, true_m, atol=1e-6)
    assert rise.min() > 0


def test_unknown_anchors_are_found_from_a_path_that_has_its_place_whatever_was_thought_of_them(
    make_survey: MakeSurvey,
) -> None:
    survey = make_survey(scale=1.0)
    true_m = survey.frame_from_site("first_camera").apply(np.array(list(survey.anchors_m.values())))
    thought_m = true_m + 100.0
    found = complete_unknown_anchors(unknown_anchors(survey), RangeState(IDENTITY, thought_m, np.zeros(5)))
    np.testing.assert_allclose(found.anchors_m, true_m, atol=1e-6)


@pytest.mark.parametrize("off_m", [0.0, 1e-15])
def test_an_anchor_in_the_middle_of_a_sphere_swaps_places_with_no_radius(make_survey: MakeSurvey, off_m: float) -> None:
    rng = np.random.default_rng(0)
    on_sphere = rng.normal(size=(40, 3))
    on_sphere *= 4.0 / np.linalg.norm(on_sphere, axis=1, keepdims=True)
    survey = make_survey(
        scale=1.0, centers_m=on_sphere, anchors_m={"A": (0, 0, 0), "B": (9, 0, 0)}, tag_in_cam_m=(0, 0, 0)
    )
    to_model = survey.frame_from_site("first_camera")
    anchors = to_model.apply(np.array([[0.0, 0.0, 0.0], [9.0, 0.0, 0.0]])) + off_m
    (swap,) = sphere_swaps(unknown_anchors(survey), RangeState(IDENTITY, anchors, np.zeros(2)))
    assert swap.metric_from_model.scale == pytest.approx(9 / 4)

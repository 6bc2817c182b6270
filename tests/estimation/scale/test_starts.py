"""Starts of the range equation: what each sweep finds, and where symmetry leaves two solutions that fit alike."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation

from rangesfm.demo.simulated_radio import Radio
from rangesfm.measurements.ranges.scale import starts
from rangesfm.measurements.ranges.scale.range_equation import RangeProblem, RangeState, predicted_ranges
from rangesfm.measurements.ranges.scale.range_start import RangesOnPath
from rangesfm.measurements.ranges.scale.scale_problem import scale_problem
from rangesfm.measurements.ranges.scale.starts import (
    choose_sides,
    complete_unknown_anchors,
    site_starts,
    sphere_swaps,
)
from rangesfm.solver.bending import WalkBending
from rangesfm.util.geometry.gravity import UP_IN_SITE, Gravity
from rangesfm.util.geometry.similarity import IDENTITY, Similarity, path_shape

if TYPE_CHECKING:
    from tests.estimation.scale.conftest import MakeSurvey, Survey

Array = npt.NDArray[np.float64]

SITE_M = np.array([[6.0, 0.0, 2.5], [-6.0, 1.0, 0.4], [0.5, 6.0, 3.0], [1.0, -6.0, 0.2], [5.0, 5.0, 1.0]])


def wavy_path(num: int) -> Array:
    """Return a path that is neither flat nor round, of about 2 units."""
    at = np.linspace(0.0, 5.0, num)
    return np.stack([2 * np.cos(at), 1.5 * np.sin(at), 0.5 * np.sin(2.3 * at)], axis=1)


def placed_at(similarity: Similarity, num: int = 60, gravity: Gravity | None = None) -> RangeProblem:
    """Return exact ranges from a path at a known place among five surveyed anchors, with arms and biases."""
    bias_m = np.array([0.3, -0.2, 0.1, 0.0, 0.4])
    at = RangeProblem(
        centers=wavy_path(num),
        tag_from_center=np.random.default_rng(0).normal(0.0, 0.3, (num, 3)),
        anchor_index=np.arange(num) % len(SITE_M),
        range_m=np.ones(num),
        stddev_m=np.full(num, 0.1),
        anchor_mean_m=SITE_M,
        anchor_stddev_m=np.zeros(len(SITE_M)),
        bias_mean_m=bias_m,
        bias_stddev_m=np.zeros(len(SITE_M)),
        common_bias_stddev_m=0.0,
        frame_is_free=True,
        share=np.ones(num),
        gravity=gravity,
    )
    return replace(at, range_m=predicted_ranges(at, RangeState(similarity, SITE_M, bias_m)))


def unknown_anchors(survey: Survey) -> RangeProblem:
    anchors = survey.anchors("unknown", "")
    bending = WalkBending(survey.trajectory)
    given = RangesOnPath(survey.observations(), bending, anchors, "unknown")
    return scale_problem(given).ranges


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
        # An anchor in the plane is its own mirror image.
        assert np.abs(heights[np.isinf(rise)]).max(initial=0.0) < 1e-3
        np.testing.assert_allclose(rise[np.isfinite(rise)], 0.0, atol=1e-6)


@pytest.mark.parametrize("turned", [1.0, -1.0])
def test_a_path_that_is_nearly_flat_tells_the_sides_of_its_anchors(make_survey: MakeSurvey, turned: float) -> None:
    centers = make_survey().centers_m * [1.0, 1.0, 0.1]
    anchors_m = {"A": (6.0, 0.0, 3.0 * turned), "B": (0.0, 6.0, -3.0 * turned)}
    survey = make_survey(scale=1.0, centers_m=centers, anchors_m=anchors_m)
    true_m = survey.frame_from_site("first_camera").apply(np.array(list(anchors_m.values())))
    state, _, rise = choose_sides(unknown_anchors(survey), RangeState(IDENTITY, true_m, np.zeros(2)))
    np.testing.assert_allclose(state.anchors_m, true_m, atol=1e-6)
    assert rise.min() > 0


def test_an_anchor_that_is_found_in_one_place_from_both_sides_has_no_other(make_survey: MakeSurvey) -> None:
    survey = make_survey(radio=Radio(range_stddev_m=0.05))
    estimate = survey.scale("site", "ABC")
    assert [anchor.mirror_position_m for anchor in estimate.ranges.anchors] == [None] * 5


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


def test_starts_in_a_site_hold_one_near_the_truth_and_no_two_in_one_basin(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(starts, "_NUM_SCALES", 24)
    monkeypatch.setattr(starts, "_NUM_ROTATIONS", 150)
    truth = Similarity(1.7, Rotation.from_rotvec([0.4, -1.1, 2.0]).as_matrix(), np.array([0.5, -0.3, 1.2]))
    problem = placed_at(truth, 25)
    unknown = replace(
        problem,
        anchor_mean_m=np.concatenate([SITE_M, np.full((1, 3), np.nan)]),
        anchor_stddev_m=np.append(np.zeros(5), np.inf),
        bias_mean_m=np.append(problem.bias_mean_m, 0.25),
        bias_stddev_m=np.zeros(6),
    )
    found = site_starts(unknown, seed=1)
    placed = [start.metric_from_model for start in found]
    assert 2 <= len(found) <= 12
    off = [np.linalg.norm(each.apply(problem.centers) - truth.apply(problem.centers), axis=1).max() for each in placed]
    assert min(off[:4]) < 2.5
    for k, one in enumerate(placed):
        assert not any(starts._in_one_basin(one, other) for other in placed[:k])
    for start in found:
        np.testing.assert_array_equal(start.anchors_m, np.concatenate([SITE_M, np.zeros((1, 3))]))
        np.testing.assert_array_equal(start.bias_m, unknown.bias_mean_m)
    again = site_starts(unknown, seed=1)
    np.testing.assert_array_equal(again[0].metric_from_model.rotation, placed[0].rotation)


def test_starts_in_a_site_with_a_known_vertical_are_level_and_do_not_hang_on_a_range_to_an_unknown_anchor(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(starts, "_NUM_SCALES", 30)
    up = np.array([0.6, 0.0, 0.8])
    upright, _ = Rotation.align_vectors(UP_IN_SITE[None], up[None])
    rotation = (Rotation.from_euler("z", 1.0) * upright).as_matrix()
    truth = Similarity(1.7, rotation, np.array([0.5, -0.3, 1.2]))
    level = placed_at(truth, gravity=Gravity(up, 0.05))
    found = site_starts(level)
    best = found[0].metric_from_model
    assert np.linalg.norm(best.apply(level.centers) - truth.apply(level.centers), axis=1).max() < 0.5
    for start in found:
        np.testing.assert_allclose(start.metric_from_model.rotation @ up, UP_IN_SITE, atol=1e-9)
    wild = replace(
        level,
        anchor_mean_m=np.where(np.arange(5)[:, None] == 4, np.nan, SITE_M),
        anchor_stddev_m=np.array([0.0, 0.0, 0.0, 0.1, np.inf]),
        range_m=np.where(level.anchor_index == 4, 77.0, level.range_m),
    )
    best = site_starts(wild)[0].metric_from_model
    assert np.linalg.norm(best.apply(level.centers) - truth.apply(level.centers), axis=1).max() < 1.0

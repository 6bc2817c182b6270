"""Starts of the range equation: what each sweep finds, and where symmetry leaves two solutions that fit alike."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation
from tests.simulated.range_problem import range_problem

from rangesfm.demo.simulated_radio import Radio
from rangesfm.errors import GeometryError
from rangesfm.geometry.gravity import UP_IN_SITE, Gravity
from rangesfm.geometry.similarity import IDENTITY, Similarity, path_shape
from rangesfm.options import RangeModelOptions
from rangesfm.scale import starts
from rangesfm.scale.range_equation import RangeProblem, RangeState, predicted_ranges
from rangesfm.scale.scale_problem import scale_problem
from rangesfm.scale.starts import (
    agreeing_intervals,
    choose_sides,
    complete_unknown_anchors,
    multilaterate_all,
    scale_candidates,
    site_starts,
    sphere_swaps,
)

if TYPE_CHECKING:
    from tests.scale.conftest import MakeSurvey, Survey

Array = npt.NDArray[np.float64]

AXES = np.concatenate([np.eye(3), -np.eye(3)])
SITE_M = np.array([[6.0, 0.0, 2.5], [-6.0, 1.0, 0.4], [0.5, 6.0, 3.0], [1.0, -6.0, 0.2], [5.0, 5.0, 1.0]])
QUARTER_TURN = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


def wavy_path(num: int) -> Array:
    """Return a path that is neither flat nor round, of about 2 units."""
    at = np.linspace(0.0, 5.0, num)
    return np.stack([2 * np.cos(at), 1.5 * np.sin(at), 0.5 * np.sin(2.3 * at)], axis=1)


def placed_at(similarity: Similarity, num: int = 60, gravity: Gravity | None = None) -> RangeProblem:
    """Return exact ranges from a path at a known place among five surveyed anchors, with arms and biases."""
    bias_m = np.array([0.3, -0.2, 0.1, 0.0, 0.4])
    at = range_problem(wavy_path(num), SITE_M, bias_mean_m=bias_m, gravity=gravity)
    at = replace(at, tag_from_center=np.random.default_rng(0).normal(0.0, 0.3, (num, 3)))
    return replace(at, range_m=predicted_ranges(at, RangeState(similarity, SITE_M, bias_m)))


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
    assert [anchor.mirror_position_m for anchor in estimate.anchors] == [None] * 5


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


def test_the_best_translation_of_the_true_rotation_is_the_true_one() -> None:
    truth = Similarity(1.7, Rotation.from_rotvec([0.4, -1.1, 2.0]).as_matrix(), np.array([0.5, -0.3, 1.2]))
    turns = np.stack([np.eye(3), truth.rotation, truth.rotation @ QUARTER_TURN])
    translations, costs = starts._translations(placed_at(truth), truth.scale, turns)
    assert translations.shape == (3, 3)
    np.testing.assert_allclose(translations[1], truth.translation, atol=1e-5)
    assert costs[1] < 1e-5
    assert min(costs[0], costs[2]) > 0.2


@pytest.mark.parametrize("share", [0.0, 0.25])
def test_ranges_that_are_far_too_long_do_not_move_the_translation(share: float) -> None:
    truth = Similarity(1.7, QUARTER_TURN, np.array([0.5, -0.3, 1.2]))
    exact = placed_at(truth, 80)
    wrong = np.random.default_rng(1).random(80) < share
    blocked = replace(exact, range_m=exact.range_m + np.where(wrong, 6.0, 0.0))
    translations, costs = starts._translations(blocked, truth.scale, truth.rotation[None])
    np.testing.assert_allclose(translations[0], truth.translation, atol=0.02)
    assert costs[0] < 0.02


@pytest.mark.parametrize("off_m", [0.2, -0.2])
def test_the_cost_of_a_translation_is_the_mean_error_of_the_ranges_each_up_to_three_times_the_median(
    off_m: float,
) -> None:
    """Around the middle of six anchors, ranges that err alike fit the linear equation, but not the distances."""
    alike = range_problem(np.zeros((6, 3)), 4.0 * AXES, np.full(6, 4.0 + off_m))
    translations, costs = starts._translations(alike, 1.0, np.eye(3)[None])
    np.testing.assert_allclose(translations, 0.0, atol=1e-6)
    np.testing.assert_allclose(costs, 0.2, rtol=1e-6)
    # One of thirteen is 5 m too long, and counts as 0.6 m.
    one_wrong = range_problem(np.zeros((13, 3)), 4.0 * np.concatenate([AXES, AXES, AXES[:1]]))
    range_m = np.where(np.arange(13) == 12, 9.0, 4.0 + off_m)
    translations, costs = starts._translations(replace(one_wrong, range_m=range_m), 1.0, np.eye(3)[None])
    np.testing.assert_allclose(translations, 0.0, atol=0.02)
    np.testing.assert_allclose(costs, (12 * 0.2 + 0.6) / 13, rtol=0.05)


def test_a_tag_near_an_anchor_has_a_translation_too() -> None:
    place = SITE_M[0] + [0.0, 0.03, 0.04]
    touching = range_problem(np.zeros((10, 3)), SITE_M, np.tile(np.linalg.norm(SITE_M - place, axis=1), 2))
    translations, costs = starts._translations(touching, 1.0, np.eye(3)[None])
    np.testing.assert_allclose(translations[0], place, atol=0.04)
    assert costs[0] < 0.04


def test_scales_to_try_begin_at_three_tenths_of_the_least_scale_that_explains_the_ranges() -> None:
    """A path straight away from an anchor at 2 m per unit, and 80 scales in even steps up to 200 times the first."""
    away = np.linspace(0.0, 3.0, 10)[:, None] * [1.0, 0.0, 0.0]
    scales = scale_candidates(range_problem(away, np.full((1, 3), np.nan), 1.0 + 2.0 * away[:, 0]))
    assert len(scales) == 80
    assert scales[0] == pytest.approx(0.6)
    np.testing.assert_allclose(scales[1:] / scales[:-1], 200 ** (1 / 79))


def test_only_steps_of_more_than_half_of_the_path_bound_the_scale_and_their_upper_quartile_does() -> None:
    # Steps of 10, 5.5 and 4.5 units: the first two change the range by 1 and 2 m per unit, and the quartile between
    # them is 1.75. With the third one it would be 1.5, and without the second one 1.
    centers = np.array([0.0, 4.5, 10.0])[:, None] * [0.0, 0.6, 0.8]
    least = scale_candidates(range_problem(centers, np.full((1, 3), np.nan), np.array([20.0, 21.0, 10.0])))[0] / 0.3
    assert least == pytest.approx(1.75)


def test_each_anchor_has_a_say_in_the_scales_to_try_but_only_in_its_own_ranges() -> None:
    """One anchor's ranges change by 3 m per unit and another's by 1; the quartile is between. A third is not heard."""
    centers = np.array([0.0, 0.0, 1.0, 1.0])[:, None] * [1.0, 0.0, 0.0]
    two = range_problem(centers, np.full((2, 3), np.nan), np.array([50.0, 7.0, 53.0, 6.0]))
    unheard = replace(two, anchor_mean_m=np.full((3, 3), np.nan), anchor_stddev_m=np.full(3, np.inf))
    for each in (two, unheard):
        assert scale_candidates(each)[0] / 0.3 == pytest.approx(2.5)


@pytest.mark.parametrize(
    ("length", "change_m", "is_told"), [(1.0, 1e-14, False), (1e-14, 1.0, False), (1.0, 0.0, False), (1.0, 1e-9, True)]
)
def test_without_motion_or_change_of_any_range_no_scale_is_tried(length: float, change_m: float, is_told: bool) -> None:
    """Differences that rounding alone may make are none."""
    moved = range_problem(
        np.array([[0.0, 0.0, 0.0], [length, 0.0, 0.0]]), np.full((1, 3), np.nan), np.array([5.0, 5.0 + change_m])
    )
    if is_told:
        assert scale_candidates(moved)[0] == pytest.approx(0.3 * change_m / length, rel=1e-5)
    else:
        with pytest.raises(GeometryError, match="the camera hardly moved, or no range changed as it did"):
            scale_candidates(moved)


def test_anchors_are_located_at_the_true_scale_and_cost_more_at_others() -> None:
    truth = Similarity(1.7, np.eye(3), np.zeros(3))
    anchors_m, costs = multilaterate_all(placed_at(truth), np.array([1.2, 1.7, 2.4]))
    np.testing.assert_allclose(anchors_m[1], SITE_M, atol=1e-4)
    assert costs.shape == (2, 3)
    assert costs[:, 1].max() < 1e-6
    assert costs[:, [0, 2]].min() > 0.05


def test_costs_of_located_anchors_are_means_over_all_ranges_with_residuals_in_three_standard_deviations() -> None:
    """Anchors in the middle of a sphere: its linear equation fits at any scale, and distances are off by the radius."""
    sphere = np.concatenate([AXES, AXES[[0, 2, 1, 4, 3, 5]]])
    middle = range_problem(np.concatenate([sphere, AXES]), np.full((2, 3), np.nan), bias_mean_m=np.array([0.0, 0.5]))
    index = np.repeat([0, 1], [12, 6])
    # Half of the ranges have a stddev of 0.1 m, and some have a larger one: the median is in force.
    stddev_m = np.where(np.arange(18) < 5, 7.0, 0.1)
    range_m = np.where(index == 0, 4.0, 5.5)
    middle = replace(middle, anchor_index=index, range_m=range_m, stddev_m=stddev_m)
    anchors_m, costs = multilaterate_all(middle, np.array([3.4, 4.0, 5.0]))
    np.testing.assert_allclose(anchors_m, 0.0, atol=1e-6)
    np.testing.assert_allclose(costs[0], 0.0, atol=1e-9)

    def robust(off_m: float) -> float:
        return float(np.log(1 + (off_m / 0.3) ** 2))

    expected = [(12 * robust(abs(4.0 - s)) + 6 * robust(abs(5.0 - s))) / 18 for s in (3.4, 4.0, 5.0)]
    np.testing.assert_allclose(costs[1], expected, rtol=1e-6)


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


@pytest.mark.parametrize(
    ("log_scale", "turn_rad", "is_one"),
    [
        (0.29, 0.0, True),
        (-0.29, 0.0, True),
        (0.31, 0.0, False),
        (-0.31, 0.0, False),
        (0.0, 0.59, True),
        (0, 0.61, False),
    ],
)
def test_starts_are_in_one_basin_up_to_a_change_of_scale_and_a_turn(
    log_scale: float, turn_rad: float, is_one: bool
) -> None:
    one = Similarity(2.0, Rotation.from_rotvec([0.4, -1.1, 2.0]).as_matrix(), np.zeros(3))
    turn = Rotation.from_rotvec(turn_rad * np.array([0.6, 0.0, -0.8])).as_matrix()
    other = Similarity(2.0 * float(np.exp(log_scale)), one.rotation @ turn, np.array([9.0, 0.0, 0.0]))
    assert starts._in_one_basin(one, other) == is_one


def hilltops(counts: dict[float, int]) -> list[float]:
    """Return the hilltops in steps of the grid, for counts of agreeing ranges at scales given in such steps."""
    steps = np.array(sorted(counts))
    found = starts._hilltops(np.exp(0.02 * steps), np.array([counts[step] for step in steps.tolist()]))
    return [round(float(np.log(scale)) / 0.02, 6) for scale in found]


@pytest.mark.parametrize(
    ("counts", "tops"),
    [
        ({5.2: 3, 5.5: 7, 5.8: 4}, [5.5]),  # all in one cell
        ({1.5: 3, 2.5: 7, 3.5: 4}, [2.5]),  # one hill
        ({1.5: 7, 2.5: 5, 3.5: 8}, [3.5, 1.5]),  # two hills with a valley between them
        ({1.5: 7, 3.5: 8}, [3.5, 1.5]),  # not neighbours, so both are tops
        ({1.5: 6, 2.5: 8, 4.5: 8}, [2.5, 4.5]),  # of tops as high the smaller scale comes first
        ({1.5: 8, 2.5: 8, 3.5: 8, 4.5: 3}, [1.5]),  # of neighbours as high the first is the top
        ({1.5: 10, 3.5: 5, 5.5: 4}, [1.5, 3.5]),  # the least is below half of the best
        ({1.2: 4, 1.4: 9, 1.6: 9, 2.2: 7, 2.6: 8}, [1.4]),  # within a cell the first of the highest
        ({-3.5: 2, -2.5: 3, 7.1: 4, 7.2: 6, 7.3: 5}, [7.2, -2.5]),  # the last cell holds several
        ({1.5: 1, 3.5: 2}, [3.5, 1.5]),  # a single range is a hill too
        ({2.9: 5, 3.1: 6}, [3.1]),  # cells are told apart at whole steps
    ],
)
def test_hilltops_are_the_highest_scales_of_each_hill_best_first(counts: dict[float, int], tops: list[float]) -> None:
    assert hilltops(counts) == tops


@pytest.mark.parametrize("num", [12, 13])
def test_at_most_twelve_hilltops_are_kept(num: int) -> None:
    assert hilltops({2 * k + 0.5: 20 + k for k in range(num)}) == [2 * k + 0.5 for k in range(num)][::-1][:12]


def test_roots_are_those_of_the_parabola_and_real_if_it_crosses_zero_and_there_is_motion() -> None:
    # 2 (x - 1)(x - 3) = 2 x^2 - 8 x + 6; (x + 1)(x - 2) = x^2 - x - 2; one that touches 0, one above 0, and two lines.
    a = np.array([2.0, 1.0, 1.0, 1.0, 0.0, 0.0])
    b = np.array([-4.0, -0.5, -1.0, -1.0, 0.0, 2.0])
    c = np.array([6.0, -2.0, 1.0, 2.0, -1.0, 1.0])
    low, high, real = starts._roots(a, b, c)
    assert real.tolist() == [True, True, False, False, False, False]
    np.testing.assert_allclose(low[:2], [1.0, -1.0])
    np.testing.assert_allclose(high[:2], [3.0, 2.0])
    assert np.isfinite([low, high]).all()


def intervals(center: list[float], offset: list[float], range_m: float, tolerance: float) -> list[tuple[float, float]]:
    found = agreeing_intervals(np.array([center]), np.array([offset]), np.array([range_m]), np.array([tolerance]))
    return sorted(zip(*(each.tolist() for each in found), strict=True))


@pytest.mark.parametrize(
    ("length", "range_m", "tolerance", "expected"),
    [
        # 5 m from the anchor at 0 and 8 m along the ray, 3.75 m at 1.75 and 6.25 m, and 3 m at the least.
        (1.0, 4.375, 0.625, [(0.0, 1.75), (6.25, 8.0)]),
        (2.0, 4.375, 0.625, [(0.0, 0.875), (3.125, 4.0)]),
        (1.0, 3.9, 1.1, [(0.0, 8.0)]),
        # Up to sqrt(34) m, it holds the scales from -1, which are cut off; at 0 and below it is not less than 5 m.
        (1.0, (34**0.5 + 5) / 2, (34**0.5 - 5) / 2, [(8.0, 9.0)]),
        (1.0, 2.0, 0.9, []),
        # A tolerance above the range leaves no inner limit, however far.
        (1.0, 0.1, 4.9, [(0.0, 8.0)]),
    ],
)
def test_intervals_of_scales_that_agree_are_the_hand_computed_ones(
    length: float, range_m: float, tolerance: float, expected: list[tuple[float, float]]
) -> None:
    found = intervals([0.0, 0.6 * length, 0.8 * length], [3.0, -2.4, -3.2], range_m, tolerance)
    np.testing.assert_allclose(np.reshape(found, (-1, 2)), np.reshape(expected, (-1, 2)), atol=1e-9)


def test_lowest_minima_of_a_sweep_come_lowest_first_ends_and_ties_included() -> None:
    assert starts._lowest_minima(np.array([2.0, 3.0, 1.0, 5.0, 4.0])) == [2, 0, 4]
    assert starts._lowest_minima(np.array([9.0, 1.0, 9.0, 3.0, 9.0, 2.0, 9.0, 5.0, 9.0, 4.0])) == [1, 5, 3, 9, 7]
    assert starts._lowest_minima(np.array([1.0, 1.0, 2.0])) == [0, 1]

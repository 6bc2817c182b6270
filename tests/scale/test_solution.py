"""Different maps that fit the same ranges: which count as one, and which keep a scale from being determined."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation
from tests.known import known
from tests.simulated.range_problem import range_problem

from rangesfm.distances.locate_lengths import LocatedDistances
from rangesfm.errors import GeometryError
from rangesfm.geometry.gravity import Gravity
from rangesfm.geometry.similarity import IDENTITY, Similarity
from rangesfm.ranging.errors.range_errors import RangeErrors
from rangesfm.ranging.errors.robust_loss import GEMAN_MCCLURE
from rangesfm.scale import solution, starts
from rangesfm.scale.placement_prior import PlacementPrior
from rangesfm.scale.range_equation import RangeFit, RangeProblem, RangeState, columns_of, predicted_ranges
from rangesfm.scale.solution import OpenPlaceError, Solution, refuse_ambiguity, weighted

Array = npt.NDArray[np.float64]

ANCHORS_M = np.array([[6.0, 0.0, 2.5], [-6.0, 1.0, 0.4], [0.5, 6.0, 3.0], [1.0, -6.0, 0.2], [5.0, 5.0, 1.0]])
ANGLES = np.linspace(0.0, 5.0, 40)
BENT = np.stack([2 * np.cos(ANGLES), 1.5 * np.sin(ANGLES), 0.5 * np.sin(2.3 * ANGLES)], axis=1)
FLAT = BENT * [1.0, 1.0, 0.0]
CIRCLE = np.stack([np.cos(ANGLES), np.sin(ANGLES), 0.0 * ANGLES], axis=1)
TURN = Rotation.from_rotvec([0.4, -1.1, 2.0]).as_matrix()


def on_a_sphere() -> Array:
    points = np.random.default_rng(0).normal(size=(40, 3))
    return np.asarray(2.0 * points / np.linalg.norm(points, axis=1, keepdims=True))


def problem_of(centers: Array = BENT, anchors_m: Array = ANCHORS_M, *, frame_is_free: bool = True) -> RangeProblem:
    return range_problem(centers, anchors_m, frame_is_free=frame_is_free)


def state_of(scale: float, rotation: Array | None = None, translation: Array | None = None) -> RangeState:
    placed = Similarity(
        scale, np.eye(3) if rotation is None else rotation, np.zeros(3) if translation is None else translation
    )
    return RangeState(placed, ANCHORS_M.copy(), np.zeros(5))


def measured(problem: RangeProblem, truth: RangeState) -> RangeProblem:
    return replace(problem, range_m=predicted_ranges(problem, truth))


def errors_of(problem: RangeProblem, inflation: float = 1.0) -> RangeErrors:
    num = len(problem.range_m)
    zeros, label = np.zeros(num), np.zeros(num, dtype=np.int64)
    return RangeErrors(
        stddev_m=np.full(num, 0.2),
        share=np.full(num, 0.7),
        inflation=inflation,
        given_m=np.full(num, np.nan),
        shared_m=zeros,
        placing_m=zeros,
        anchor_index=problem.anchor_index,
        block=label,
        place=label,
        loss=GEMAN_MCCLURE,
        common_bias_stddev_m=0.0,
    )


def fit_of(problem: RangeProblem, state: RangeState, cost: float = 0.0, weights: Array | None = None) -> RangeFit:
    num, columns = len(problem.range_m), columns_of([problem])
    return RangeFit(
        state,
        np.zeros(num),
        np.ones(num) if weights is None else weights,
        cost,
        np.eye(columns[0].num),
        np.zeros((num, columns[0].num)),
        columns,
    )


def found(
    problem: RangeProblem,
    state: RangeState,
    *,
    cost: float = 10.0,
    weights: Array | None = None,
    inflation: float = 1.0,
    noise_m: float = 0.1,
) -> Solution:
    return Solution(problem, fit_of(problem, state, cost, weights), errors_of(problem, inflation), noise_m)


Costing = Callable[[dict[int, float]], None]


@pytest.fixture
def costing(monkeypatch: pytest.MonkeyPatch) -> Costing:
    """Return a function that says what the rivals cost, by ten times their scale; each stays where it is."""

    def say(costs: dict[int, float]) -> None:
        def solved(problem: RangeProblem, start: RangeState, **_: Any) -> RangeFit:
            return fit_of(problem, start, costs[round(10 * start.metric_from_model.scale)])

        monkeypatch.setattr(solution, "solve", solved)

    return say


def test_the_error_of_an_open_place_carries_the_fit_into_the_first_camera_and_keeps_its_ranges() -> None:
    problem = replace(problem_of(), tag_from_center=np.random.default_rng(0).normal(0.0, 0.3, (40, 3)))
    fitted = replace(state_of(2.0, TURN, np.array([1.0, -2.0, 3.0])), bias_m=np.arange(5) / 10)
    carried = OpenPlaceError("why", fitted).in_first_camera
    assert carried.metric_from_model.scale == 2.0
    np.testing.assert_array_equal(carried.metric_from_model.rotation, np.eye(3))
    np.testing.assert_array_equal(carried.metric_from_model.translation, np.zeros(3))
    np.testing.assert_allclose(predicted_ranges(problem, carried), predicted_ranges(problem, fitted), atol=1e-12)


def test_a_problem_is_weighted_by_its_errors_and_its_priors_by_their_inflation() -> None:
    taped = LocatedDistances.of(np.array([3.0]), np.array([0.1]), model_length=np.array([1.5]))
    whitening = np.diag(np.arange(1.0, 8.0))
    problem = replace(
        problem_of(),
        bias_stddev_m=np.array([0.0, 0.1, 0.2, np.inf, 0.4]),
        common_bias_stddev_m=0.6,
        distances=taped,
        gravity=Gravity(np.array([0.0, 0.0, 1.0]), 0.05),
        placement=PlacementPrior(IDENTITY, np.zeros(3), whitening),
    )
    after = weighted(problem, errors_of(problem, inflation=2.0))
    np.testing.assert_array_equal(after.stddev_m, np.full(40, 0.2))
    np.testing.assert_array_equal(known(after.share), np.full(40, 0.7))
    np.testing.assert_allclose(after.bias_stddev_m, [0.0, 0.05, 0.1, np.inf, 0.2])
    assert after.common_bias_stddev_m == pytest.approx(0.3)
    np.testing.assert_allclose(known(after.distances).stddev_m, [0.05])
    assert known(after.gravity).stddev_rad == pytest.approx(0.025)
    np.testing.assert_allclose(known(after.placement).whitening, 2 * whitening)
    np.testing.assert_array_equal(after.range_m, problem.range_m)
    bare = weighted(problem_of(), errors_of(problem, inflation=2.0))
    assert (bare.distances, bare.gravity, bare.placement) == (None, None, None)


@pytest.mark.parametrize(("ratio", "is_same"), [(1.029, True), (1.032, False), (1 / 1.029, True), (1 / 1.032, False)])
@pytest.mark.parametrize("frame_is_free", [True, False])
def test_two_maps_are_the_same_up_to_three_percent_of_scale(ratio: float, is_same: bool, frame_is_free: bool) -> None:
    """The size is compared about the middle of the path, so that it alone shifts nothing."""
    problem = problem_of(BENT - BENT.mean(axis=0), frame_is_free=frame_is_free)
    assert solution._are_same(problem, state_of(2.0), state_of(2.0 * ratio)) == is_same


@pytest.mark.parametrize(("turn_deg", "is_same"), [(4.9, True), (5.1, False), (-4.9, True), (-5.1, False)])
def test_two_maps_are_the_same_up_to_five_degrees_about_the_middle_of_the_path(turn_deg: float, is_same: bool) -> None:
    centers = BENT + np.array([30.0, 0.0, 0.0])
    problem, middle = problem_of(centers), centers.mean(axis=0)
    rotation = TURN @ Rotation.from_rotvec(np.deg2rad(turn_deg) * np.array([0.6, 0.8, 0.0])).as_matrix()
    turned = state_of(2.0, rotation, 2.0 * (TURN - rotation) @ middle)
    assert solution._are_same(problem, state_of(2.0, TURN), turned) == is_same
    assert solution._are_same(replace(problem, frame_is_free=False), state_of(2.0, TURN), turned)


@pytest.mark.parametrize(("share", "is_same"), [(0.049, True), (0.051, False)])
@pytest.mark.parametrize("scale", [0.5, 2.0])
def test_two_maps_are_the_same_up_to_a_shift_by_a_twentieth_of_the_path(
    share: float, is_same: bool, scale: float
) -> None:
    extent_m = scale * float(np.sqrt(np.mean(np.sum((BENT - BENT.mean(axis=0)) ** 2, axis=1))))
    shifted = state_of(scale, TURN, share * extent_m * np.array([0.0, 0.6, -0.8]))
    assert solution._are_same(problem_of(), state_of(scale, TURN), shifted) == is_same


def test_fits_of_different_maps_are_kept_best_first_and_at_most_four() -> None:
    problem = problem_of(frame_is_free=False)
    fits = [
        fit_of(problem, state_of(scale), cost) for scale, cost in ((1.0, 5.0), (1.01, 3.0), (2.0, 4.0), (2.02, 9.0))
    ]
    kept = solution._each_once(problem, fits)
    assert [fit.cost for fit in kept] == [3.0, 4.0]
    many = [fit_of(problem, state_of(2.0**k), 10.0 - k) for k in range(5)]
    assert [fit.cost for fit in solution._each_once(problem, many)] == [6.0, 7.0, 8.0, 9.0]


def test_only_ranges_to_known_anchors_and_lengths_between_points_are_left_and_the_others_are_held() -> None:
    anchors_m = ANCHORS_M.copy()
    anchors_m[3] = np.nan
    taped = LocatedDistances.of(
        np.array([3.0, 4.0]),
        np.array([0.1, 0.2]),
        model_length=np.array([np.nan, 2.0]),
        anchor_pair=np.array([[0, 1], [-1, -1]]),
    )
    problem = replace(
        problem_of(anchors_m=anchors_m),
        anchor_stddev_m=np.array([0.0, 0.1, 0.0, np.inf, 0.2]),
        bias_stddev_m=np.full(5, 0.3),
        distances=taped,
    )
    part = solution._known_only(problem)
    assert np.unique(part.anchor_index).tolist() == [0, 1, 2, 4]
    assert len(part.range_m) == 32
    assert part.anchor_stddev_m.tolist() == [0.0, 0.1, 0.0, 0.0, 0.2]
    assert part.bias_stddev_m.tolist() == [0.3, 0.3, 0.3, 0.0, 0.3]
    assert known(part.distances).distance_m.tolist() == [4.0]
    assert solution._known_only(replace(problem, distances=None)).distances is None


def test_two_standard_deviations_of_a_prior_make_a_map_less_likely_by_two() -> None:
    """The anchor with the prior has no ranges, which would tell as well."""
    problem = problem_of().subset(np.flatnonzero(np.arange(40) % 5 < 4))
    problem = replace(measured(problem, state_of(2.0)), anchor_stddev_m=np.array([0.0, 0.0, 0.0, 0.0, 0.5]))
    problem = replace(problem, range_m=problem.range_m + 0.1 * np.random.default_rng(0).normal(size=32))
    off = state_of(2.0)
    off.anchors_m[4] += [0.0, 1.0, 0.0]
    errors = errors_of(problem)
    at_prior, away = (solution._unlikeliness(problem, errors, state) for state in (state_of(2.0), off))
    assert away - at_prior == pytest.approx(2.0)
    assert solution._unlikeliness(problem, errors, state_of(2.5)) > at_prior + 10


@pytest.mark.parametrize("inflation", [1.0, 2.0])
@pytest.mark.parametrize(("gap", "is_refused"), [(-1.0, True), (4.4, True), (4.6, False)])
def test_a_map_of_another_scale_is_ruled_out_by_the_gap_of_three_standard_deviations(
    costing: Costing, gap: float, is_refused: bool, inflation: float
) -> None:
    costing({30: 10.0 + gap * inflation**2})
    best = found(problem_of(), state_of(2.0), inflation=inflation)
    if is_refused:
        with pytest.raises(GeometryError, match="two scales fit"):
            refuse_ambiguity(best, [state_of(3.0)], None)
    else:
        refuse_ambiguity(best, [state_of(3.0)], None)


@pytest.mark.parametrize(("num_outliers", "is_refused"), [(12, True), (13, False)])
def test_rivals_are_not_compared_if_more_than_three_tenths_are_outliers(
    costing: Costing, num_outliers: int, is_refused: bool
) -> None:
    """A range is an outlier below a weight of a tenth: 12 of 40 are three tenths."""
    costing({30: 10.0})
    weights = np.where(np.arange(40) < num_outliers, 0.09, 0.11)
    best = found(problem_of(), state_of(2.0), weights=weights)
    if is_refused:
        with pytest.raises(GeometryError, match="two scales fit"):
            refuse_ambiguity(best, [state_of(3.0)], None)
    else:
        refuse_ambiguity(best, [state_of(3.0)], None)


def test_the_same_map_and_one_on_the_wrong_side_are_no_rivals_but_one_after_them_is(costing: Costing) -> None:
    costing({20: 10.0, 25: 10.0, 30: 10.0})
    level = np.array([[0.0, 0.0, 2.0], [4.0, 0.0, 2.0], [4.0, 5.0, 2.0], [0.0, 5.0, 2.0], [2.0, 9.0, 2.0]])
    above, below = np.array([0.0, 0.0, 9.0]), np.array([0.0, 0.0, -9.0])
    best = found(problem_of(anchors_m=level), state_of(2.0, None, above))
    refuse_ambiguity(best, [state_of(2.0, None, above)], "above")
    no_rivals = [state_of(2.0, None, above), state_of(2.5, None, below)]
    refuse_ambiguity(best, no_rivals, "above")
    for rivals, side in (([*no_rivals, state_of(3.0, None, above)], "above"), (no_rivals, None)):
        with pytest.raises(GeometryError, match="two scales fit"):
            refuse_ambiguity(best, rivals, side)


@pytest.mark.parametrize(
    ("centers", "why"),
    [
        (np.linspace(0.0, 9.0, 40)[:, None] * [0.6, 0.0, 0.8], "the path is straight; walk a bend"),
        (
            CIRCLE,
            "the path is a flat circle, and its radius and the anchors' heights can make up for each other; "
            "walk another shape, or survey an anchor",
        ),
        (
            on_a_sphere(),
            "the path lies on a sphere, and its radius and the anchor's distance from its centre can change places; "
            "walk another shape, or add an anchor",
        ),
        (FLAT, "the path is flat; go up and down too, or add an anchor"),
        (BENT, "the path is too short or runs round the anchor; vary it, or add an anchor"),
    ],
)
def test_two_scales_that_fit_are_refused_with_both_and_with_what_to_do_about_it(
    costing: Costing, centers: Array, why: str
) -> None:
    costing({31: 10.0})
    with pytest.raises(GeometryError) as refused:
        refuse_ambiguity(found(problem_of(centers), state_of(1.23456)), [state_of(3.1)], None)
    assert str(refused.value) == f"two scales fit the ranges equally well (1.235 and 3.1 m per unit): {why}"


@pytest.mark.parametrize(("scale", "rival"), [(0.1, 3.0), (3.0, 0.1)])
def test_a_camera_that_stands_still_fits_as_well_if_either_map_is_smaller_than_the_noise(
    costing: Costing, scale: float, rival: float
) -> None:
    costing({round(10 * rival): 10.0})
    extent_m = 0.1 * float(np.sqrt(np.mean(np.sum((BENT - BENT.mean(axis=0)) ** 2, axis=1))))
    for factor, why in ((1.01, "a camera that stands still fits the ranges as well"), (0.99, "two scales fit")):
        best = found(problem_of(), state_of(scale), noise_m=factor * extent_m)
        with pytest.raises(GeometryError, match=why):
            refuse_ambiguity(best, [state_of(rival)], None)


@pytest.mark.parametrize("ratio", [0.98, 1.02])
def test_a_map_that_fits_in_another_place_at_the_same_scale_is_refused_with_its_fit(
    costing: Costing, ratio: float
) -> None:
    costing({round(20 * ratio): 10.0, 20: 10.0})
    fitted = state_of(2.0, TURN, np.array([1.0, -2.0, 3.0]))
    with pytest.raises(OpenPlaceError, match="the map and its mirror image in the anchors' plane") as refused:
        refuse_ambiguity(found(problem_of(), fitted), [state_of(2.0 * ratio)], None)
    assert refused.value.in_first_camera.metric_from_model.scale == 2.0


@pytest.mark.parametrize(("share", "is_turned"), [(0.029, True), (0.031, False)])
def test_a_nearly_straight_path_is_said_to_be_turned_about_itself(share: float, is_turned: bool) -> None:
    along = np.tile([-1.0, 1.0, -1.0, 1.0], 10)
    across = np.tile([-1.0, -1.0, 1.0, 1.0], 10)
    nearly = np.stack([along, share * across, 0.0 * along], axis=1)
    why = solution._another_place(found(problem_of(nearly), state_of(2.0)))
    assert isinstance(why, OpenPlaceError) != is_turned
    assert ("fits the ranges as well if it is turned about it: walk a bend" in str(why)) == is_turned


def posed_of(problem: RangeProblem, placing_m: float = 0.0, *, anchors_are_known: bool = True) -> Any:
    """Return what a ScaleProblem says of a problem whose noise is to be estimated."""
    return SimpleNamespace(
        ranges=problem,
        errors=errors_of(problem),
        anchors_are_known=anchors_are_known,
        placing_stddev_m=lambda scale: np.full(len(problem.range_m), placing_m * scale),
    )


def noisy(truth: RangeState, centers: Array, noise_m: float, **of_problem: Any) -> RangeProblem:
    problem = measured(problem_of(centers, **of_problem), truth)
    noise = np.random.default_rng(4).normal(0.0, noise_m, len(centers))
    return replace(problem, range_m=problem.range_m + noise)


def test_a_solution_is_weighted_by_the_noise_that_it_shows() -> None:
    problem = noisy(state_of(2.0), np.tile(BENT, (3, 1)), 0.05, frame_is_free=False)
    solved = solution.solution_from(posed_of(problem), state_of(2.1))
    assert solved.fit.state.metric_from_model.scale == pytest.approx(2.0, rel=0.005)
    assert solved.noise_stddev_m == pytest.approx(0.05, rel=0.2)
    np.testing.assert_array_equal(solved.problem.stddev_m, solved.errors.stddev_m)
    assert np.median(solved.problem.stddev_m) == pytest.approx(0.05, rel=0.3)
    assert solved.rivals == ()
    residuals_m = predicted_ranges(problem, solved.fit.state) - problem.range_m
    np.testing.assert_allclose(solved.fit.residuals_m, residuals_m, atol=1e-12)
    assert solved.errors.inflation == solved.errors.inflated(residuals_m).inflation


def test_uncertain_places_of_the_antenna_widen_the_stddevs_by_the_size_of_the_map() -> None:
    problem = noisy(state_of(2.0), np.tile(BENT, (3, 1)), 0.05, frame_is_free=False)
    solved = solution.solution_from(posed_of(problem, placing_m=0.5), state_of(2.0))
    np.testing.assert_allclose(solved.errors.placing_m, 0.5 * 2.0, rtol=0.05)
    assert solved.problem.stddev_m.min() > 0.9


def unrefined(posed: Any, start: RangeState) -> Solution:
    return found(posed.ranges, start)


def test_the_likeliest_map_is_the_solution_and_the_others_are_its_rivals(monkeypatch: pytest.MonkeyPatch) -> None:
    """The worst of four starts comes first, and two are one map."""
    problem = noisy(state_of(2.0), BENT, 0.02)
    scales = (1.5, 2.0, 1.7, 2.01)
    monkeypatch.setattr(solution, "_distinct_fits", lambda *_: [fit_of(problem, state_of(scale)) for scale in scales])
    monkeypatch.setattr(solution, "solution_from", unrefined)
    compared = []
    monkeypatch.setattr(solution, "refuse_ambiguity", lambda *each: compared.append(each))
    solved = solution.solve_scale(posed_of(problem), camera_side=None, seed=0)
    assert solved.fit.state.metric_from_model.scale == 2.0
    assert [rival.metric_from_model.scale for rival in solved.rivals] == [1.7, 1.5]
    ((best, rivals, side),) = compared
    assert best.fit is solved.fit
    assert (list(rivals), side) == (list(solved.rivals), None)


def test_only_maps_on_the_side_that_the_user_gave_are_solutions_or_rivals(monkeypatch: pytest.MonkeyPatch) -> None:
    level = ANCHORS_M * [1.0, 1.0, 0.0]
    above, below = np.array([0.0, 0.0, 4.0]), np.array([0.0, 0.0, -4.0])
    problem = measured(problem_of(FLAT, level), replace(state_of(2.0, None, above), anchors_m=level))
    states = [state_of(2.0, None, above), state_of(2.0, None, below), state_of(1.7, None, below)]
    fits = [fit_of(problem, replace(state, anchors_m=level)) for state in states]
    monkeypatch.setattr(solution, "_distinct_fits", lambda *_: fits)
    monkeypatch.setattr(solution, "solution_from", unrefined)
    monkeypatch.setattr(solution, "refuse_ambiguity", lambda *each: None)
    solved = solution.solve_scale(posed_of(problem), camera_side="below", seed=0)
    assert solved.fit.state.metric_from_model.translation[2] == -4.0
    assert [rival.metric_from_model.scale for rival in solved.rivals] == [1.7]
    with pytest.raises(GeometryError, match="check camera_side"):
        solution.solve_scale(
            posed_of(replace(problem, anchor_mean_m=level + np.array([0.0, 0.0, 9.0]))), camera_side="above", seed=0
        )


def test_a_map_that_has_its_place_is_solved_from_there_with_its_unknown_anchors(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    truth = state_of(2.0, TURN, np.array([1.0, -2.0, 3.0]))
    problem = measured(problem_of(), truth)
    problem = replace(
        problem,
        anchor_mean_m=np.where(np.arange(5)[:, None] == 3, np.nan, ANCHORS_M),
        anchor_stddev_m=np.where(np.arange(5) == 3, np.inf, 0.0),
        placement=PlacementPrior(truth.metric_from_model, np.zeros(3), np.eye(7)),
    )
    monkeypatch.setattr(solution, "solution_from", unrefined)
    begun = solution.solve_scale(posed_of(problem), camera_side=None, seed=0).fit.state
    np.testing.assert_allclose(begun.anchors_m, ANCHORS_M, atol=1e-3)
    assert begun.metric_from_model is truth.metric_from_model


def test_states_by_consensus_have_their_unknown_anchors_placed_and_are_at_most_four() -> None:
    problem = measured(problem_of(frame_is_free=False), state_of(2.0))
    unknown = replace(
        problem,
        anchor_mean_m=np.where(np.arange(5)[:, None] == 3, np.nan, ANCHORS_M),
        anchor_stddev_m=np.where(np.arange(5) == 3, np.inf, 0.0),
    )
    for each in (problem, unknown):
        states = solution._consensus_states(each)
        assert 1 <= len(states) <= 4
        assert states[0].metric_from_model.scale == pytest.approx(2.0, rel=0.02)
        np.testing.assert_allclose(states[0].anchors_m, ANCHORS_M, atol=0.3)


def test_starts_none_of_which_has_a_finite_cost_determine_no_scale(monkeypatch: pytest.MonkeyPatch) -> None:
    problem = measured(problem_of(frame_is_free=False), state_of(2.0))
    monkeypatch.setattr(solution, "solve", lambda problem, start, **_: fit_of(problem, start, np.inf))
    with pytest.raises(GeometryError, match="the scale is not determined: no scale explains the ranges"):
        solution._distinct_fits(problem, anchors_are_known=True, seed=0)


def test_a_path_among_known_and_unknown_anchors_has_one_fit_with_all_of_them() -> None:
    anchors_m = ANCHORS_M.copy()
    anchors_m[3] = np.nan
    problem = measured(problem_of(frame_is_free=False), state_of(2.0))
    problem = replace(problem, anchor_mean_m=anchors_m, anchor_stddev_m=np.array([0.0, 0.0, 0.0, np.inf, 0.0]))
    (fit,) = solution._distinct_fits(problem, anchors_are_known=True, seed=0)
    assert fit.state.metric_from_model.scale == pytest.approx(2.0, rel=1e-6)
    np.testing.assert_allclose(fit.state.anchors_m, ANCHORS_M, atol=1e-4)
    assert fit.cost < 1e-6


def test_a_flat_path_among_level_anchors_has_a_fit_on_either_side_of_them(monkeypatch: pytest.MonkeyPatch) -> None:
    """A sweep that finds one of the two is enough, as the mirror image is tried too."""
    level = ANCHORS_M * [1.0, 1.0, 0.0] + [0.0, 0.0, 2.0]
    truth = replace(
        state_of(2.0, Rotation.from_euler("z", 1.0).as_matrix(), np.array([1.0, 0.0, 4.0])), anchors_m=level
    )
    problem = measured(problem_of(FLAT, level), truth)
    monkeypatch.setattr(solution, "site_starts", lambda problem, seed: [truth])
    fits = solution._distinct_fits(problem, anchors_are_known=True, seed=0)
    heights_m = sorted(float(fit.state.metric_from_model.apply(FLAT)[:, 2].mean()) for fit in fits)
    np.testing.assert_allclose(heights_m, [0.0, 4.0], atol=1e-6)
    assert max(fit.cost for fit in fits) < 1e-9


def test_a_path_on_a_sphere_among_unknown_anchors_has_the_fit_with_radius_and_distance_swapped(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(starts, "_NUM_SCALES", 12)
    centers, anchor_m = on_a_sphere()[:20], np.array([[5.0, 0.0, 0.0]])
    one = replace(problem_of(centers, anchor_m), frame_is_free=False)
    truth = RangeState(replace(IDENTITY, scale=2.0), anchor_m, np.zeros(1))
    problem = replace(measured(one, truth), anchor_mean_m=np.full((1, 3), np.nan), anchor_stddev_m=np.array([np.inf]))
    fits = solution._distinct_fits(problem, anchors_are_known=False, seed=0)
    good = sorted(fit.state.metric_from_model.scale for fit in fits if fit.cost < 1e-3)
    # The radius is 4 m, and the anchor 5 m from the middle; in the other map it is the other way round.
    np.testing.assert_allclose(good, [2.0, 2.5], rtol=1e-4)

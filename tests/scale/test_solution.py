"""Different maps that fit the same ranges: which count as one, and which keep a scale from being determined."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation
from tests.simulated.range_problem import range_problem

from rangesfm.errors import GeometryError
from rangesfm.geometry.similarity import Similarity
from rangesfm.ranging.errors.range_errors import RangeErrors
from rangesfm.ranging.errors.robust_loss import GEMAN_MCCLURE
from rangesfm.scale import solution
from rangesfm.scale.range_equation import RangeFit, RangeProblem, RangeState, columns_of, predicted_ranges
from rangesfm.scale.solution import OpenPlaceError, Solution, refuse_ambiguity

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


@pytest.mark.parametrize("ratio", [0.98, 1.02])
def test_a_map_that_fits_in_another_place_at_the_same_scale_is_refused_with_its_fit(
    costing: Costing, ratio: float
) -> None:
    costing({round(20 * ratio): 10.0, 20: 10.0})
    fitted = state_of(2.0, TURN, np.array([1.0, -2.0, 3.0]))
    with pytest.raises(OpenPlaceError, match="the map and its mirror image in the anchors' plane") as refused:
        refuse_ambiguity(found(problem_of(), fitted), [state_of(2.0 * ratio)], None)
    assert refused.value.in_first_camera.metric_from_model.scale == 2.0


def test_starts_none_of_which_has_a_finite_cost_determine_no_scale(monkeypatch: pytest.MonkeyPatch) -> None:
    problem = measured(problem_of(frame_is_free=False), state_of(2.0))
    monkeypatch.setattr(solution, "solve", lambda problem, start, **_: fit_of(problem, start, np.inf))
    with pytest.raises(GeometryError, match="the scale is not determined: no scale explains the ranges"):
        solution._distinct_fits(problem, anchors_are_known=True, seed=0)

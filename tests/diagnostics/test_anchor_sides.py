"""The side of a nearly flat path on which an unknown anchor stands, with a map that may have drifted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from tests.known import known
from tests.studies.drifting_maps import Made, lap_of_drift, run
from tests.studies.erring_surveys import SITES
from tests.studies.erring_surveys import run as run_erring
from tests.studies.erring_surveys import surveyed as surveyed_by_drone

from rangesfm.arrays import Array
from rangesfm.diagnostics import anchor_sides
from rangesfm.diagnostics.anchor_sides import AnchorSides, likelier_sides
from rangesfm.diagnostics.linearized import ranges_on_map
from rangesfm.geometry.similarity import Similarity
from rangesfm.ranging.anchors.anchor import AnchorEstimate
from rangesfm.result.metric_result import MetricResult
from rangesfm.scale.range_equation import RangeState
from rangesfm.workflows import make_metric_map

DRIFT_M, NUM_KEYFRAMES = 0.5, 100
# As one piece, this map fits better with the anchor below the path. The anchor is above it, which is -y here.
FITS_BELOW = 1
# This one tells the sides apart neither before nor after it is refined.
TELLS_NOTHING = 2


def surveyed(seed: int) -> Made:
    return lap_of_drift(DRIFT_M, seed, "unknown", num_keyframes=NUM_KEYFRAMES)


@pytest.fixture(scope="module")
def crossed() -> MetricResult:
    return run(surveyed(FITS_BELOW), 0)


def test_an_anchor_that_drift_puts_on_the_wrong_side_is_brought_to_the_right_one(crossed: MetricResult) -> None:
    [anchor] = crossed.anchors
    truth_m = surveyed(FITS_BELOW).anchors_m["A1"]
    assert np.linalg.norm(anchor.position_m - truth_m) < 3 * np.sqrt(3) * anchor.position_stddev_m
    assert anchor.mirror_position_m is None
    assert crossed.estimate.verdict == "good", crossed.estimate.reasons


def test_without_the_second_look_the_anchor_would_be_on_the_wrong_side(monkeypatch: pytest.MonkeyPatch) -> None:
    """The survey above is one whose map of one piece misleads; a mistake was named there that nobody made."""
    monkeypatch.setattr(make_metric_map, "_with_anchors_on_likelier_sides", lambda run, start, refined: refined)
    found = run(surveyed(FITS_BELOW), 0)
    assert found.anchors[0].position_m[1] > 0


def test_an_anchor_on_the_right_side_stays_there(crossed: MetricResult) -> None:
    at = known(crossed.refined_with_ranges)
    sides = likelier_sides(ranges_on_map(at.posed, at.solution, at.bending))
    assert not sides.has_crossed
    assert sides.mirrors_m == {"A1": None}
    assert sides.of(crossed.anchors) == crossed.anchors


def test_sides_that_the_ranges_do_not_tell_apart_are_both_given() -> None:
    survey = surveyed(TELLS_NOTHING)
    found = run(survey, 0)
    [anchor] = found.anchors
    places_m = np.array([anchor.position_m, known(anchor.mirror_position_m)])
    off_m = np.linalg.norm(places_m - survey.anchors_m["A1"], axis=1)
    assert off_m.min() < 1.0
    assert off_m.max() > 10.0
    assert any("on which side of it the unknown anchors stand" in reason for reason in found.estimate.reasons)


def test_surveyed_anchors_are_left_alone(crossed: MetricResult) -> None:
    at = known(crossed.refined_with_ranges)
    on_map = ranges_on_map(at.posed, at.solution, at.bending)
    surveyed_m = replace(on_map.problem, anchor_mean_m=on_map.state.anchors_m, anchor_stddev_m=np.array([0.02]))
    assert likelier_sides(replace(on_map, problem=surveyed_m)).mirrors_m == {}


def test_a_path_that_goes_up_and_down_leaves_nothing_open() -> None:
    on_map = known(run_erring(surveyed_by_drone(SITES[2], 3), 3).on_map)
    sides = likelier_sides(on_map)
    assert sides.on_map is on_map
    assert sides.mirrors_m == {"B": None}


HERE_M, THERE_M = np.array([[1.0, 2.0, 3.0], [9.0, 9.0, 9.0]]), np.array([[1.0, 2.0, -3.0], [9.0, 9.0, 5.0]])


def a_problem(anchors_m: Array, misfit: float, deviance: float) -> Any:
    """A problem of which only the places of its anchors and how well it fits are known."""
    on_map = SimpleNamespace(
        anchor_ids=("A", "B"),
        problem=SimpleNamespace(anchor_index=np.array([0, 1, 1]), anchor_stddev_m=np.array([np.inf, 0.1])),
        state=RangeState(Similarity(1.0, np.eye(3), np.zeros(3)), anchors_m, np.zeros(2)),
    )
    problem = SimpleNamespace(on_map=on_map, misfit=misfit, deviance=deviance, scatter_m=0.5)
    problem.with_learnt_errors = lambda: problem
    return problem


def sides_of(monkeypatch: pytest.MonkeyPatch, here: Any, there: Any) -> AnchorSides:
    """Choose between two problems as if they were those of both sides."""
    monkeypatch.setattr(anchor_sides, "linearized", lambda _: here)
    monkeypatch.setattr(anchor_sides, "_settled", lambda problem, _: problem)
    monkeypatch.setattr(anchor_sides, "_on_other_side", lambda *_: there)
    monkeypatch.setattr(anchor_sides, "_misfit", lambda problem: problem.misfit)
    monkeypatch.setattr(
        anchor_sides, "Factorization", lambda problem: SimpleNamespace(deviance=lambda: problem.deviance)
    )
    return likelier_sides(here.on_map)


@pytest.mark.parametrize(
    ("misfit", "deviance", "is_crossed", "is_open"),
    [
        (108.9, -99.0, False, True),  # the residuals alone tell that the other side is no better
        (109.1, -99.0, False, False),
        (99.0, 41.1, True, True),
        (99.0, 40.9, True, False),
        (99.0, 58.9, False, True),  # it fits better only by larger errors
        (99.0, 59.1, False, False),
    ],
)
def test_the_other_side_is_ruled_out_by_a_gain_of_nine(
    misfit: float, deviance: float, is_crossed: bool, is_open: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nine is the square of three standard deviations; the anchor's own side has a misfit of 100, a deviance of 50."""
    here, there = a_problem(HERE_M, 100.0, 50.0), a_problem(THERE_M, misfit, deviance)
    found = sides_of(monkeypatch, here, there)
    assert found.has_crossed == is_crossed
    assert found.on_map is (there.on_map if is_crossed else here.on_map)
    assert [*found.mirrors_m] == ["A"]
    mirror_m = found.mirrors_m["A"]
    assert (mirror_m is not None) == is_open
    if mirror_m is not None:
        np.testing.assert_array_equal(mirror_m, HERE_M[0] if is_crossed else THERE_M[0])


@pytest.mark.parametrize(("apart_m", "is_open"), [(0.49, False), (0.51, True)])
def test_two_places_within_the_scatter_of_the_ranges_are_one(
    apart_m: float, is_open: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    near_m = HERE_M.copy()
    near_m[0, 2] -= apart_m
    found = sides_of(monkeypatch, a_problem(HERE_M, 100.0, 50.0), a_problem(near_m, 99.0, 49.0))
    assert found.has_crossed == is_open
    assert (found.mirrors_m["A"] is not None) == is_open


def test_ranges_that_determine_too_little_leave_the_anchors_where_they_are(monkeypatch: pytest.MonkeyPatch) -> None:
    here = a_problem(HERE_M, 100.0, 50.0)

    def failing(*_: object) -> None:
        raise np.linalg.LinAlgError

    monkeypatch.setattr(anchor_sides, "_likelier_sides", failing)
    found = likelier_sides(here.on_map)
    assert (found.on_map, found.has_crossed, found.mirrors_m) == (here.on_map, False, {"A": None})


def anchor_at(name: str, at_m: Sequence[float]) -> AnchorEstimate:
    return AnchorEstimate(name, np.array(at_m), 0.1, None, np.inf, 0.0, 0.0, 0.0, mirror_position_m=np.ones(3))


def test_estimates_get_their_sides_and_those_of_surveyed_anchors_stay() -> None:
    anchors = anchor_at("A", [1, 2, 4]), anchor_at("B", [8, 8, 8])
    on_map = a_problem(THERE_M, 0.0, 0.0).on_map
    first, second = AnchorSides(on_map, True, {"A": HERE_M[0]}).of(anchors)
    np.testing.assert_array_equal(first.position_m, THERE_M[0])
    np.testing.assert_array_equal(known(first.mirror_position_m), HERE_M[0])
    assert second is anchors[1]
    # If none has crossed, the estimate itself is better than the state of the tests.
    first, _ = AnchorSides(on_map, False, {"A": None}).of(anchors)
    np.testing.assert_array_equal(first.position_m, [1, 2, 4])
    assert first.mirror_position_m is None


def test_the_other_side_is_the_mirror_image_at_the_plane_of_the_anchors_own_path(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The path lies in the plane x + y = 4 of the metric world; ranges to other anchors were taken elsewhere."""
    rng = np.random.default_rng(0)
    along, up = rng.uniform(-5, 5, 30), rng.uniform(-2, 2, 30)
    path_m = np.column_stack([2 + along, 2 - along, up])
    tags_m = np.vstack([path_m, rng.uniform(20, 30, (9, 3))])
    placed = Similarity(2.0, np.eye(3)[[1, 2, 0]], np.array([1.0, -1.0, 0.5]))
    state = RangeState(placed, np.array([[5.0, 6.0, 1.0], [0.0, 0.0, 7.0]]), np.zeros(2))
    given = SimpleNamespace(
        centers=placed.inverse().apply(tags_m),
        tag_from_center=np.zeros((39, 3)),
        anchor_index=np.repeat([0, 1], [30, 9]),
    )
    problem: Any = SimpleNamespace(on_map=SimpleNamespace(problem=given, state=state))
    monkeypatch.setattr(anchor_sides, "_settled", lambda _, there: there)
    found: Any = anchor_sides._on_other_side(problem, 0)
    # The anchor is 7 / sqrt(2) m from the plane.
    np.testing.assert_allclose(found.anchors_m, [[5 - 7, 6 - 7, 1], [0, 0, 7]], atol=1e-9)
    np.testing.assert_array_equal(state.anchors_m[0], [5, 6, 1])

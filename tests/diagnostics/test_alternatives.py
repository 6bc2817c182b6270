"""Mistakes without a size: each reading of labels, axes and units is the one that its words say."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.known import known

from rangesfm.arrays import Array
from rangesfm.diagnostics import alternatives as module
from rangesfm.diagnostics.alternatives import Alternative, Refits, alternatives
from rangesfm.diagnostics.hypothesis import MEASURE_AGAIN
from rangesfm.diagnostics.linearized import RangesOnMap
from rangesfm.geometry.similarity import Similarity
from rangesfm.scale.range_equation import RangeProblem, RangeState, predicted_ranges

IDS = ("A", "B", "C", "D")
ANCHORS_M = np.array([[0.0, 0, 1], [9.0, 1, 2], [7.0, 12, 0.5], [-2.0, 8, 3]])
PLACED = Similarity(2.0, Rotation.from_rotvec([0.2, -0.5, 0.9]).as_matrix(), np.array([4.0, 5.0, 1.5]))
NUM_PLACES = 40


def places_of(found: Alternative) -> dict[str, list[float]]:
    """Corrected places of anchors, rounded to a nanometre."""
    return {name: np.round(known(at), 9).tolist() for name, at in found.correction.anchors_m.items()}


def of_coordinates(given: dict[str, Array]) -> dict[str, Alternative]:
    return {each.words: each for each in module._of_coordinates(given)}


@pytest.mark.parametrize(
    ("words", "of_first"),
    [
        ("in the anchors' coordinates x and y (east and north) are swapped, or heights are depths", [2.0, 1.0, 3.0]),
        ("in the anchors' coordinates y and z are swapped", [1.0, 3.0, 2.0]),
        ("in the anchors' coordinates x has the wrong sign", [-1.0, 2.0, 3.0]),
        (
            "in the anchors' coordinates heights have the wrong sign (they are depths), or x and y (east and north) "
            "are swapped",
            [1.0, 2.0, -3.0],
        ),
    ],
)
def test_axes_of_the_anchors_are_changed_as_the_words_say(words: str, of_first: list[float]) -> None:
    given = {"A": np.array([1.0, 2.0, 3.0]), "B": np.zeros(3), "C": np.array([0.0, 0, 5])}
    found = of_coordinates(given)[words]
    assert (found.name, found.subject) == ("anchors' axes", "")
    assert "sketch" in found.remedy
    corrected = places_of(found)
    assert corrected["A"] == of_first
    assert corrected["B"] == [0, 0, 0]
    assert [*corrected] == ["A", "B", "C"]


def on_map(**changes: Any) -> RangesOnMap:
    """Ranges of four anchors from each of some places, without noise, on a map that is true."""
    rng = np.random.default_rng(0)
    num = NUM_PLACES * len(IDS)
    centers = np.repeat(rng.uniform(-4, 4, (NUM_PLACES, 3)), len(IDS), axis=0)
    turns = np.repeat(Rotation.random(NUM_PLACES, rng=1).as_matrix(), len(IDS), axis=0)
    state = RangeState(PLACED, ANCHORS_M, np.zeros(len(IDS)))
    problem = RangeProblem(
        centers=centers,
        tag_from_center=turns @ np.array([0.3, -0.2, 0.1]),
        anchor_index=np.tile(np.arange(len(IDS)), NUM_PLACES),
        range_m=np.ones(num),
        stddev_m=np.ones(num),
        anchor_mean_m=ANCHORS_M,
        anchor_stddev_m=np.full(len(IDS), 0.02),
        bias_mean_m=np.zeros(len(IDS)),
        bias_stddev_m=np.zeros(len(IDS)),
        common_bias_stddev_m=0.0,
        frame_is_free=True,
    )
    problem = replace(problem, range_m=predicted_ranges(problem, state))
    log = SimpleNamespace(anchor_ids=IDS, tag_ids=("tag",), tag_index=np.zeros(num, dtype=np.int64))
    posed: Any = SimpleNamespace(
        observations=SimpleNamespace(log=log), rows=np.arange(num), order_given=("D", "elsewhere", "A", "B", "C")
    )
    made = RangesOnMap(
        posed=posed,
        problem=problem,
        state=state,
        model_from_cam=turns,
        velocity=None,
        time_s=np.linspace(10.0, 50.0, num),
        weights=np.ones(num),
        bending=None,
    )
    return replace(made, **changes)


def with_anchors(made: RangesOnMap, **changes: Any) -> RangesOnMap:
    return replace(made, problem=replace(made.problem, **changes))


@pytest.mark.parametrize(("num_fitting", "is_told"), [(16, False), (15, True)])  # of 40
def test_an_anchor_that_less_than_two_ranges_of_five_fit_is_elsewhere(num_fitting: int, is_told: bool) -> None:
    """Its coordinates are 3 m too far along x and 4 m too low; the ranges tell where it is."""
    made = on_map()
    weights = np.where(made.problem.anchor_index == 1, 0.09, 0.11)
    weights[np.flatnonzero(made.problem.anchor_index == 1)[:num_fitting]] = 0.11
    given_m = ANCHORS_M.copy()
    given_m[1] += [3.0, 0.001, -4.0]
    made = replace(with_anchors(made, anchor_mean_m=given_m), weights=weights)
    found = [each for each in alternatives(made) if each.name == "anchor place"]
    assert len(found) == is_told
    for each in found:
        assert (each.subject, each.remedy) == ("B", MEASURE_AGAIN)
        assert each.correction.anchors_m == {"B": None}
        assert each.words == (
            "anchor B is about 5.00 m from where its coordinates say (by -3.00, -0.00, +4.00 m in x, y, z)"
        )


def starts_of(problem: RangeProblem, seen_m: Array) -> list[RangeState]:
    """Starts of a map that sees the anchors at ``seen_m`` if it is placed by a similarity with scale 3."""
    placed = Similarity(3.0, np.eye(3), np.zeros(3))
    of: Any = SimpleNamespace(_on_map=on_map())
    return list(Refits._starts(of, problem, np.full((4, 3), 77.0), placed, seen_m))


TURNED = Similarity(1.0, Rotation.from_rotvec([0, 0, 1.0]).as_matrix(), np.array([3.0, -2.0, 1.0]))
SEEN_M = TURNED.inverse().apply(ANCHORS_M)


@pytest.mark.parametrize(("num_unseen", "num_starts"), [(1, 2), (2, 1)])
def test_a_map_is_moved_onto_three_anchors_or_more(num_unseen: int, num_starts: int) -> None:
    seen_m = SEEN_M.copy()
    seen_m[:num_unseen] = np.nan
    assert len(starts_of(on_map().problem, seen_m)) == num_starts
    unknown_m = ANCHORS_M.copy()
    unknown_m[:num_unseen, 1] = np.nan
    starts = starts_of(with_anchors(on_map(), anchor_mean_m=unknown_m).problem, SEEN_M)
    assert len(starts) == num_starts
    for start in starts:
        np.testing.assert_array_equal(start.anchors_m[:num_unseen], 77.0)
        np.testing.assert_array_equal(start.anchors_m[num_unseen:], ANCHORS_M[num_unseen:])

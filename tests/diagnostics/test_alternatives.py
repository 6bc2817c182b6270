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
from rangesfm.diagnostics.alternatives import Alternative, Refits, alternatives, lever_arms_in_other_axes
from rangesfm.diagnostics.hypothesis import MEASURE_AGAIN, Correction
from rangesfm.diagnostics.linearized import RangesOnMap
from rangesfm.geometry.similarity import Similarity
from rangesfm.scale.range_equation import RangeProblem, RangeState, predicted_ranges

IDS = ("A", "B", "C", "D")
ANCHORS_M = np.array([[0.0, 0, 1], [9.0, 1, 2], [7.0, 12, 0.5], [-2.0, 8, 3]])
GIVEN = dict(zip(IDS, ANCHORS_M, strict=True))
PLACED = Similarity(2.0, Rotation.from_rotvec([0.2, -0.5, 0.9]).as_matrix(), np.array([4.0, 5.0, 1.5]))
NUM_PLACES = 40


def places_of(found: Alternative) -> dict[str, list[float]]:
    """Corrected places of anchors, rounded to a nanometre."""
    return {name: np.round(known(at), 9).tolist() for name, at in found.correction.anchors_m.items()}


def test_each_two_labels_may_be_swapped() -> None:
    found = list(module._of_labels([], {name: GIVEN[name] for name in "ABC"}))
    assert [(each.name, each.subject) for each in found] == [
        ("labels swapped", "A, B"),
        ("labels swapped", "A, C"),
        ("labels swapped", "B, C"),
    ]
    assert found[1].words == "the labels of anchors A and C are swapped"
    assert places_of(found[1]) == {"A": ANCHORS_M[2].tolist(), "C": ANCHORS_M[0].tolist()}


def test_coordinates_may_be_of_the_line_before_or_after_if_there_are_three_lines() -> None:
    """A line that has the coordinates of the one before has its own in the line after."""
    before, after = (each for each in module._of_labels(["C", "A", "D", "B"], GIVEN) if each.name == "lines shifted")
    assert "has the coordinates of the one in the line before it in" in before.words
    assert "has the coordinates of the one in the line after it in" in after.words
    lines = dict(zip("CADB", ANCHORS_M[[0, 3, 1, 2]].tolist(), strict=True))  # C has those of A, A those of D, ...
    assert places_of(before) == lines
    lines = dict(zip("CADB", ANCHORS_M[[1, 2, 0, 3]].tolist(), strict=True))
    assert places_of(after) == lines
    assert len(list(module._of_labels(["C", "A", "D"], {name: GIVEN[name] for name in "ACD"}))) == 3 + 2
    assert len(list(module._of_labels(["C", "A"], {name: GIVEN[name] for name in "AC"}))) == 1


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


@pytest.mark.parametrize(
    ("words", "factor"),
    [
        ("the anchors' coordinates are in feet", 0.3048),
        (
            "the ranges are in feet, or metres among the anchors' coordinates were taken for feet and converted",
            1 / 0.3048,
        ),
        ("each range is the way to the anchor and back, twice the distance", 2.0),
    ],
)
def test_another_unit_changes_the_anchors_distances_about_their_middle(words: str, factor: float) -> None:
    found = of_coordinates({"A": np.array([1.0, 2.0, 3.0]), "B": np.array([5.0, 2.0, -3.0])})[words]
    assert found.name == "anchors' unit"
    assert "taped distance" in found.remedy
    np.testing.assert_allclose(known(found.correction.anchors_m["A"]), [3 - 2 * factor, 2, 3 * factor])
    np.testing.assert_allclose(known(found.correction.anchors_m["B"]), [3 + 2 * factor, 2, -3 * factor])


@pytest.mark.parametrize(("num", "num_axes", "num_units"), [(0, 0, 0), (1, 0, 0), (2, 0, 3), (3, 4, 3)])
def test_axes_of_two_anchors_and_the_unit_of_one_have_no_meaning(num: int, num_axes: int, num_units: int) -> None:
    names = [each.name for each in module._of_coordinates({name: GIVEN[name] for name in IDS[:num]})]
    assert names == num_axes * ["anchors' axes"] + num_units * ["anchors' unit"]


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


def names_of(made: RangesOnMap) -> list[str]:
    return [f"{each.name} {each.subject}".strip() for each in alternatives(made)]


def test_a_map_has_all_alternatives_that_its_anchors_and_times_allow() -> None:
    swaps = [f"labels swapped {pair}" for pair in ("A, B", "A, C", "A, D", "B, C", "B, D", "C, D")]
    first = [*swaps, *2 * ["lines shifted"], *4 * ["anchors' axes"], *3 * ["anchors' unit"]]
    arms = 5 * ["lever arm's axes"]
    made = on_map()
    assert names_of(made) == [*first, *arms]
    assert names_of(replace(made, velocity=np.zeros((len(made.time_s), 3)))) == [*first, "photos reversed", *arms]


def test_anchors_without_ranges_or_coordinates_have_no_alternatives() -> None:
    made = on_map()
    unknown_m = ANCHORS_M.copy()
    unknown_m[1, 2] = np.nan
    assert [name for name in names_of(with_anchors(made, anchor_mean_m=unknown_m)) if "swapped" in name] == [
        "labels swapped A, C",
        "labels swapped A, D",
        "labels swapped C, D",
    ]
    silent = with_anchors(made, anchor_index=np.where(made.problem.anchor_index == 1, 0, made.problem.anchor_index))
    assert not any("B" in name for name in names_of(silent))
    shifted = next(each for each in alternatives(silent) if each.name == "lines shifted")
    assert places_of(shifted) == {"D": GIVEN["A"].tolist(), "A": GIVEN["C"].tolist(), "C": GIVEN["D"].tolist()}


def test_photos_in_reverse_have_the_times_of_one_another() -> None:
    made = on_map()
    timed = replace(made, velocity=np.zeros((len(made.time_s), 3)))
    found = next(each for each in alternatives(timed) if each.name == "photos reversed")
    np.testing.assert_allclose(timed.time_s + found.correction.time_shift_s, timed.time_s[::-1])


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


def arms_read_in(made: RangesOnMap) -> dict[str, list[float]]:
    """Lever arms as they would be, right, down and forward, by the words for the axes in which they were given."""
    arm = np.median(np.einsum("nji,nj->ni", made.model_from_cam, made.problem.tag_from_center), axis=0)
    return {
        each.words: np.round(arm + each.correction.tag_moves_m["tag"], 9).tolist()
        for each in lever_arms_in_other_axes(made)
    }


def test_a_lever_arm_in_other_axes_is_turned_into_those_of_the_camera() -> None:
    """Given as 0.3, -0.2, 0.1; a camera's own axes are x right, y down, z forward."""
    own = "not x right, y down, z forward"
    assert arms_read_in(on_map()) == {
        "the lever arm has the wrong sign (from the tag to the camera, not from the camera to the tag)": [
            -0.3,
            0.2,
            -0.1,
        ],
        f"the lever arm is given along x forward, y left, z up, {own}": [0.2, -0.1, 0.3],
        f"the lever arm is given along x right, y up, z back, {own}": [0.3, 0.2, -0.1],
        f"the lever arm is given along x right, y forward, z up, {own}": [0.3, -0.1, -0.2],
        f"the lever arm is given along x forward, y right, z down, {own}": [-0.2, 0.1, 0.3],
    }


@pytest.mark.parametrize(("length_m", "num"), [(0.00049, 0), (0.00051, 1)])
def test_a_lever_arm_that_no_reading_moves_by_a_millimetre_has_no_alternatives(length_m: float, num: int) -> None:
    """A change of sign moves it by twice its length, and other axes by less."""
    made = on_map()
    arms = made.model_from_cam @ np.array([length_m, 0.0, 0.0])
    found = list(lever_arms_in_other_axes(with_anchors(made, tag_from_center=arms)))
    assert [each.words.split(" (")[0] for each in found] == num * ["the lever arm has the wrong sign"]


def test_each_tag_has_a_lever_arm_of_its_own_which_a_few_false_ones_do_not_change() -> None:
    made = on_map()
    log = made.posed.observations.log
    is_second = np.arange(len(made.time_s)) % 3 == 0
    two: Any = SimpleNamespace(
        observations=SimpleNamespace(
            log=SimpleNamespace(anchor_ids=log.anchor_ids, tag_ids=("t1", "t2"), tag_index=is_second.astype(np.int64))
        ),
        rows=np.arange(len(is_second)),
    )
    arms = np.where(is_second[:, None], [0.0, 0.5, 0.0], [0.2, 0.0, 0.0])
    arms[1::30] += 5.0
    turned = np.einsum("nij,nj->ni", made.model_from_cam, arms)
    found = module._lever_arms_m(replace(with_anchors(made, tag_from_center=turned), posed=two))
    assert [*found] == ["t1", "t2"]
    np.testing.assert_allclose(found["t1"], [0.2, 0, 0], atol=1e-12)
    np.testing.assert_allclose(found["t2"], [0, 0.5, 0], atol=1e-12)


@pytest.fixture(scope="module")
def refits() -> Refits:
    """Refits of a map that is true, but for swapped labels of A and C in the file."""
    made = on_map()
    swapped = with_anchors(made, anchor_mean_m=ANCHORS_M[[2, 1, 0, 3]])
    wrong = RangeState(replace(PLACED, translation=PLACED.translation + 2.0), ANCHORS_M[[2, 1, 0, 3]], np.zeros(4))
    return Refits(replace(swapped, state=wrong), 0.1)


def test_a_map_sees_by_itself_how_its_anchors_stand(refits: Refits) -> None:
    """Its place is the model's own, and only the scale is found; the anchors' coordinates have no part in it."""
    placed, seen_m = refits._seen
    assert placed.scale == pytest.approx(PLACED.scale, rel=1e-3)
    to_site = PLACED @ placed.inverse()
    np.testing.assert_allclose(to_site.apply(seen_m), ANCHORS_M, atol=0.02)


def test_an_anchor_that_has_no_ranges_is_not_seen() -> None:
    made = on_map()
    rows = np.flatnonzero(made.problem.anchor_index != 2)
    _, seen_m = module._anchors_by_map(made.problem.subset(rows))
    np.testing.assert_array_equal(np.isfinite(seen_m).all(axis=1), [True, True, False, True])


def test_the_right_alternative_starts_at_its_solution_and_a_wrong_one_far_from_any(refits: Refits) -> None:
    right_cost, right = refits.start(Correction({"A": GIVEN["A"], "C": GIVEN["C"]}))
    wrong_cost, wrong = refits.start(Correction({"A": GIVEN["B"], "B": GIVEN["C"]}))
    assert right_cost < 1.0
    assert wrong_cost > 100.0
    np.testing.assert_allclose(right.state.metric_from_model.apply(np.eye(3)), PLACED.apply(np.eye(3)), atol=0.05)
    np.testing.assert_allclose(right.problem.anchor_mean_m, ANCHORS_M)
    cost, fit = refits.of(right)
    assert cost < 1e-3
    np.testing.assert_allclose(fit.state.metric_from_model.translation, PLACED.translation, atol=1e-3)
    assert refits.of(wrong)[0] > 100.0


def test_refits_use_25_ranges_of_each_anchor_with_the_scatter_that_was_seen(refits: Refits) -> None:
    thin = refits._thinned(on_map())
    np.testing.assert_array_equal(np.bincount(thin.anchor_index), [25] * 4)
    np.testing.assert_array_equal(thin.stddev_m, 0.1)


def starts_of(problem: RangeProblem, seen_m: Array) -> list[RangeState]:
    """Starts of a map that sees the anchors at ``seen_m`` if it is placed by a similarity with scale 3."""
    placed = Similarity(3.0, np.eye(3), np.zeros(3))
    of: Any = SimpleNamespace(_on_map=on_map())
    return list(Refits._starts(of, problem, np.full((4, 3), 77.0), placed, seen_m))


TURNED = Similarity(1.0, Rotation.from_rotvec([0, 0, 1.0]).as_matrix(), np.array([3.0, -2.0, 1.0]))
SEEN_M = TURNED.inverse().apply(ANCHORS_M)


def test_a_map_whose_anchors_are_given_starts_as_it_is_and_moved_onto_them() -> None:
    as_it_is, moved = starts_of(on_map().problem, SEEN_M)
    for start in (as_it_is, moved):
        np.testing.assert_array_equal(start.anchors_m, ANCHORS_M)
    assert as_it_is.metric_from_model == PLACED
    np.testing.assert_allclose(moved.metric_from_model.apply(np.eye(3)), TURNED.apply(3.0 * np.eye(3)), atol=1e-9)


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


def test_a_map_in_its_own_frame_starts_with_its_anchors_where_it_sees_them() -> None:
    nowhere = with_anchors(on_map(), anchor_mean_m=np.full((4, 3), np.nan), frame_is_free=False).problem
    seen_m = SEEN_M.copy()
    seen_m[2, 0] = np.nan
    as_it_is, seen = starts_of(nowhere, seen_m)
    np.testing.assert_array_equal(as_it_is.anchors_m, 77.0)
    assert as_it_is.metric_from_model == PLACED
    assert seen.metric_from_model.scale == 3.0
    np.testing.assert_array_equal(seen.anchors_m[[0, 1, 3]], SEEN_M[[0, 1, 3]])
    np.testing.assert_array_equal(seen.anchors_m[2], 77.0)
    # With a given anchor the frame is not the map's own, and a free one has nothing to hold on to.
    assert len(starts_of(replace(nowhere, anchor_mean_m=ANCHORS_M), seen_m)) == 1
    assert len(starts_of(replace(nowhere, frame_is_free=True), seen_m)) == 1


def test_the_cost_of_a_start_is_cauchys_loss_of_residuals_in_stddevs() -> None:
    made = on_map()
    off_m = np.zeros(len(made.time_s))
    off_m[[3, 50]] = 0.2, -1.0
    problem = replace(made.problem, range_m=made.problem.range_m + off_m, stddev_m=np.full(len(off_m), 0.1))
    assert module._cost(problem, made.state) == pytest.approx(
        2.385**2 * (np.log1p((2 / 2.385) ** 2) + np.log1p((10 / 2.385) ** 2))
    )

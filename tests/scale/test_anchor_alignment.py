"""Two frames are aligned by the anchors in both: when these determine the motion, and when they do not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from rangesfm.errors import GeometryError
from rangesfm.geometry.similarity import IDENTITY, Similarity
from rangesfm.scale import anchor_alignment
from rangesfm.scale.anchor_alignment import AnchorAlignment, PlacedAnchor, align_by_anchors

Array = npt.NDArray[np.float64]

MOTION = Similarity(1.0, Rotation.from_rotvec([0.4, -1.1, 2.0]).as_matrix(), np.array([3.0, -2.0, 0.5]))
PATH_M = np.array([[0.0, 0, 1], [2, 0, 1.5], [2, 2, 0.5], [0, 2, 1]])
PLACES_M = {"A": (6.0, 0, 2.5), "B": (-6.0, 1, 0.4), "C": (0.5, 6, 3), "D": (1.0, -6, 0.2), "E": (5.0, 5, 1)}
SMALL = 1e-4 * np.eye(3)


def anchors(ids: str, into: Similarity | None = None, covariance_m2: Array = SMALL) -> dict[str, PlacedAnchor]:
    placed = {id_: PlacedAnchor(np.array([PLACES_M[id_]]), covariance_m2) for id_ in ids}
    return placed if into is None else {id_: anchor.moved(into) for id_, anchor in placed.items()}


def off_m(found: Similarity) -> float:
    """Return the largest error of the path."""
    return float(np.linalg.norm(found.apply(PATH_M) - MOTION.apply(PATH_M), axis=1).max())


@pytest.mark.parametrize("ids", ["ABC", "ABCDE"])
def test_three_anchors_not_on_a_line_fix_the_motion(ids: str) -> None:
    (found, *rivals) = align_by_anchors(anchors(ids, MOTION), anchors(ids), PATH_M)
    assert not rivals
    assert off_m(found.target_from_source) < 1e-9
    assert not found.elsewhere_m


def test_an_anchor_that_was_moved_in_between_is_named_and_has_no_say() -> None:
    source = anchors("ABCDE")
    source["D"] = PlacedAnchor(source["D"].places_m + np.array([0.0, 0.0, 2.0]), SMALL)
    found = align_by_anchors(anchors("ABCDE", MOTION), source, PATH_M)[0]
    assert off_m(found.target_from_source) < 0.02
    assert found.elsewhere_m.keys() == {"D"}
    assert found.elsewhere_m["D"] == pytest.approx(2.0, abs=0.02)


def test_of_mirror_places_those_are_chosen_that_fit() -> None:
    source = anchors("ABCDE")
    for id_ in "ABD":
        place = source[id_].places_m[0]
        mirror = place * [1.0, 1.0, -1.0]
        source[id_] = PlacedAnchor(np.array([mirror, place]), SMALL)
    found = align_by_anchors(anchors("ABCDE", MOTION), source, PATH_M)[0]
    assert off_m(found.target_from_source) < 1e-9
    assert {id_: side for id_, (_, side) in found.sides.items()} == {"A": 1, "B": 1, "C": 0, "D": 1, "E": 0}


def test_an_anchor_counts_in_the_directions_in_which_its_place_is_known() -> None:
    """The heights of three anchors are unknown and up to two metres off, which has little effect."""
    tall = np.diag([1e-4, 1e-4, 4.0])
    source = anchors("ABCDE", covariance_m2=tall)
    for id_, height in zip("ABC", (2.0, -2.0, 1.5), strict=True):
        source[id_] = PlacedAnchor(source[id_].places_m + np.array([0.0, 0.0, height]), tall)
    source["D"], source["E"] = anchors("DE").values()
    target = anchors("ABCDE", MOTION)
    found = align_by_anchors(target, source, PATH_M)[0]
    without = align_by_anchors(target, {id_: PlacedAnchor(a.places_m, SMALL) for id_, a in source.items()}, PATH_M)[0]
    assert off_m(found.target_from_source) < 0.6 < off_m(without.target_from_source)


@pytest.mark.parametrize(
    ("ids", "why"),
    [
        ("", "it shares no anchor"),
        ("A", "every turn about anchor A fits"),
        ("AB", "every turn about the line through A and B fits"),
        ("APQ", r"A, P, Q\) are on a line: every turn about it fits"),
    ],
)
def test_what_leaves_a_turn_open_is_refused_by_name(ids: str, why: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(PLACES_M, "P", (3.0, 1.0, 2.0))
    monkeypatch.setitem(PLACES_M, "Q", (0.0, 2.0, 1.5))
    with pytest.raises(GeometryError, match=why):
        align_by_anchors(anchors("ABCDEPQ", MOTION), anchors(ids), PATH_M)


def paired(target: dict[str, PlacedAnchor], source: dict[str, PlacedAnchor]) -> dict[str, anchor_alignment._Pair]:
    return {id_: anchor_alignment._Pair(target[id_], source[id_]) for id_ in source}


def shifted(ids: str, shift_m: tuple[float, float, float], covariance_m2: Array = SMALL) -> dict[str, PlacedAnchor]:
    return {id_: PlacedAnchor(np.array([PLACES_M[id_]]) + shift_m, covariance_m2) for id_ in ids}


def test_an_anchor_is_ranked_by_its_mirror_place_and_then_by_its_mean_variance() -> None:
    covariance = np.diag([0.01, 0.02, 0.06])
    sure = PlacedAnchor(np.zeros((1, 3)), covariance)
    assert sure.variance_m2 == pytest.approx(0.03)
    assert sure.rank == pytest.approx((1, 0.03))
    mirrored = PlacedAnchor(np.zeros((2, 3)), 1e-6 * covariance)
    assert sorted([mirrored, PlacedAnchor(np.zeros((1, 3)), 2 * covariance), sure], key=lambda a: a.rank)[0] is sure
    assert max([mirrored, sure], key=lambda a: a.rank) is mirrored


def test_an_anchor_that_is_moved_takes_both_places_and_its_uncertainty_along() -> None:
    quarter = Similarity(1.0, Rotation.from_euler("z", 90, degrees=True).as_matrix(), np.array([1.0, 0.0, 0.0]))
    moved = PlacedAnchor(np.array([[2.0, 0.0, 3.0], [0.0, 2.0, -3.0]]), np.diag([1.0, 2.0, 3.0])).moved(quarter)
    np.testing.assert_allclose(moved.places_m, [[1.0, 2.0, 3.0], [-1.0, 0.0, -3.0]], atol=1e-12)
    np.testing.assert_allclose(moved.covariance_m2, np.diag([2.0, 1.0, 3.0]), atol=1e-12)


def test_a_pair_is_as_uncertain_as_both_of_its_places_in_the_frame_of_the_target() -> None:
    quarter = Similarity(1.0, Rotation.from_euler("z", 90, degrees=True).as_matrix(), np.array([1.0, 0.0, 0.0]))
    target = PlacedAnchor(np.array([[1.0, 1.0, 1.0]]), np.diag([0.1, 0.2, 0.3]))
    source = PlacedAnchor(np.array([[2.0, 0.0, 3.0], [0.0, 2.0, -3.0]]), np.diag([1.0, 2.0, 3.0]))
    pair = anchor_alignment._Pair(target, source)
    assert pair.sides == [(0, 0), (0, 1)]
    assert anchor_alignment._Pair(source, target).sides == [(0, 0), (1, 0)]
    assert pair.variance_m2 == pytest.approx(2.2)
    np.testing.assert_allclose(pair.difference(quarter, (0, 0)), [0.0, 1.0, 2.0], atol=1e-12)
    np.testing.assert_allclose(pair.difference(quarter, (0, 1)), [-2.0, -1.0, -4.0], atol=1e-12)
    np.testing.assert_allclose(pair.information(quarter), np.diag([1 / 2.1, 1 / 1.2, 1 / 3.3]), atol=1e-12)


@pytest.mark.parametrize(("off_stddevs", "is_elsewhere"), [(4.9, False), (5.1, True)])
def test_an_anchor_stands_elsewhere_from_five_standard_deviations(off_stddevs: float, is_elsewhere: bool) -> None:
    """Both frames are uncertain by 0.01 m in each direction, so that their difference is by sqrt(2) times that."""
    off_m = off_stddevs * 0.01 * 2**0.5
    target, source = anchors("ABC"), anchors("ABC") | shifted("B", (0.0, 0.6 * off_m, -0.8 * off_m))
    found = AnchorAlignment.of(paired(target, source), IDENTITY)
    np.testing.assert_allclose(found.squared, [0.0, off_stddevs**2, 0.0], atol=1e-9)
    assert found.elsewhere_m == pytest.approx({"B": off_m} if is_elsewhere else {})
    assert found.cost == pytest.approx(0.5 * 2.385**2 * np.log(1 + (off_stddevs / 2.385) ** 2))


def test_of_two_mirror_places_the_likelier_one_is_taken_not_the_nearer_one() -> None:
    """Heights are uncertain by two metres: one place is 1 m above, the other 0.5 m beside."""
    tall = np.diag([1e-4, 1e-4, 4.0])
    place = np.array(PLACES_M["A"])
    target = {"A": PlacedAnchor(place + np.array([[0.5, 0.0, 0.0], [0.0, 0.0, 1.0]]), tall)}
    found = AnchorAlignment.of(paired(target, anchors("A", covariance_m2=tall)), IDENTITY)
    assert found.sides == {"A": (1, 0)}
    assert found.squared == pytest.approx([1 / 8])


def on_a_line(num: int) -> dict[str, PlacedAnchor]:
    return {id_: PlacedAnchor(np.array([[2.0 * k, 0.0, 1.0]]), SMALL) for k, id_ in enumerate("ABCD"[:num])}


@pytest.mark.parametrize("is_target", [True, False])
def test_mirror_places_that_can_leave_the_line_determine_a_motion(is_target: bool) -> None:
    bent = on_a_line(3)
    pairs = paired(bent, on_a_line(3))
    with pytest.raises(GeometryError, match=r"the anchors that it shares \(A, B, C\) are on a line"):
        anchor_alignment._refuse_too_few(pairs)
    bent["B"] = PlacedAnchor(np.array([[2.0, 0.0, 1.0], [2.0, 3.0, 1.0]]), SMALL)
    away = {**on_a_line(3), "B": PlacedAnchor(np.array([[2.0, 3.0, 1.0]]), SMALL)}
    anchor_alignment._refuse_too_few(paired(bent, away) if is_target else paired(away, bent))
    # One frame on a line is enough to leave the turn open.
    with pytest.raises(GeometryError, match="on a line"):
        anchor_alignment._refuse_too_few(paired(on_a_line(3), away) if is_target else paired(away, on_a_line(3)))


def test_triples_are_of_the_eight_best_placed_anchors_and_not_on_a_line() -> None:
    rng = np.random.default_rng(0)
    source = {f"{k}": PlacedAnchor(rng.normal(size=(1, 3)), (1 + k) * SMALL) for k in range(9)}
    target = {id_: anchor.moved(MOTION) for id_, anchor in source.items()}
    # The worst placed one has moved, so that no motion but the true one appears without it.
    target["8"] = PlacedAnchor(target["8"].places_m + 1.0, target["8"].covariance_m2)
    motions = list(anchor_alignment._triple_motions(paired(target, source).values()))
    assert len(motions) == 56
    assert max(off_m(motion) for motion in motions) < 1e-6
    four = on_a_line(3) | anchors("D")
    assert len(list(anchor_alignment._triple_motions(paired(four, four).values()))) == 3
    doubled = {**anchors("ABC"), "B": PlacedAnchor(np.array([[0.0, 1.0, 2.0], [5.0, 6.0, 8.0]]), SMALL)}
    assert len(list(anchor_alignment._triple_motions(paired(doubled, doubled).values()))) == 4


def test_a_motion_is_refined_to_the_minimum_of_the_robust_cost() -> None:
    """The minimum is found a second time, by a search without derivatives of the model."""
    rng = np.random.default_rng(2)
    source, target = {}, {}
    for k, id_ in enumerate("ABCDE"):
        tall = np.diag([0.01, 0.02 * (k + 1), 0.5])
        place = np.array([PLACES_M[id_]]) + 30.0
        source[id_] = PlacedAnchor(place, tall)
        target[id_] = PlacedAnchor(MOTION.apply(place + 0.15 * rng.normal(size=3)), 0.5 * tall)
    pairs = paired(target, source)
    begun = AnchorAlignment.of(pairs, replace(MOTION, translation=MOTION.translation + 0.2))
    found = anchor_alignment._refined(pairs, begun)
    middle = MOTION.apply(np.full((1, 3), 30.0))[0]

    def cost(x: Array) -> float:
        turn = Rotation.from_rotvec(x[:3]).as_matrix()
        motion = found.target_from_source
        turned = Similarity(1.0, turn @ motion.rotation, turn @ (motion.translation - middle) + middle + x[3:])
        return AnchorAlignment.of(pairs, turned).cost

    assert found.cost < begun.cost
    least = minimize(cost, np.zeros(6), method="BFGS")
    assert found.cost == pytest.approx(float(least.fun), rel=1e-3)


@pytest.mark.parametrize(("share", "num"), [(0.09, 1), (0.11, 2)])
def test_motions_that_put_the_path_within_a_tenth_of_its_extent_are_one(
    monkeypatch: pytest.MonkeyPatch, share: float, num: int
) -> None:
    extent_m = float(np.sqrt(np.mean(np.sum((PATH_M - PATH_M.mean(axis=0)) ** 2, axis=1))))
    other = replace(IDENTITY, translation=np.array([share * extent_m, 0.0, 0.0]))
    monkeypatch.setattr(anchor_alignment, "_triple_motions", lambda pairs: iter([other, IDENTITY]))
    monkeypatch.setattr(anchor_alignment, "_refined", lambda pairs, fit: fit)
    found = anchor_alignment._distinct(paired(anchors("ABC"), anchors("ABC")), PATH_M)
    assert len(found) == num
    assert found[0].target_from_source is IDENTITY

"""Two frames are aligned by the anchors in both: when these determine the motion, and when they do not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation

from rangesfm.errors import GeometryError
from rangesfm.estimation.scale.model_placement import align_by_anchors
from rangesfm.measurements.ranges.anchors.anchor import AnchorEstimate
from rangesfm.util.geometry.similarity import IDENTITY, Similarity

Array = npt.NDArray[np.float64]

MOTION = Similarity(1.0, Rotation.from_rotvec([0.4, -1.1, 2.0]).as_matrix(), np.array([3.0, -2.0, 0.5]))
PATH_M = np.array([[0.0, 0, 1], [2, 0, 1.5], [2, 2, 0.5], [0, 2, 1]])
PLACES_M = {"A": (6.0, 0, 2.5), "B": (-6.0, 1, 0.4), "C": (0.5, 6, 3), "D": (1.0, -6, 0.2), "E": (5.0, 5, 1)}
SMALL = 1e-4 * np.eye(3)


def anchor(id_: str, place_m: Array, covariance_m2: Array = SMALL) -> AnchorEstimate:
    return AnchorEstimate(id_, place_m, 0.01, None, np.inf, 0.0, 0.0, 0.0, position_covariance_m2=covariance_m2)


def anchors(ids: str, into: Similarity = IDENTITY, covariance_m2: Array = SMALL) -> dict[str, AnchorEstimate]:
    return {id_: anchor(id_, np.array(PLACES_M[id_]), covariance_m2).moved(into) for id_ in ids}


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
    source["D"] = anchor("D", source["D"].position_m + np.array([0.0, 0.0, 2.0]))
    found = align_by_anchors(anchors("ABCDE", MOTION), source, PATH_M)[0]
    assert off_m(found.target_from_source) < 0.02
    assert found.elsewhere_m.keys() == {"D"}
    assert found.elsewhere_m["D"] == pytest.approx(2.0, abs=0.02)


def test_of_mirror_places_those_are_chosen_that_fit() -> None:
    source = anchors("ABCDE")
    for id_ in "ABD":
        place = source[id_].position_m
        source[id_] = replace(anchor(id_, place * [1.0, 1.0, -1.0]), mirror_position_m=place)
    found = align_by_anchors(anchors("ABCDE", MOTION), source, PATH_M)[0]
    assert off_m(found.target_from_source) < 1e-9
    assert dict(zip(found.ids, found.sides[1], strict=True)) == {"A": 1, "B": 1, "C": 0, "D": 1, "E": 0}


def test_an_anchor_counts_in_the_directions_in_which_its_place_is_known() -> None:
    """The heights of three anchors are unknown and up to two metres off, which has little effect."""
    tall = np.diag([1e-4, 1e-4, 4.0])
    source = anchors("ABCDE", covariance_m2=tall)
    for id_, height in zip("ABC", (2.0, -2.0, 1.5), strict=True):
        source[id_] = anchor(id_, source[id_].position_m + np.array([0.0, 0.0, height]), tall)
    source["D"], source["E"] = anchors("DE").values()
    target = anchors("ABCDE", MOTION)
    found = align_by_anchors(target, source, PATH_M)[0]
    without = align_by_anchors(target, {id_: anchor(id_, each.position_m) for id_, each in source.items()}, PATH_M)[0]
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

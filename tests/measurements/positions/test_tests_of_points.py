"""Known points are compared with the map that all measurements hold, and with each other."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.simulated.positions_at_origin import known_positions

from rangesfm.measurements.joint_map import JointMap, KindOnMap, join_kinds
from rangesfm.measurements.mistakes import MistakeTests
from rangesfm.measurements.positions.control_points import ControlPoint, ControlPoints
from rangesfm.measurements.positions.position_scale import PositionScale, scale_by_positions
from rangesfm.measurements.positions.surveyed_positions import SurveyedPositions
from rangesfm.solver.bending import WalkBending
from rangesfm.solver.linear_map import Columns
from rangesfm.solver.noise import Component
from rangesfm.solver.posterior import Observations
from rangesfm.util.geometry.similarity import IDENTITY, Similarity
from rangesfm.util.geometry.trajectory import Trajectory

STDDEV_M, NUM_POINTS, TIGHT = 0.01, 6, 1e-3
PATH = Trajectory(np.arange(3), ("a", "b", "c"), np.arange(3.0), 4.0 * np.eye(3), np.tile(np.eye(3), (3, 1, 1)))


@dataclass(frozen=True)
class Held(KindOnMap):
    """Another kind, which knows scale, turn and shift of the map so well."""

    stddev: float

    kind = "held"
    places_map = True
    start = IDENTITY

    @property
    def alone(self) -> JointMap:
        return join_kinds((self,), IDENTITY, WalkBending(PATH))

    def observed(self, placed: Similarity, *, in_site: bool, max_num: int) -> Observations:
        assert in_site, "it places the map"
        assert max_num > 7
        turn, first_m = Rotation.from_matrix(placed.rotation).as_rotvec(), PATH.centers[:1]
        covariance = self.stddev**2 * np.eye(7)
        return Observations(
            Columns.of_whole(7),
            np.eye(7),
            np.array([np.log(placed.scale), *turn, *(placed.apply(first_m) - first_m)[0]]),
            kind=self.kind,
            by_pose=np.zeros((7, 18)),
            components=(Component("held", covariance),),
            alone_m2=covariance,
            is_used=np.ones(7, dtype=bool),
        )


def found_in(
    wrong_m: Mapping[int, list[float]],
    kinds: str = "check",
    stddev: float = TIGHT,
    num: int = NUM_POINTS,
) -> MistakeTests:
    """Test points of which some are elsewhere, in a map that another kind holds.

    Args:
        kinds: of the points; the last one counts for all others. stddev: as of ``Held``.
    """
    rng, of_points = np.random.default_rng(1), kinds.split()
    of_points += of_points[-1:] * (num - len(of_points))
    places = rng.uniform(-3.0, 3.0, (num, 3))
    at_m = places + STDDEV_M * rng.standard_normal(places.shape)
    for row, off_m in wrong_m.items():
        at_m[row] += off_m
    points = tuple(ControlPoint(f"P{k}", at, STDDEV_M, of_points[k], k + 2) for k, at in enumerate(at_m))
    known = replace(
        known_positions([True] * num, 3, STDDEV_M),
        places=places,
        position_m=at_m,
        is_check=np.array([kind == "check" for kind in of_points]),
    )
    bending, surveyed = WalkBending(PATH), SurveyedPositions(ControlPoints(points))
    positions = PositionScale.begun(known, bending, surveyed, is_at_rest=True)
    if of_points.count("control") >= 3:
        positions = scale_by_positions(positions)
    return positions.tests(join_kinds((Held(stddev), positions), IDENTITY, bending, is_at_rest=True), {})


def rejected(found: MistakeTests) -> list[tuple[str, str]]:
    return [(test.name, test.subject) for test in found.tests if test.rejected]


@pytest.mark.parametrize("stddev", [TIGHT, 0.3])
def test_a_wrong_check_point_is_named_however_loosely_others_place_the_map(stddev: float) -> None:
    found = found_in({2: [0, 0, 1.0]}, stddev=stddev)
    assert rejected(found) == [("check point", "P2")]
    assert found.tests[0].size == pytest.approx(1.0, abs=0.3)
    assert len(found.reasons) == 1
    assert found.reasons[0].startswith("probably the check point P2 is ")
    assert found.of_place == found.reasons
    assert {test.effect_on_scale for test in found.tests} == {0.0}


@pytest.mark.parametrize("kinds", ["check", "control control check", "control control control control check"])
def test_two_wrong_points_are_both_named(kinds: str) -> None:
    assert {subject for _, subject in rejected(found_in({2: [0, 0, 1.0], 4: [0, 0, -1.5]}, kinds))} == {"P2", "P4"}


@pytest.mark.parametrize("kinds", ["check", "control"])
def test_points_in_another_frame_are_told_as_one_mistake(kinds: str) -> None:
    found = found_in({row: [0.5, -0.3, 0.2] for row in range(NUM_POINTS)}, kinds)
    assert rejected(found) == [("frame of the points", "")]
    assert found.tests[0].size == pytest.approx(np.linalg.norm([0.5, -0.3, 0.2]), abs=0.03)
    assert "the map has all known points 0.6" in found.reasons[0]
    assert "(-0." in found.reasons[0]


@pytest.mark.parametrize("kinds", ["check", "control", "control check"])
@pytest.mark.parametrize("stddev", [TIGHT, 0.3])
def test_what_the_stated_errors_explain_is_not_named(kinds: str, stddev: float) -> None:
    assert not found_in({}, kinds, stddev).reasons


def test_a_single_control_point_beside_others_is_compared_with_their_map() -> None:
    found = found_in({0: [0, 0, 3.0]}, "control", num=1)
    assert rejected(found) == [("control point", "P0")]
    assert len(found.tests) == 1


def test_control_points_of_which_any_may_be_wrong_are_all_named() -> None:
    """Each corner of a triangle explains its shape; a fourth point tells them apart."""
    found = found_in({0: [0, 0, 1.0]}, "control", 10.0, num=3)
    assert len(found.reasons) == 1
    assert found.reasons[0].startswith("either the control point")
    assert {subject for _, subject in rejected(found)} == {"P0", "P1", "P2"}
    checked = found_in({0: [0, 0, 1.0]}, "control control control check", 10.0, num=4)
    assert rejected(checked) == [("control point", "P0")]
    assert checked.reasons[0].startswith("probably the control point P0 is ")


def test_points_in_a_map_that_nothing_places_are_not_found_in() -> None:
    known = replace(known_positions([True] * 4, 3), is_check=np.ones(4, dtype=bool))
    bending = WalkBending(PATH)
    alone = PositionScale.begun(known, bending)
    in_site = join_kinds((Held(TIGHT),), IDENTITY, bending)
    assert alone.tests(in_site, {}).tests == ()

"""Wrong points, antennas and frames among known positions are found with their sizes, and each is said in words."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy import stats
from scipy.sparse import eye_array
from scipy.spatial.transform import Rotation
from tests.scale.test_position_equations import known_positions

from rangesfm.arrays import Array
from rangesfm.diagnostics import position_tests
from rangesfm.diagnostics.hypothesis_tests import MistakeTest
from rangesfm.diagnostics.position_tests import LOOK_AGAIN, diagnose_positions
from rangesfm.geometry.similarity import Similarity, similarity_motions
from rangesfm.ranging.errors.bending import ErrorPart
from rangesfm.scale.linear_map import LinearMap
from rangesfm.scale.position_equations import PositionEquations, errors_of_sizes
from rangesfm.scale.range_equation import Columns
from rangesfm.scale.scale_by_lengths import ScaleByKind

SITE_FROM_MODEL = Similarity(2.0, Rotation.from_rotvec([0.3, -0.4, 1.2]).as_matrix(), np.array([5.0, -3.0, 1.0]))
STDDEV_M = 0.05
NUM_MARKS, NUM_ANTENNA = 6, 9
LASTING_S = 24.0
ARM, CLOCK, DATUM = "antenna's lever arm", "antenna's clock", "datum shift"
NOTHING = np.zeros(0, dtype=np.int64)
ALONE: Any = SimpleNamespace(problem=None, by_kind={})


def positions_of(
    *,
    off_m: Mapping[int, Sequence[float]] = MappingProxyType({}),
    arm_m: Array | None = None,
    late_s: float = 0.0,
    num_marks: int = NUM_MARKS,
    num_antenna: int = NUM_ANTENNA,
    is_moving: bool = True,
    clock_stddev_s: float = 0.0,
    checks: Collection[int] = (),
    left_out: Collection[int] = (),
) -> Any:
    """Positions without noise on a map that is true, as ``PositionScale`` has them; marks come first.

    Args:
        off_m: (3,) additions to some of the known positions. arm_m: (3,) in the camera, to the true lever arm.
        late_s: how late the times of the antenna's positions are.
    """
    rng, num = np.random.default_rng(0), num_marks + num_antenna
    known = known_positions([True] * num_marks + [False] * num_antenna)
    is_antenna = ~known.is_mark[:, None]
    turns = Rotation.random(num, rng=1).as_matrix()
    known = replace(
        known,
        places=rng.uniform(-5, 5, (num, 3)),
        is_check=np.isin(np.arange(num), [*checks]),
        time_s=known.time_s * LASTING_S / (NUM_ANTENNA - 1),
        velocity=np.where(is_antenna & is_moving, rng.uniform(-1, 1, (num, 3)), 0.0),
        world_from_cam=np.where(is_antenna[:, None], turns, 0.0),
        clock_stddev_s=np.full(num, clock_stddev_s),
    )
    true_m = known.predicted_m(SITE_FROM_MODEL)
    given_m = true_m.copy()
    for row, addition_m in off_m.items():
        given_m[row] += addition_m
    if arm_m is not None:
        given_m = given_m + known.world_from_cam @ arm_m @ SITE_FROM_MODEL.rotation.T
    # If the times are late, the antenna was there before them.
    given_m = given_m - late_s * SITE_FROM_MODEL.scale * known.velocity @ SITE_FROM_MODEL.rotation.T
    known = replace(known, position_m=given_m)
    is_used = ~known.is_check & ~np.isin(np.arange(num), [*left_out])
    motions = similarity_motions(true_m - true_m[0]).reshape(-1, 7)
    residual_m = known.misclosures_m(SITE_FROM_MODEL).ravel()
    linear = LinearMap(residual_m, motions, np.zeros(0), np.zeros((0, 7)), Columns(0, 1, NOTHING, NOTHING, 7))
    parts = (ErrorPart("points", STDDEV_M**2 * np.eye(3 * num)),)
    equations = PositionEquations(
        linear, parts, errors_of_sizes(parts, {"points": 1.0}), np.repeat(is_used, 3), eye_array(3 * num, format="csr")
    )
    return SimpleNamespace(
        known=known, site_from_model=SITE_FROM_MODEL, is_used=is_used, equations=equations, threshold=20.0
    )


def of_antenna(positions: Any) -> dict[str, MistakeTest]:
    return {row.name: row for row in position_tests._of_antenna(positions)}


SHIFTED_M = dict.fromkeys(range(NUM_MARKS, NUM_MARKS + NUM_ANTENNA), (0.5, 30.0, -48.25))


def test_a_lever_arm_that_is_off_is_found_in_the_cameras_axes() -> None:
    row = of_antenna(positions_of(arm_m=np.array([0.5, -1.25, 2.0])))[ARM]
    assert row.words == "the antenna sits elsewhere on the camera, by +0.50, -1.25, +2.00 m (right, down, forward)"
    assert row.size == pytest.approx(np.linalg.norm([0.5, -1.25, 2.0]))
    assert row.rejected
    assert (row.unit, row.subject) == ("m", "")
    assert "antenna_in_cam_m" in row.remedy


@pytest.mark.parametrize(("late_s", "said"), [(0.75, "0.75 s late"), (-18.0, "18.00 s early")])
def test_times_that_are_off_are_said_to_be_late_or_early(late_s: float, said: str) -> None:
    row = of_antenna(positions_of(late_s=late_s))[CLOCK]
    assert row.words == f"the times of the positions are {said}"
    assert row.size == pytest.approx(-late_s)
    assert row.rejected
    assert row.unit == "s"


def test_the_antennas_frame_may_be_shifted_against_that_of_the_points() -> None:
    row = of_antenna(positions_of(off_m=SHIFTED_M))[DATUM]
    assert row.words == ("the positions and the control points have frames that are shifted by +0.50, +30.00, -48.25 m")
    assert row.rejected  # however large it is
    assert row.unit == "m"


def test_without_a_mistake_of_the_antenna_none_is_found() -> None:
    rows = of_antenna(positions_of())
    assert [*rows] == [ARM, CLOCK, DATUM]
    assert all(row.statistic == pytest.approx(0.0, abs=1e-6) for row in rows.values())


@pytest.mark.parametrize(("share", "is_possible"), [(0.98, True), (1.02, False)])
def test_no_antenna_is_farther_than_twenty_metres_and_no_clock_off_by_more_than_the_survey_lasts(
    share: float, is_possible: bool
) -> None:
    arm = of_antenna(positions_of(arm_m=20 * share * np.array([0.0, 0.6, -0.8])))[ARM]
    clock = of_antenna(positions_of(late_s=LASTING_S * share))[CLOCK]
    assert [arm.rejected, clock.rejected] == [is_possible] * 2
    assert [arm.statistic > 0.0, clock.statistic > 0.0] == [is_possible] * 2


@pytest.mark.parametrize(
    ("changes", "names"),
    [
        ({}, [ARM, CLOCK, DATUM]),
        ({"is_moving": False}, [ARM, DATUM]),
        ({"clock_stddev_s": 0.1}, [ARM, DATUM]),  # the offset was searched for
        ({"num_marks": 3}, [ARM, CLOCK, DATUM]),
        ({"num_marks": 2}, [ARM, CLOCK]),
        ({"num_marks": 4, "checks": (0, 2)}, [ARM, CLOCK]),
        ({"num_antenna": 0}, []),
        ({"num_antenna": 1, "left_out": (6,)}, []),
    ],
)
def test_what_can_be_wrong_of_an_antenna_depends_on_what_is_known_of_it(
    changes: dict[str, Any], names: list[str]
) -> None:
    """All of them together raise one false alarm in 50 surveys."""
    rows = of_antenna(positions_of(**changes))
    assert [*rows] == names
    for name, row in rows.items():
        num = 1 if name == CLOCK else 3
        assert row.threshold == pytest.approx(stats.chi2.isf(0.02 / len(names), num))


def test_an_outlying_position_of_the_antenna_has_no_say() -> None:
    last = NUM_MARKS + NUM_ANTENNA - 1
    found = of_antenna(positions_of(off_m={last: [0, 99, 0]}, arm_m=np.array([0.25, 0.5, -1.0]), left_out=[last]))
    assert found[ARM].words.split(", by ")[1] == "+0.25, +0.50, -1.00 m (right, down, forward)"


def diagnosis(positions: Any, left_out: Collection[str] = (), estimate: Any = ALONE) -> tuple[list[str], list[str]]:
    """Return the reasons, and the names and subjects of the tests."""
    found = diagnose_positions(positions, left_out, estimate)
    return [*found.reasons], [f"{row.name} {row.subject}".strip() for row in found.tests]


def stddevs_of(positions: Any, row: int) -> str:
    """Return how many standard deviations a point is off, by the others alone.

    In a map that the others determine, the error and its covariance are those of a prediction.
    """
    linear, rows = positions.equations.linear, np.arange(3) + 3 * row
    others = positions.equations.is_used & ~np.isin(np.arange(len(linear.residual_m)), rows)
    design = linear.design[others]
    of_map = STDDEV_M**2 * np.linalg.inv(design.T @ design)
    off_m = linear.residual_m[rows] - linear.design[rows] @ np.linalg.lstsq(design, linear.residual_m[others])[0]
    covariance_m2 = linear.design[rows] @ of_map @ linear.design[rows].T + STDDEV_M**2 * np.eye(3)
    return f"{np.sqrt(off_m @ np.linalg.solve(covariance_m2, off_m)):.0f} stddevs"


def test_without_known_positions_nothing_is_tested() -> None:
    assert diagnose_positions(None, (), ALONE).tests == ()


def test_positions_that_agree_give_no_reason() -> None:
    reasons, rows = diagnosis(positions_of(num_antenna=0))
    assert reasons == []
    assert sorted(rows) == [f"control point P{k}" for k in range(NUM_MARKS)]


def test_a_control_point_that_is_left_out_is_said_with_its_error() -> None:
    """The map has it 0.2 m less far along x than its coordinates say."""
    positions = positions_of(off_m={2: [0.2, -0.3, 0.6]}, left_out=[2])
    reasons, rows = diagnosis(positions, ["P2"])
    far = "0.70 m from its coordinates (-0.20, +0.30, -0.60 m)"
    said = f"probably the control point P2 is {far} ({stddevs_of(positions, 2)}): {LOOK_AGAIN}; it is left out"
    assert reasons == [said]
    assert rows[0] == "control point P2"  # what was found comes first


def test_points_that_contradict_one_another_are_said_to_be_either_wrong() -> None:
    """The error of one of four points is seen in the residuals of all of them."""
    positions = positions_of(off_m={1: [2.0, 0, 0]}, num_marks=4, num_antenna=0)
    reasons, _ = diagnosis(positions)
    found = {row.subject: row for row in diagnose_positions(positions, (), ALONE).tests}
    rejected = [name for name in ("P0", "P1", "P2", "P3") if found[name].rejected]
    assert len(rejected) > 1
    either = "; or ".join(found[name].words for name in rejected)
    assert reasons == [f"either {either}: {LOOK_AGAIN}"]


def test_a_control_point_just_below_its_threshold_is_not_named() -> None:
    positions = positions_of(off_m={1: [0.3, 0, 0]}, num_antenna=0)
    statistic = max(row.statistic for row in diagnose_positions(positions, (), ALONE).tests)
    for threshold, is_named in ((statistic * 1.01, False), (statistic * 0.99, True)):
        positions.threshold = threshold
        assert bool(diagnosis(positions)[0]) == is_named


@pytest.mark.parametrize("num_checks", [1, 2])
def test_a_check_point_is_named_beside_its_kind_and_moves_no_scale(num_checks: int) -> None:
    positions = positions_of(off_m={5: [0.0, -1.5, 0]}, num_antenna=0, checks=range(6 - num_checks, 6))
    found = diagnose_positions(positions, (), ALONE)
    row = found.tests[0]
    assert (row.name, row.subject, row.effect_on_scale) == ("check point", "P5", 0.0)
    assert row.size == pytest.approx(1.5)
    assert row.threshold == pytest.approx(stats.chi2.isf(0.02 / num_checks, 3))
    assert found.reasons == (f"probably {row.words} ({stddevs_of(positions, 5)}): {LOOK_AGAIN}",)
    assert row.words.startswith("the check point P5 is 1.50 m from its coordinates")
    assert len(found.tests) == NUM_MARKS


def test_beside_ranges_check_points_are_compared_elsewhere() -> None:
    positions = positions_of(off_m={5: [0.0, -1.5, 0]}, num_antenna=0, checks=[5])
    beside: Any = SimpleNamespace(problem=object(), by_kind={})
    assert diagnosis(positions, (), beside) == ([], [f"control point P{k}" for k in range(5)])


def test_a_control_point_that_was_left_out_as_a_check_point_is_still_called_a_control_point() -> None:
    positions = positions_of(off_m={5: [0.0, -1.5, 0]}, num_antenna=0, checks=[5])
    reasons, rows = diagnosis(positions, ["P5"])
    assert rows[0] == "control point P5"
    assert len(rows) == NUM_MARKS
    assert len(reasons) == 1
    assert reasons[0].endswith("; it is left out")


def test_of_the_mistakes_of_an_antenna_only_the_likeliest_is_a_reason() -> None:
    """A shift of the frame is seen as part of other mistakes, too."""
    positions = positions_of(off_m=SHIFTED_M)
    found = diagnose_positions(positions, (), ALONE)
    of_kind = {row.name: row for row in found.tests}
    assert of_kind[DATUM].statistic == max(of_kind[name].statistic for name in (ARM, CLOCK, DATUM))
    said = [reason for reason in found.reasons if "antenna" in reason or "frames" in reason or "times" in reason]
    (reason,) = said
    row = of_kind[DATUM]
    assert reason == f"probably {row.words} ({np.sqrt(row.statistic):.0f} stddevs): {row.remedy}"
    order = [row.statistic - row.threshold for row in found.tests]
    assert order == sorted(order, reverse=True)


def mistake(name: str, statistic: float, threshold: float = 10.0) -> MistakeTest:
    return MistakeTest(name, "", statistic, threshold, "words", "remedy")


def test_the_likeliest_mistake_of_an_antenna_is_the_one_with_the_largest_statistic_above_its_threshold() -> None:
    rows = [mistake(ARM, 30.0), mistake(CLOCK, 90.0, 95.0), mistake("control point", 99.0), mistake(DATUM, 40.0)]
    assert position_tests._likeliest(rows) == [rows[3]]
    assert position_tests._likeliest(rows[1:3]) == []


@pytest.mark.parametrize(("by_positions", "is_named"), [(1.02, False), (1.03, True)])
def test_positions_and_ranges_that_differ_are_said(by_positions: float, is_named: bool) -> None:
    """Their scales have a standard deviation of 1 % together, and 2.33 of these are exceeded in 2 % of the cases."""
    scales = {"positions": ScaleByKind(by_positions, 0.006 * by_positions), "ranges": ScaleByKind(1.0, 0.008)}
    estimate: Any = SimpleNamespace(problem=object(), by_kind=scales)
    found = diagnose_positions(positions_of(num_antenna=0), (), estimate)
    assert len(found.reasons) == is_named
    assert len(found.tests) == NUM_MARKS + 1
    for reason in found.reasons:
        assert reason.startswith(
            "by the known positions the map is +3.0 % larger than by the ranges; their errors together explain 1.0 % "
            "(1 stddev): calibrate the radio"
        )
        assert found.tests[0].name == "positions against ranges"

"""Control points and positions of the camera can be planned, alone and beside ranges."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tests.planning.plans import FIVE_ANCHORS_M, loop, planned

from rangesfm.errors import InputError
from rangesfm.measurements.lengths.tape import CHECK, CONTROL
from rangesfm.measurements.positions.control_points import ControlPoint
from rangesfm.measurements.positions.position_scale import PositionScale, scale_by_positions
from rangesfm.planning.expected import expect
from rangesfm.planning.plan_file import read_plan
from rangesfm.planning.planned import PlannedAntenna, PlannedSurvey
from rangesfm.planning.planned_kinds import known_positions
from rangesfm.planning.planned_photos import PlannedPhotos
from rangesfm.planning.survey_plan import plan_survey
from rangesfm.solver.bending import WalkBending
from rangesfm.util.geometry.similarity import IDENTITY

STDDEV_M = 0.02
WALK = loop(30.0, 60)


def points(num: int = 3, stddev_m: float = STDDEV_M) -> tuple[ControlPoint, ...]:
    """Points spread around the loop, half-way to the edge of photos."""
    path = WALK
    places = PlannedPhotos().aside(path, np.linspace(0, len(path) - 1, num + 1).astype(np.int64)[:-1])
    return tuple(ControlPoint(f"C{k}", at, stddev_m, CONTROL, k) for k, at in enumerate(places[:num]))


def by_points(num: int = 3, stddev_m: float = STDDEV_M) -> PlannedSurvey:
    return replace(planned((), "site", WALK), points=points(num, stddev_m))


def test_what_control_points_give_is_what_a_run_states_of_them() -> None:
    """Coordinates with errors as expected, on a map that bends as expected, are judged like the plan."""
    plan = by_points(12)
    expected = expect(plan)
    known = known_positions(plan)
    bending = WalkBending(plan.trajectory)
    stated = []
    for seed in range(8):
        off_m = STDDEV_M * np.random.default_rng(seed).standard_normal(known.position_m.shape)
        found = scale_by_positions(PositionScale.begun(replace(known, position_m=known.position_m + off_m), bending))
        stated.append(found.alone.posterior.uncertainty.empirical)
    assert expected.uncertainty.empirical == pytest.approx(np.median(stated), rel=0.35)


def test_the_map_by_control_points_alone_is_as_certain_as_they_are() -> None:
    coarse, exact = (expect(by_points(5, stddev_m)) for stddev_m in (0.06, 0.01))
    assert coarse.frame == "site"
    assert exact.uncertainty.empirical < 0.5 * coarse.uncertainty.empirical
    assert exact.worst_keyframe_m < 0.5 * coarse.worst_keyframe_m


def test_three_control_points_bring_the_place_of_a_survey_with_ranges_to_centimetres() -> None:
    plan = plan_survey(replace(planned(FIVE_ANCHORS_M, "site", WALK), points=points()))
    assert plan.place is not None
    alone = plan.by_kind
    assert set(alone) == {"ranges", "positions"}
    together_m = plan.place.worst_keyframe_stddev_m
    assert together_m < 0.8 * alone["ranges"].worst_keyframe_m
    assert together_m < alone["positions"].worst_keyframe_m
    assert plan.expected.uncertainty.empirical < min(each.uncertainty.empirical for each in alone.values())
    assert sum("alone (95 %)" in line for line in plan.lines) == 2


def test_the_gain_of_three_control_points_is_advised_and_kept() -> None:
    plan = plan_survey(planned(FIVE_ANCHORS_M[:4], "site", WALK))
    advice = next(each for each in plan.advice_for_place if each.kind == "control points")
    assert advice.words.startswith("survey three control points that the photos show, such as ")
    assert advice.place_gain > 0.2
    assert expect(advice.planned).worst_keyframe_m == pytest.approx(advice.place_stddev_m, rel=0.2)


def test_positions_of_the_camera_give_scale_and_place_and_their_errors_may_last() -> None:
    alone = replace(
        planned((), "site", WALK), antenna=PlannedAntenna(rate_hz=1.0, stddev_m=0.05, antenna_in_cam_m=(0.0, -0.3, 0.0))
    )
    expected, often = (
        expect(alone),
        expect(replace(alone, antenna=PlannedAntenna(rate_hz=10.0, stddev_m=0.05, antenna_in_cam_m=(0.0, -0.3, 0.0)))),
    )
    assert expected.worst_keyframe_m < 0.2
    # Errors that last do not average out.
    assert 0.5 * expected.worst_keyframe_m < often.worst_keyframe_m < expected.worst_keyframe_m
    assert expected.verdict.verdict == "good"


def test_a_point_that_the_photos_do_not_show_is_left_out_and_named() -> None:
    above = ControlPoint("above", np.array([0.0, 0.0, 50.0]), STDDEV_M, CONTROL, 9)
    expected = expect(replace(planned(FIVE_ANCHORS_M, "site", WALK), points=(*points(), above)))
    assert [each.kind for each in expected.kinds] == ["ranges", "positions"]
    assert expected.notes == (
        "1 of 4 points are left out, as no two photos of the path show them from different directions "
        "([photos] field_of_view_deg, seen_m): above",
    )


def test_points_nearly_on_a_line_are_refused_as_they_leave_a_turn_open() -> None:
    first, _, last = points()
    between_m = (first.position_m + last.position_m) / 2
    for off_m, is_refused in ((0.01, True), (1.0, False)):
        middle = ControlPoint("middle", between_m + np.array([0.0, 0.0, off_m]), STDDEV_M, CONTROL, 7)
        plan = plan_survey(replace(by_points(), points=(first, middle, last)))
        assert any("nearly on one line" in line for line in plan.lines) == is_refused
        assert (plan.verdict == "refused") == is_refused


def test_two_points_beside_ranges_are_not_used_and_without_ranges_are_refused() -> None:
    beside = expect(replace(planned(FIVE_ANCHORS_M, "site", WALK), points=points(2)))
    assert beside.notes[0].startswith("the known positions are not used: 2 known positions are in the map")
    refused = plan_survey(by_points(2))
    assert refused.verdict == "refused"
    assert refused.place is not None
    assert refused.place.verdict == "open"
    assert any(advice.kind == "control points" for advice in refused.advice_for_scale)


def test_a_check_point_checks_a_map_that_three_control_points_hold() -> None:
    four = points(4)
    assert expect(by_points()).verdict.verdict == "doubtful"  # of three, nothing tells which one is wrong
    checked = expect(replace(by_points(), points=(*four[:3], replace(four[3], kind=CHECK))))
    assert checked.verdict.verdict == "good"


def test_points_and_positions_are_read_from_the_plan(tmp_path: Path) -> None:
    (tmp_path / "points.csv").write_text("marker,x_m,y_m,z_m,stddev_m,kind\na,1,2,0,0.02,control\nb,3,2,0,0.02,check\n")
    walk = "[path]\nwaypoints = [[1, 1, 1.5], [5, 1, 1.5], [3, 3, 1.5]]\n"
    file = tmp_path / "plan.toml"
    file.write_text(walk + '[points]\npath = "points.csv"\n[positions]\nrate_hz = 5.0\nstddev_m = 0.02\n')
    plan = read_plan(file)
    assert plan.anchors == ()
    assert [(point.name, point.kind) for point in plan.points] == [("a", CONTROL), ("b", CHECK)]
    assert plan.antenna == PlannedAntenna(rate_hz=5.0, stddev_m=0.02)
    known = plan.antenna.located(plan.trajectory)
    np.testing.assert_allclose(known.misclosures_m(IDENTITY), 0.0, atol=1e-12)
    file.write_text('[anchors]\nframe = "first_camera"\nplaces = {A = [0, 0, 2]}\n' + walk + "[positions]\n")
    with pytest.raises(InputError, match=r":2: \[anchors\] frame is 'first_camera', expected site or unknown beside"):
        read_plan(file)

"""The inputs of a run are checked against each other: tags and their lever arms, anchors, and the ends of ranges."""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from tests.known import known
from tests.refused import refused

from rangesfm.errors import InputError
from rangesfm.measurements.ranges.range_log import RangeKind
from rangesfm.options import AnchorOptions, RangesOptions
from rangesfm.survey.inputs import read_ranging_inputs
from rangesfm.survey.settings import Survey

ROWS = "0,A,1,left\n1,B,2,left\n2,A,3,right\n3,B,4.5,A\n4,right,0.4,left\n"
LEFT, RIGHT = (0.1, 0.0, 0.0), (-0.1, 0.0, 0.2)


@pytest.fixture
def survey(tmp_path: Path) -> Survey:
    """A survey of two tags and two anchors, with ranges between them, between the tags and between the anchors."""
    (tmp_path / "uwb.csv").write_text("timestamp_s,anchor_id,range_m,tag_id\n" + ROWS)
    (tmp_path / "anchors.csv").write_text("anchor_id,x_m,y_m,z_m\nA,0,0,0\nB,4.5,0,0\n")
    return Survey(ranges=RangesOptions(path=tmp_path / "uwb.csv"), anchors=AnchorOptions(path=tmp_path / "anchors.csv"))


refusal = partial(refused, read_ranging_inputs)


def test_each_tag_has_its_lever_arm_in_the_order_of_the_log(survey: Survey) -> None:
    inputs = read_ranging_inputs(survey.changed({"tag.lever_arms_m": {"right": RIGHT, "left": LEFT}}))
    assert inputs.log.tag_ids == ("left", "right")
    np.testing.assert_array_equal(inputs.tag_in_cam_m, [LEFT, RIGHT])


def test_all_ranges_are_kept_and_those_between_two_of_a_kind_are_told(survey: Survey) -> None:
    inputs = read_ranging_inputs(survey.changed({"tag.lever_arms_m": {"right": RIGHT, "left": LEFT}}))
    assert inputs.log.kind.tolist() == [0, 0, 0, RangeKind.ANCHOR_ANCHOR, RangeKind.TAG_TAG]
    assert "1 ranges are between two anchors: they are used as distances between these" in inputs.assumed
    assert "1 ranges are between two tags: they are not used" in inputs.assumed


def test_tag_without_lever_arm_is_named_with_its_line(survey: Survey) -> None:
    error = refusal(survey.changed({"tag.lever_arms_m": {"left": LEFT}}))
    assert "tag 'right' has no lever arm; lever arms are given for left" in str(error)
    assert error.line == 4
    error = refusal(survey.changed({"tag.tag_in_cam_m": LEFT}))
    assert "the log has several tags (left, right): give each its lever arm" in str(error)


def test_tag_can_be_chosen(survey: Survey) -> None:
    inputs = read_ranging_inputs(survey.changed({"tag.tag_id": "right", "tag.tag_in_cam_m": RIGHT}))
    assert inputs.log.tag_ids == ("right",)
    assert inputs.log.kind.tolist() == [RangeKind.TAG_ANCHOR, RangeKind.ANCHOR_ANCHOR]
    np.testing.assert_array_equal(inputs.tag_in_cam_m, [RIGHT])
    inputs = read_ranging_inputs(
        survey.changed({"tag.tag_id": "left", "tag.lever_arms_m": {"right": RIGHT, "left": LEFT}})
    )
    np.testing.assert_array_equal(inputs.tag_in_cam_m[0], LEFT)
    assert "'middle' is not in the log, which has left, right" in str(refusal(survey.changed({"tag.tag_id": "middle"})))


def test_tag_that_only_ranges_with_tags_needs_no_lever_arm(survey: Survey, tmp_path: Path) -> None:
    (tmp_path / "uwb.csv").write_text("timestamp_s,anchor_id,range_m,tag_id\n0,A,1,left\n1,left,0.4,right\n")
    inputs = read_ranging_inputs(survey.changed({"tag.lever_arms_m": {"left": LEFT}}))
    assert inputs.log.kind.tolist() == [RangeKind.TAG_ANCHOR, RangeKind.TAG_TAG]
    np.testing.assert_array_equal(inputs.tag_in_cam_m, [LEFT, [np.nan] * 3])


def test_lever_arm_of_a_tag_that_is_not_heard_is_noted(survey: Survey) -> None:
    arms = {"right": RIGHT, "left": LEFT, "spare": LEFT}
    assert "no ranges of tag spare" in read_ranging_inputs(survey.changed({"tag.lever_arms_m": arms})).notes


def test_lever_arm_in_another_unit_is_refused(survey: Survey) -> None:
    arms = {"left": LEFT, "right": (120.0, 0.0, 0.0)}
    with pytest.raises(InputError, match=r"right is \(120.0, 0.0, 0.0\), .* 3 numbers of metres from -20 to 20"):
        survey.changed({"tag.lever_arms_m": arms})


def test_log_without_any_range_of_the_camera_is_refused(survey: Survey, tmp_path: Path) -> None:
    (tmp_path / "uwb.csv").write_text("timestamp_s,anchor_id,range_m,tag_id\n0,A,4.5,B\n")
    assert "none of the 1 ranges is between a tag and an anchor" in str(refusal(survey))


def test_wanted_anchors_leave_out_ranges_with_others(survey: Survey) -> None:
    chosen = survey.changed({"tag.lever_arms_m": {"right": RIGHT, "left": LEFT}, "anchors.use": ("A",)})
    log = read_ranging_inputs(chosen).log
    assert log.anchor_ids == ("A",)
    assert log.kind.tolist() == [0, 0, RangeKind.TAG_TAG]


def test_stranger_among_the_anchors_is_named_with_its_line(survey: Survey, tmp_path: Path) -> None:
    with (tmp_path / "uwb.csv").open("a") as file:
        file.write("5,C,7,A\n6,C,7,left\n")
    error = refusal(survey.changed({"tag.lever_arms_m": {"right": RIGHT, "left": LEFT}}))
    assert "anchor_id is 'C'" in str(error)
    assert error.line == 7


def test_anchors_with_numbers_of_points_are_those_of_the_log_if_one_rule_makes_them_so(
    survey: Survey, tmp_path: Path
) -> None:
    of_tag = survey.changed({"tag.tag_id": "left"})
    assert survey.anchors.path is not None
    (tmp_path / "uwb.csv").write_text("timestamp_s,anchor_id,range_m,tag_id\n0,1,1,left\n1,2,2,left\n")
    survey.anchors.path.write_text("anchor_id,x_m,y_m,z_m\nS1,9,9,9\n101,0,0,0\n102,1.5,0,0\n")
    inputs = read_ranging_inputs(of_tag)
    places = {anchor.anchor_id: known(anchor.position_m).tolist() for anchor in inputs.anchors}
    assert places == {"S1": [9, 9, 9], "1": [0, 0, 0], "2": [1.5, 0, 0]}
    assert any("101 is 1, 102 is 2 (100 is added to the numbers)" in line for line in inputs.assumed)
    survey.anchors.path.write_text("anchor_id,x_m,y_m,z_m\n101,0,0,0\n102,1.5,0,0\n111,0,0,0\n112,1.5,0,0\n")
    assert "anchors.csv: 101, 102, 111, 112; the log has 1, 2 (" in str(refusal(of_tag))


@pytest.mark.parametrize(("unit", "factor"), [("millimetres", 1000.0), ("centimetres", 100.0)])
def test_positions_of_anchors_in_another_unit_are_told_from_metres(survey: Survey, unit: str, factor: float) -> None:
    assert survey.anchors.path is not None
    of_tag = survey.changed({"tag.tag_id": "left"})
    assert read_ranging_inputs(of_tag).anchors[1].position_m is not None
    survey.anchors.path.write_text(f"anchor_id,x_m,y_m,z_m\nA,0,0,0\nB,{1.5 * factor},0,0\n")
    error = refusal(of_tag)
    assert f"the ranges to them 1 and 2 m: are the positions in {unit}? expected metres" in str(error)
    assert error.path == survey.anchors.path
    read_ranging_inputs(of_tag.changed({"anchors.frame": "unknown"}))


@pytest.mark.parametrize("wrong", range(4))
def test_one_position_that_is_far_off_is_no_unit(survey: Survey, tmp_path: Path, wrong: int) -> None:
    """Four anchors are heard in turn. The positions are in centimetres if all of them are too far apart."""
    rows = [f"{0.1 * k:.1f},{'ABCD'[k % 4]},{2 + k % 3},left\n" for k in range(40)]
    (tmp_path / "uwb.csv").write_text("timestamp_s,anchor_id,range_m,tag_id\n" + "".join(rows))
    of_tag = survey.changed({"tag.tag_id": "left"})
    places = np.array([[0.0, 0, 0], [3, 0, 0], [3, 3, 1], [0, 3, 2]])

    def write(places: np.ndarray) -> None:
        assert survey.anchors.path is not None
        lines = [f"{name},{x},{y},{z}\n" for name, (x, y, z) in zip("ABCD", places, strict=True)]
        survey.anchors.path.write_text("anchor_id,x_m,y_m,z_m\n" + "".join(lines))

    off = places.copy()
    off[wrong] += 600.0
    write(off)
    assert len(read_ranging_inputs(of_tag).anchors) == 4
    write(100.0 * places)
    message = re.search(
        r"anchors (.) and (.) are (.*) m apart here, and the ranges to them (.) and (.) m", str(refusal(of_tag))
    )
    assert message is not None
    first, second = (places["ABCD".index(name)] for name in message.group(1, 2))
    apart_m, *ranges_m = map(float, message.group(3, 4, 5))
    assert apart_m == pytest.approx(100.0 * np.linalg.norm(first - second), rel=1e-5)
    assert apart_m > 10 * sum(ranges_m)


def test_coordinates_that_are_all_alike_were_never_measured(survey: Survey) -> None:
    of_tag = survey.changed({"tag.tag_id": "left"})
    assert survey.anchors.path is not None
    survey.anchors.path.write_text("anchor_id,x_m,y_m,z_m\nA,0,0,1\nB,0,0,1\n")
    error = refusal(of_tag)
    assert error.path == survey.anchors.path
    assert "all 2 anchors of the log have the same coordinates, expected those that were measured, or empty" in str(
        error
    )
    read_ranging_inputs(of_tag.changed({"anchors.frame": "unknown"}))
    survey.anchors.path.write_text("anchor_id,x_m,y_m,z_m\nA,0,0,1\nB,,,\n")
    read_ranging_inputs(of_tag)


@pytest.mark.parametrize(("east_m", "said"), [(10.0, ""), (691_000.0, "the positions are 6.91e+05 m or more from all")])
def test_positions_out_of_the_radios_reach_are_in_another_frame(
    survey: Survey, tmp_path: Path, east_m: float, said: str
) -> None:
    path = tmp_path / "positions.csv"
    path.write_text(f"timestamp_s,x_m,y_m,z_m\n0,{east_m},1,1\n1,{east_m + 1},2,1\n")
    of_tag = survey.changed({"tag.tag_id": "left", "positions.path": path})
    if not said:
        assert read_ranging_inputs(of_tag).positions.are_known
        return
    error = refusal(of_tag)
    assert said in str(error)
    assert error.path == path

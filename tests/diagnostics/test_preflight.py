"""Mistakes that the files alone show are reported before the long work; a survey in order causes no report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import pycolmap
import pytest
from tests.known import known
from tests.simulated.model import synthetic_model
from tests.simulated.path import loop_path

from rangesfm.arrays import Array
from rangesfm.colmap.reprojection import PointErrors
from rangesfm.diagnostics import preflight
from rangesfm.diagnostics.preflight import (
    check_units,
    notes_before_work,
    notes_on_distances,
    notes_on_gaps,
    notes_on_model,
    notes_on_silence,
    notes_on_times,
)
from rangesfm.distances.tape import Tape, TapedDistance
from rangesfm.errors import InputError
from rangesfm.ranging.anchors.anchor import Anchor
from rangesfm.ranging.anchors.site import Site
from rangesfm.ranging.range_log import RangeLog
from rangesfm.survey.inputs import RangingInputs, read_ranging_inputs
from rangesfm.survey.settings import Survey

if TYPE_CHECKING:
    from tests.conftest import WalkedSurvey

NO_LEVER_ARM = "the tag's place on the camera is not given"


@pytest.fixture
def survey(walked_survey: WalkedSurvey) -> Survey:
    folder = walked_survey.folder
    return Survey().changed({"ranges.path": folder / "uwb.csv", "anchors.path": folder / "anchors.csv"})


@pytest.fixture
def complete(survey: Survey) -> Survey:
    return survey.changed({"tag.tag_in_cam_m": (0.0, 0.0, 0.0)})


def with_heights(inputs: RangingInputs, heights_m: Sequence[float]) -> RangingInputs:
    placed = [
        replace(anchor, position_m=np.array([*anchor.position_m[:2], height_m]))
        for anchor, height_m in zip(inputs.anchors, heights_m)
        if anchor.position_m is not None
    ]
    return replace(inputs, anchors=tuple(placed))


def test_of_a_survey_in_order_nothing_is_said(complete: Survey) -> None:
    assert not list(notes_before_work(complete, read_ranging_inputs(complete)))


def test_a_lever_arm_that_nobody_gave_is_told_and_one_of_zero_is_not(survey: Survey, complete: Survey) -> None:
    inputs = read_ranging_inputs(survey)
    (note,) = notes_before_work(survey, inputs)
    assert note.startswith(NO_LEVER_ARM)
    by_tag = survey.changed({"tag.lever_arms_m": {"tag": (0.0, 0.0, 0.0)}})
    assert not list(notes_before_work(by_tag, inputs))


def test_a_lever_arm_that_no_camera_carries_is_told(complete: Survey) -> None:
    for arm_m, is_told in (((0.0, 2.2, 0.0), False), ((0.03, -9.0, 0.05), True)):
        given = complete.changed({"tag.tag_in_cam_m": arm_m})
        notes = list(notes_before_work(given, read_ranging_inputs(given)))
        assert len(notes) == is_told
        assert all("is 9 m long, more than a camera carries" in note for note in notes)


def test_an_anchor_that_was_left_out_on_purpose_is_not_told_to_have_no_ranges(complete: Survey) -> None:
    assert read_ranging_inputs(complete.changed({"anchors.use": ("A2",)})).notes == ()


@pytest.mark.parametrize("height_m", [0.0, 1.5])
def test_heights_that_are_all_the_same_are_told(complete: Survey, height_m: float) -> None:
    level = with_heights(read_ranging_inputs(complete), [height_m] * 4)
    (note,) = notes_before_work(complete, level)
    assert note.startswith(f"all 4 anchors have one height, {level.site.offset_m[2] + height_m:g} m")
    assert not list(notes_before_work(complete, replace(level, anchor_frame="first_camera")))
    assert not list(notes_before_work(complete, with_heights(level, [1.5, 1.5, 1.5, 1.51])))


def test_two_anchors_in_one_place_are_told(complete: Survey) -> None:
    inputs = read_ranging_inputs(complete)
    first, second, *others = inputs.anchors
    notes = list(
        notes_before_work(
            complete, replace(inputs, anchors=(first, replace(second, position_m=first.position_m), *others))
        )
    )
    assert notes[0].startswith("anchors A1 and A2 have the same position")


def test_a_taped_distance_that_contradicts_the_coordinates_of_its_anchors_is_told(complete: Survey) -> None:
    inputs = read_ranging_inputs(complete)
    at_m = {anchor.anchor_id: known(anchor.position_m) for anchor in inputs.anchors}
    apart_m = float(np.linalg.norm(at_m["A1"] - at_m["A3"]))

    def notes(off_m: float, anchor_stddev_m: float = 0.0) -> list[str]:
        anchors = tuple(replace(anchor, position_stddev_m=anchor_stddev_m) for anchor in inputs.anchors)
        tape = Tape((TapedDistance(("A1", "A3"), apart_m + off_m, 0.01, "check", 2),))
        return list(notes_before_work(complete, replace(inputs, anchors=anchors, tape=tape)))

    (note,) = notes(0.2)
    assert note.startswith(f"the taped distance from A1 to A3 is {apart_m + 0.2:.3f} m, but their coordinates are")
    assert "(+0.200 m, expected within 0.023 m by the stated errors)" in note
    assert not notes(0.02)
    assert not notes(0.2, anchor_stddev_m=0.1)


def test_an_anchor_that_repeats_one_value_is_told_and_a_tag_that_stands_still_is_not(complete: Survey) -> None:
    inputs = read_ranging_inputs(complete)
    log = inputs.log
    stuck = replace(log, range_m=np.where(log.anchor_index == 1, 7.25, log.range_m))
    assert any(
        "anchor A2 reads one and the same value in 100 %" in note
        for note in notes_before_work(complete, replace(inputs, log=stuck))
    )
    still = replace(log, range_m=np.array([4.0, 5.0, 6.0, 7.0])[log.anchor_index])
    assert not any("same value" in note for note in notes_before_work(complete, replace(inputs, log=still)))


def test_ranges_beyond_any_radio_end_the_run_unless_their_unit_is_said(complete: Survey) -> None:
    inputs = read_ranging_inputs(complete)
    in_mm = replace(inputs, log=replace(inputs.log, range_m=1e3 * inputs.log.range_m))
    with pytest.raises(InputError, match=r"uwb\.csv: nearly all ranges are longer than .* insist on --range_unit m"):
        check_units(complete, in_mm)
    printed = replace(in_mm, log=replace(in_mm.log, format="mauwb"))  # its unit cannot be given
    for survey, inputs in ((complete.changed({"ranges.range_unit": "m"}), in_mm), (complete, printed)):
        notes = notes_before_work(survey, replace(inputs, anchor_frame="unknown"))
        assert any(note.startswith("nearly all ranges are longer than") for note in notes)
        check_units(survey, replace(inputs, anchor_frame="unknown"))


def test_positions_that_are_not_used_are_not_looked_at(complete: Survey) -> None:
    level = with_heights(read_ranging_inputs(complete), [0.0] * 4)
    assert not list(notes_before_work(complete, replace(level, anchor_frame="unknown")))


WALK_S = np.linspace(0.0, 120.0, 400)


@pytest.mark.parametrize("offset_s", [0.0, -50.0, 1.7e9])
def test_clocks_that_differ_are_no_matter(offset_s: float) -> None:
    assert not list(notes_on_times(WALK_S + offset_s, WALK_S + 3.0))


def test_times_an_hour_apart_by_clocks_that_know_the_date_are_told() -> None:
    (note,) = notes_on_times(WALK_S + 1.7e9, WALK_S + 1.7e9 + 3600)
    assert "0.97 h apart: another time zone, or another walk" in note


def test_ranges_that_last_a_fraction_of_the_walk_are_told() -> None:
    (note,) = notes_on_times(1e-3 * WALK_S, WALK_S)
    assert note.startswith("the ranges last 0.12 s, the photos 120 s")


@pytest.mark.parametrize("is_one_clock", [False, True])
def test_time_without_ranges_is_told(is_one_clock: bool) -> None:
    radio_s = np.arange(0.0, 193.0, 0.05)
    photos_s = np.arange(0.0, 193.0, 0.33)

    def told(radio_s: Array, photos_s: Array = photos_s) -> list[str]:
        return list(notes_on_silence(radio_s, photos_s, is_one_clock=is_one_clock))

    assert told(radio_s) == []
    (note,) = told(radio_s[(radio_s < 40) | (radio_s > 100)])
    assert note.startswith("for 60 of the 193 s of the photos there are no ranges (such as from 40.0 to 100.1 s of")
    (note,) = told(radio_s[radio_s < 133])
    assert note.startswith("for 60 of the 193 s of the photos there are no ranges: there the map rests on")
    assert told(radio_s[(radio_s < 40) | (radio_s > 50)]) == []  # a twentieth
    pause = (photos_s < 40) | (photos_s > 100)
    assert told(radio_s[(radio_s < 40) | (radio_s > 100)], photos_s[pause]) == []  # nobody walked then
    assert told(radio_s[:1]) == []
    assert told(radio_s[::400]) == []  # a range each 20 s


@pytest.mark.parametrize(("num_ranges", "num_photos"), [(1, 400), (400, 1), (0, 400)])
def test_one_range_or_one_photo_lasts_for_no_time_and_is_not_compared(num_ranges: int, num_photos: int) -> None:
    assert not list(notes_on_times(WALK_S[:num_ranges], WALK_S[:num_photos]))


def test_keyframes_too_far_apart_for_the_ranges_between_them_are_told_and_one_pause_is_not() -> None:
    assert not list(notes_on_gaps(np.append(np.arange(10.0), 11.5), 2.0))
    assert not list(notes_on_gaps(np.array([3.0]), 2.0))
    assert not list(notes_on_gaps(np.concatenate([np.arange(10.0), 3600 + np.arange(10.0)]), 2.0))
    (note,) = notes_on_gaps(np.array([0.0, 1.0, 3.1, 5.2, 7.3]), 2.0)
    assert "for 86 % of the time keyframes are more than 2 s apart (in the median 2.1 s)" in note


@pytest.fixture
def model() -> pycolmap.Reconstruction:
    path, times = loop_path(30.0, seed=3), np.arange(1.0, 29.0)
    made = synthetic_model(
        times, path.centers(times), path.world_from_cam(times), num_observations=40, pixel_stddev=1.0
    )
    return made.reconstruction


def test_of_a_model_as_colmap_leaves_it_or_without_points_nothing_is_said(model: pycolmap.Reconstruction) -> None:
    assert not list(notes_on_model(model))
    for point_id in list(model.points3D):
        model.delete_point3D(point_id)
    assert not list(notes_on_model(model))


def test_a_model_whose_points_are_not_of_its_photos_is_told(model: pycolmap.Reconstruction) -> None:
    for point in model.points3D.values():
        point.xyz = point.xyz * [1.0, 1.0, -1.0]
    (note,) = notes_on_model(model)
    assert note.startswith("the model's points lie")


def test_a_photo_whose_pose_is_wrong_is_named(model: pycolmap.Reconstruction) -> None:
    frame = model.frame(7)
    pose = known(frame.rig_from_world)
    frame.rig_from_world = pycolmap.Rigid3d(pose.rotation, pose.translation + np.array([5.0, 3.0, 0.0]))
    (note,) = notes_on_model(model)
    assert note.startswith(f"photo {model.image(7).name}: most of its points lie more than 4.8 px")


def log_of(anchors: Sequence[str], ranges_m: npt.ArrayLike, **columns: Any) -> RangeLog:
    """Ranges to these anchors, a second apart unless their times or photos are given."""
    if not columns.keys() & {"timestamp_s", "image_name"}:
        columns["timestamp_s"] = np.arange(len(anchors), dtype=np.float64)
    return RangeLog.from_arrays(anchors, ranges_m, **columns)


def inputs_of(log: RangeLog, arms_m: npt.ArrayLike | None = None, **attributes: Any) -> Any:
    arms = np.zeros((len(log.tag_ids), 3)) if arms_m is None else np.array(arms_m)
    usual = {"log": log, "tag_in_cam_m": arms, "anchors": (), "anchor_frame": "unknown", "site": AS_GIVEN, "tape": None}
    return SimpleNamespace(**(usual | attributes))


AS_GIVEN = Site()
PLACED = Survey().changed({"tag.tag_in_cam_m": (0.0, 0.0, 0.0)})


@pytest.mark.parametrize(("longest_m", "told"), [(2.95, ()), (3.05, ("t9 is 3.05 m long",))])
def test_a_lever_arm_longer_than_any_rig_is_told_with_its_tag(longest_m: float, told: tuple[str, ...]) -> None:
    log = log_of(["A", "B"], [1.0, 2.0], tag_id=["t1", "t9"])
    notes = list(notes_before_work(PLACED, inputs_of(log, [[0, 0, 2.0], [0, longest_m, 0]])))
    assert len(notes) == len(told)
    assert all(f"the lever arm of {words}, more" in note for note, words in zip(notes, told, strict=True))


def test_a_tag_without_a_name_is_called_the_tag() -> None:
    (note,) = notes_before_work(PLACED, inputs_of(log_of(["A"], [1.0], tag_id=[""]), [[3.0, 4.0, 0.0]]))
    assert note.startswith("the lever arm of the tag is 5 m long")


def test_without_a_radio_nobody_asks_for_the_place_of_its_tag() -> None:
    nothing = log_of(["A"], [1.0]).subset(np.zeros(1, dtype=bool))
    assert list(notes_before_work(Survey(), inputs_of(nothing))) == []


@pytest.mark.parametrize(("num_short", "long_m", "is_told"), [(5, 300.5, True), (6, 300.5, False), (5, 299.5, False)])
def test_the_unit_is_doubted_if_95_percent_of_the_ranges_are_beyond_300_m(
    num_short: int, long_m: float, is_told: bool
) -> None:
    """The quantile of 5 % of 101 ranges is the sixth shortest."""
    ranges_m = np.full(101, 4 * long_m)
    ranges_m[:num_short], ranges_m[num_short] = np.arange(num_short) + 10.0, long_m
    notes = list(preflight._on_ranges(log_of([f"A{k}" for k in range(101)], ranges_m)))
    assert len(notes) == is_told
    assert all(note.startswith("nearly all ranges are longer than 300.5 m, farther") for note in notes)


def test_ranges_between_anchors_are_not_taken_for_those_of_the_tag() -> None:
    """The anchors of a quarry may be farther apart than the tag is from any of them."""
    far = log_of(["B"], [900.0], tag_id=["A"]).with_anchors(("A", "B"))
    assert list(preflight._on_ranges(far)) == []
    both = log_of(["A", *["B"] * 40], [5.0, *[900.0] * 40], tag_id=["t", *["A"] * 40]).with_anchors(("A", "B"))
    assert list(preflight._on_ranges(both)) == []


def repeating(num_alike: Mapping[str, int], num: int = 20) -> RangeLog:
    """``num`` ranges of each anchor, of which so many have one value and all others differ."""
    ranges_m = [np.append(np.full(alike, 7.25), 8.0 + np.arange(num - alike)) for alike in num_alike.values()]
    return log_of([name for name in num_alike for _ in range(num)], np.concatenate(ranges_m))


@pytest.mark.parametrize(
    ("num_alike", "told"),
    [
        ({"A": 10, "B": 1}, {}),
        ({"A": 11, "B": 1}, {"A": 55}),
        ({"A": 1, "B": 11}, {"B": 55}),
        ({"A": 18, "B": 3}, {"A": 90}),
        ({"A": 18, "B": 4}, {}),  # as of a tag that stood still for a while
        ({"A": 18, "B": 18, "C": 1, "D": 2}, {"A": 90, "B": 90}),
        ({"A": 18, "B": 18, "C": 18, "D": 2}, {}),
        ({"A": 18}, {}),
    ],
)
def test_an_anchor_is_stuck_if_half_of_its_ranges_are_one_value_and_a_fifth_of_the_others(
    num_alike: dict[str, int], told: dict[str, int]
) -> None:
    notes = list(preflight._on_ranges(repeating(num_alike)))
    assert len(notes) == len(told)
    for note, (name, percent) in zip(notes, told.items(), strict=True):
        assert note.startswith(f"anchor {name} reads one and the same value in {percent} % of its ranges while")


def test_of_fewer_than_twenty_ranges_none_is_said_to_repeat() -> None:
    assert len(list(preflight._on_ranges(repeating({"A": 21, "B": 1}, 21)))) == 1
    assert list(preflight._on_ranges(repeating({"A": 19, "B": 1}, 19))) == []
    assert preflight._share_of_one_value(np.full(19, 2.0)) == 0.0
    assert preflight._share_of_one_value(np.array([1.0] * 4 + [2.0] * 15 + [3.0])) == pytest.approx(0.75)


# Stated errors of 3, 4 and 12 cm are 13 cm together. A normal error exceeds 2.326 standard deviations in 2 % of the
# cases, and 2.576 in 1 %.
EXPECTED_M = 2.32635 * 0.13
EXPECTED_OF_TWO_M = 2.57583 * 0.13


def notes_on_tape(*lengths_m: tuple[str, str, float]) -> list[str]:
    anchors = (
        Anchor("A", np.array([1.0, 0.0, 0.0]), 0.04),
        Anchor("B", np.array([1.0, 3.0, 4.0]), 0.12),
        Anchor("unknown"),
    )
    distances = tuple(TapedDistance((one, other), length_m, 0.03, "check", 2) for one, other, length_m in lengths_m)
    return list(preflight._on_taped_anchors(Tape(distances), anchors))


@pytest.mark.parametrize("sign", [-1, 1])
def test_a_length_may_be_off_its_anchors_coordinates_by_what_their_errors_explain(sign: int) -> None:
    assert notes_on_tape(("A", "B", 5.0 + sign * (EXPECTED_M - 1e-3))) == []
    (note,) = notes_on_tape(("A", "B", 5.0 + sign * (EXPECTED_M + 1e-3)))
    assert note.startswith(
        f"the taped distance from A to B is {5 + sign * 0.303:.3f} m, but their coordinates are 5.000 m apart "
        f"({sign * 0.303:+.3f} m, expected within 0.302 m by the stated errors)"
    )


def test_the_more_lengths_are_compared_the_more_chance_is_allowed() -> None:
    between = EXPECTED_M + 1e-3
    assert notes_on_tape(("A", "B", 5.0 + between), ("B", "A", 5.0)) == []
    (note,) = notes_on_tape(("B", "A", 5.0 - EXPECTED_OF_TWO_M - 1e-3), ("A", "B", 5.0))
    assert note.startswith("the taped distance from B to A")


def test_lengths_of_marks_and_of_anchors_without_coordinates_are_not_compared() -> None:
    others = ("A", "door", 77.0), ("unknown", "B", 77.0), ("door", "window", 77.0)
    assert notes_on_tape(*others) == []
    (note,) = notes_on_tape(*others, ("A", "B", 5.0 + EXPECTED_M + 1e-3))  # and they do not count as comparisons
    assert "from A to B" in note


def notes_on_heights(*heights_m: float, site: Site | None = AS_GIVEN) -> list[str]:
    at_m = {f"A{k}": np.array([9.0 * k, 0.0, height_m]) for k, height_m in enumerate(heights_m)}
    return list(preflight._on_positions(at_m, site))


def test_one_height_of_three_anchors_is_told_where_heights_have_a_meaning() -> None:
    (note,) = notes_on_heights(1.25, 1.25, 1.25)
    assert note.startswith("all 3 anchors have one height, 1.25 m: if nobody measured it")
    assert notes_on_heights(1.25, 1.25) == []
    assert notes_on_heights(1.25, 1.25, 1.25, site=None) == []
    (note,) = notes_on_heights(1.25, 1.25, 1.25, site=Site(np.array([2.6e6, 1.2e6, 450.0])))
    assert note.startswith("all 3 anchors have one height, 451.25 m")
    assert notes_on_heights(1.25, 1.2509, 1.25) != []
    assert notes_on_heights(1.25, 1.2511, 1.25) == []


def test_anchors_within_a_centimetre_are_in_one_place() -> None:
    at_m = {"A": np.zeros(3), "B": np.array([9.0, 0, 1]), "C": np.array([9.0, 0.009, 1]), "D": np.array([0, 0.011, 0])}
    (note,) = preflight._on_positions(at_m, AS_GIVEN)
    assert note.startswith("anchors B and C have the same position: one of them stands elsewhere")


@pytest.mark.parametrize(
    ("frame", "told"),
    [
        (
            "site",
            (
                "all 3 anchors have one height",
                "anchors A and B have the same",
                "in 2 of 3 pairs of anchors",
                "the taped",
            ),
        ),
        ("first_camera", ("anchors A and B have the same", "in 2 of 3 pairs of anchors", "the taped")),
        ("unknown", ()),
    ],
)
def test_what_is_told_of_positions_depends_on_their_frame(frame: str, told: tuple[str, ...]) -> None:
    """An anchor without coordinates has no part in it."""
    at_m = {"A": np.array([0.0, 0, 2]), "B": np.array([0.0, 0, 2]), "C": np.array([9.0, 0, 2])}
    anchors = (Anchor("X"), *(Anchor(name, at) for name, at in at_m.items()))
    log = between_anchors({**at_m, "B": np.array([0.0, 30, 2]), "X": np.zeros(3)})
    tape = Tape((TapedDistance(("A", "C"), 8.0, 0.01, "check", 2),))
    inputs = inputs_of(log, np.zeros((0, 3)), anchors=anchors, anchor_frame=frame, tape=tape)
    notes = list(notes_before_work(PLACED, inputs))
    assert len(notes) == len(told)
    assert all(note.startswith(words) for note, words in zip(notes, told, strict=True))
    inputs.tape = None
    assert len(list(notes_before_work(PLACED, inputs))) == max(len(told) - 1, 0)


@pytest.mark.parametrize(("lasts_s", "is_told"), [(59.5, True), (60.5, False)])
def test_ranges_are_to_last_half_as_long_as_the_photos(lasts_s: float, is_told: bool) -> None:
    notes = list(notes_on_times(np.array([7.0, 5.0 + lasts_s, 5.0]), np.array([120.0, 0.0, 10.0])))
    assert len(notes) == is_told
    assert all(note.startswith("the ranges last 59.5 s, the photos 120 s: most photos have no") for note in notes)


@pytest.mark.parametrize("radio_is_first", [False, True])
def test_logs_more_than_a_minute_apart_are_of_two_walks_if_both_clocks_know_the_date(radio_is_first: bool) -> None:
    def notes(gap_s: float, epoch_s: float = 1.7e9, other_s: float = 0.0) -> list[str]:
        first_s, second_s = epoch_s + np.array([0.0, 100.0]), epoch_s + other_s + np.array([100.0, 200.0]) + gap_s
        return list(notes_on_times(*((first_s, second_s) if radio_is_first else (second_s, first_s))))

    assert notes(59.5) == []
    (note,) = notes(61.0)
    assert note.startswith("by their clocks, ranges and photos are 0.017 h apart")
    (note,) = notes(7200.0)
    assert note.startswith("by their clocks, ranges and photos are 2 h apart")
    assert notes(7200.0, epoch_s=0.999e9 - 1e5) == []
    assert notes(7200.0, epoch_s=1.001e9) != []
    assert notes(7200.0, epoch_s=0.0, other_s=1.7e9) == []  # one of the clocks counts from its own start


def test_a_gap_is_a_pause_if_it_is_longer_than_thirty_median_gaps() -> None:
    walk_s = np.arange(41.0)
    assert list(notes_on_gaps(np.append(walk_s, 40.0 + 31.0), 2.0)) == []
    (note,) = notes_on_gaps(np.append(walk_s, 40.0 + 29.0), 2.0)
    assert "for 42 % of the time keyframes are more than 2 s apart (in the median 1 s)" in note


def test_gaps_are_told_if_they_are_three_tenths_of_the_time() -> None:
    walk_s = np.repeat(np.arange(8.0), 2)  # photos of two cameras that were taken together are at one time
    assert list(notes_on_gaps(np.append(walk_s, 7.0 + 2.95), 2.5)) == []  # 2.95 of 9.95 s
    assert list(notes_on_gaps(np.append(walk_s, 7.0 + 3.2), 3.2)) == []
    (note,) = notes_on_gaps(np.append(walk_s, 7.0 + 3.05), 2.5)  # 3.05 of 10.05 s
    assert "for 30 % of the time keyframes are more than 2.5 s apart (in the median 1 s)" in note


@pytest.mark.parametrize(
    ("off_px", "said"),
    [
        ({"a": 3.9, "b": 1.0}, ()),
        ({"a": 1.0, "b": 4.1}, ("photo b: most of its points",)),
        ({"a": 1.0, "b": 4.1, "c": 4.2}, ("photo c and 1 more: most of its points",)),
        ({"a": 5.0, "b": 9.0, "c": 1.0, "d": 6.0}, ("photo b and 2 more: most of its points",)),
    ],
)
def test_the_worst_of_the_photos_that_are_off_is_named(
    off_px: dict[str, float], said: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(preflight, "point_errors", lambda _: PointErrors(np.ones(3), np.zeros((3, 3)), 4.0))
    monkeypatch.setattr(preflight, "photo_errors_px", lambda _: off_px)
    notes = list(notes_on_model(pycolmap.Reconstruction()))
    assert len(notes) == len(said)
    assert all(note.startswith(begin) for note, begin in zip(notes, said, strict=True))
    assert all("more than 4 px" in note for note in notes)


def triangles(of_pairs: Mapping[tuple[int, int], Sequence[tuple[float, float]]]) -> preflight._Triangles:
    """Bounds, shortest and longest, on the distances of pairs of anchors."""
    rows = [(pair, *bounds) for pair, of_pair in of_pairs.items() for bounds in of_pair]
    pairs, shortest_m, longest_m = zip(*rows, strict=True)
    return preflight._Triangles(np.array(pairs), np.array(shortest_m), np.array(longest_m))


# Three anchors: the first and the last are 10 m apart, so that 10 % of that are a metre.
IN_A_ROW_M = np.array([[0.0, 0, 0], [4.0, 0, 0], [10.0, 0, 0]])
RIGHT = (0.0, 99.0)


@pytest.mark.parametrize(
    ("bounds", "is_bad"),
    [
        ([(0.0, 8.9)] * 10, True),
        ([(0.0, 9.1)] * 10, False),
        ([(11.1, 99.0)] * 10, True),
        ([(10.9, 99.0)] * 10, False),
        ([(0.0, 8.9)] * 9, False),  # too few triangles to tell
        ([(0.0, 8.9)] * 4 + [RIGHT] * 6, True),
        ([(0.0, 8.9)] * 3 + [RIGHT] * 7, False),  # some are spoilt by blocked paths
        ([(0.0, 8.9)] * 4 + [(11.1, 99.0)] * 3 + [RIGHT] * 7, True),
    ],
)
def test_a_distance_is_bad_if_many_triangles_contradict_it_by_a_tenth(
    bounds: Sequence[tuple[float, float]], is_bad: bool
) -> None:
    found = triangles({(0, 2): bounds, (1, 2): [(0.0, 8.9)] * 20}).bad_pairs(IN_A_ROW_M)
    np.testing.assert_array_equal(found, [[False, False, is_bad], [False] * 3, [False] * 3])


def causes(of_pairs: Mapping[tuple[int, int], float], positions_m: Array) -> list[str]:
    """Causes of contradictions, for pairs of anchors A, B, C, ... that ranges find so far apart."""
    measured = triangles({pair: [(apart_m, apart_m)] * 10 for pair, apart_m in of_pairs.items()})
    return list(preflight._causes(measured, "ABCDE"[: len(positions_m)], positions_m, measured.bad_pairs(positions_m)))


def apart(positions_m: Array) -> dict[tuple[int, int], float]:
    """True distances of all pairs."""
    of_pairs = combinations(range(len(positions_m)), 2)
    return {(i, k): float(np.linalg.norm(positions_m[i] - positions_m[k])) for i, k in of_pairs}


ODD_SITE_M = np.array([[0.0, 0, 0], [10.0, 0, 0], [3.0, 25.0, 0], [40.0, 9.0, 5.0]])


@pytest.mark.parametrize(
    ("factor", "words"),
    [
        (1e3, "anchors are in millimetres"),
        (1e2, "anchors are in centimetres"),
        (1 / 0.3048, "anchors are in feet"),
        (1e-3, "ranges are in millimetres"),
        (1e-2, "ranges are in centimetres"),
        (0.3048, "ranges are in feet"),
    ],
)
def test_a_unit_that_explains_all_contradictions_is_the_only_cause(factor: float, words: str) -> None:
    assert causes(apart(ODD_SITE_M), factor * ODD_SITE_M) == [words]


def test_an_anchor_that_is_in_all_contradictions_stands_elsewhere() -> None:
    moved_m = ODD_SITE_M.copy()
    moved_m[2] += [0.0, 90.0, 0.0]
    assert causes(apart(ODD_SITE_M), moved_m) == ["anchor C stands elsewhere"]
    # Two contradictions without an anchor in common have no such cause.
    two_pairs = {(0, 1): 3.0, (2, 3): 4.0}
    assert causes(two_pairs, ODD_SITE_M) == []


def test_two_labels_that_are_swapped_explain_all_contradictions() -> None:
    assert causes(apart(ODD_SITE_M), ODD_SITE_M[[0, 3, 2, 1]]) == ["the labels B and D are swapped"]
    assert causes(apart(ODD_SITE_M), ODD_SITE_M[[3, 1, 2, 0]]) == ["the labels A and D are swapped"]


def test_more_than_two_swaps_that_explain_the_contradictions_are_not_named() -> None:
    """The distance of A and B is 10 m, not 50 m; it would be right with B at C or at D, and with A at E."""
    in_a_row_m = np.array([[0.0, 0, 0], [50.0, 0, 0], [10.0, 0, 0], [-10.0, 0, 0], [40.0, 0, 0]])
    either = "anchor A or B stands elsewhere"
    two_swaps = ["the labels B and C are swapped", "the labels B and D are swapped"]
    assert causes({(0, 1): 10.0}, in_a_row_m[:4]) == [either, *two_swaps]
    assert causes({(0, 1): 10.0}, in_a_row_m) == [either]


def between_anchors(positions_m: Mapping[str, Array]) -> RangeLog:
    """One range between each two anchors, as they stand."""
    pairs = list(combinations(positions_m, 2))
    lengths_m = [float(np.linalg.norm(positions_m[one] - positions_m[other])) for one, other in pairs]
    return log_of([b for _, b in pairs], lengths_m, tag_id=[a for a, _ in pairs]).with_anchors(positions_m)


def test_the_note_on_distances_counts_the_pairs_and_says_the_causes() -> None:
    true_m = dict(zip("ABCD", ODD_SITE_M, strict=True))
    log = between_anchors(true_m)
    given_m = {**true_m, "B": ODD_SITE_M[3], "D": ODD_SITE_M[1]}
    (note,) = notes_on_distances(log, [Anchor(name, at) for name, at in given_m.items()])
    # A and C are swapped with neither, and B and D are as far from one another as before.
    assert note.startswith(
        "in 4 of 6 pairs of anchors, their coordinates and the ranges contradict each other: probably the labels B "
        "and D are swapped; check labels, coordinates and units"
    )
    elsewhere = [Anchor("A", true_m["A"]), Anchor("B", true_m["B"] + [0.0, 80.0, 0.0])]
    (note,) = notes_on_distances(log, elsewhere)
    assert "contradict each other: probably anchor A or B stands elsewhere; check" in note
    assert list(notes_on_distances(log, elsewhere[1:])) == []


def test_contradictions_without_a_cause_are_named_by_their_first_two_pairs() -> None:
    true_m = dict(zip("ABCD", ODD_SITE_M, strict=True))
    moved_m = [true_m["A"], true_m["B"] + [0.0, 70.0, 0.0], true_m["C"] + [70.0, 0, 0], true_m["D"] + [0, 0, 70.0]]
    anchors = [Anchor(name, at) for name, at in zip("ABCD", moved_m, strict=True)]
    (note,) = notes_on_distances(between_anchors(true_m), anchors)
    assert "each other: look at A and B and A and C first; check" in note


def test_a_range_between_two_anchors_bounds_their_distance_to_half_a_metre() -> None:
    log = between_anchors({"A": np.zeros(3), "B": np.array([8.0, 0, 0])})
    found = preflight._triangles(log, ["B", "A"])
    np.testing.assert_array_equal(found.pair, np.tile([0, 1], (10, 1)))
    np.testing.assert_allclose(found.shortest_m, 7.5)
    np.testing.assert_allclose(found.longest_m, 8.5)


def test_two_ranges_at_one_moment_bound_the_distance_of_their_anchors() -> None:
    """The tag moves by 5 m/s at most, and each range errs by half a metre at most."""
    log = log_of("CAB", [2.0, 9.0, 4.0], timestamp_s=[0.3, 0.1, 0.2])
    found = preflight._triangles(log, ["A", "B", "C"])
    order = np.lexsort(found.pair.T[::-1])
    np.testing.assert_array_equal(found.pair[order], [[0, 1], [0, 2], [1, 2]])
    apart_s = np.array([0.1, 0.2, 0.1])
    np.testing.assert_allclose(found.shortest_m[order], np.array([5.0, 7.0, 2.0]) - 0.5 - 5 * apart_s)
    np.testing.assert_allclose(found.longest_m[order], np.array([13.0, 11.0, 6.0]) + 0.5 + 5 * apart_s)


@pytest.mark.parametrize(
    ("columns", "num"),
    [
        ({"timestamp_s": [0.0, 0.19]}, 1),
        ({"timestamp_s": [0.21, 0.0]}, 0),
        ({"timestamp_s": [0.0, 0.0], "tag_id": ["t1", "t2"]}, 0),
        ({"image_name": ["1.jpg", "1.jpg"]}, 1),
        ({"image_name": ["1.jpg", "2.jpg"]}, 0),
    ],
)
def test_only_ranges_of_one_tag_from_one_place_form_a_triangle(columns: dict[str, Any], num: int) -> None:
    found = preflight._triangles(log_of("AB", [3.0, 4.0], **columns), ["A", "B"])
    assert found.pair.shape == (num, 2)
    assert len(found.shortest_m) == len(found.longest_m) == num


def test_ranges_of_one_anchor_and_of_anchors_that_are_not_compared_form_no_triangle() -> None:
    log = log_of("AABX", [3.0, 3.1, 5.0, 6.0], timestamp_s=[0.0, 0.05, 0.1, 0.1])
    found = preflight._triangles(log, ["A", "B"])
    np.testing.assert_array_equal(found.pair, [[0, 1]] * 2)
    np.testing.assert_allclose(sorted(found.longest_m), [8.1 + 0.5 + 0.25, 8.0 + 0.5 + 0.5])


def test_of_many_triangles_every_second_or_third_is_enough(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(preflight, "_MAX_NUM_TRIANGLES", 10)
    log = log_of("AB" * 25, np.full(50, 3.0), timestamp_s=np.repeat(np.arange(25.0), 2))
    assert len(preflight._triangles(log, ["A", "B"]).pair) == 13
    assert len(preflight._triangles(log.subset(np.arange(38)), ["A", "B"]).pair) == 19


@pytest.mark.parametrize(
    ("of_anchors", "of_ranges", "said"),
    [(1 / 0.3048, 1.0, "anchors are in feet"), (1.0, 1 / 0.3048, "ranges are in feet"), (1.0, 1.0, "")],
)
def test_a_unit_that_most_distances_between_anchors_show_ends_the_run(
    of_anchors: float, of_ranges: float, said: str
) -> None:
    log = between_anchors(dict(zip("ABCD", ODD_SITE_M, strict=True)))
    anchors = tuple(Anchor(name, of_anchors * at) for name, at in zip("ABCD", ODD_SITE_M, strict=True))
    log = replace(log, range_m=of_ranges * log.range_m, format="table")
    inputs = inputs_of(log, anchors=anchors, anchor_frame="site")
    if not said:
        check_units(Survey(), inputs)
        return
    with pytest.raises(InputError, match=f"6 of 6 pairs .* contradict each other; they would not if {said}: give"):
        check_units(Survey(), inputs)
    check_units(Survey().changed({"ranges.range_unit": "m", "anchors.unit": "m"}), inputs)

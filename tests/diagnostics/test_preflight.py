"""Mistakes that the files alone show are reported before the long work; a survey in order causes no report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np
import pycolmap
import pytest
from tests.known import known
from tests.simulated.model import synthetic_model
from tests.simulated.path import along, loop_path

from rangesfm.arrays import Array
from rangesfm.diagnostics import preflight
from rangesfm.diagnostics.preflight import (
    notes_before_work,
    notes_on_gaps,
    notes_on_model,
    notes_on_silence,
    notes_on_times,
)
from rangesfm.errors import InputError
from rangesfm.measurements.kind_as_read import TimedLog
from rangesfm.measurements.lengths.tape import Tape, TapedDistance
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
        list(notes_before_work(complete, in_mm))
    printed = replace(in_mm, log=replace(in_mm.log, format="mauwb"))  # its unit cannot be given
    for survey, inputs in ((complete.changed({"ranges.range_unit": "m"}), in_mm), (complete, printed)):
        notes = notes_before_work(survey, replace(inputs, anchor_frame="unknown"))
        assert any(note.startswith("nearly all ranges are longer than") for note in notes)


def test_positions_that_are_not_used_are_not_looked_at(complete: Survey) -> None:
    level = with_heights(read_ranging_inputs(complete), [0.0] * 4)
    assert not list(notes_before_work(complete, replace(level, anchor_frame="unknown")))


WALK_S = np.linspace(0.0, 120.0, 400)


def of_log(times_s: Array, words: str = "ranges", offset_s: float | None = None) -> TimedLog:
    return TimedLog(words, None, times_s, offset_s)


@pytest.mark.parametrize("offset_s", [0.0, -50.0, 1.7e9])
def test_clocks_that_differ_are_no_matter(offset_s: float) -> None:
    assert not list(notes_on_times(of_log(WALK_S + offset_s), WALK_S + 3.0))


@pytest.mark.parametrize("words", ["ranges", "known positions"])
def test_times_an_hour_apart_by_clocks_that_know_the_date_are_told(words: str) -> None:
    (note,) = notes_on_times(of_log(WALK_S + 1.7e9, words), WALK_S + 1.7e9 + 3600)
    assert note.startswith(f"by their clocks, {words} (2023-11-14 22:13:20.000 to 22:15:20.000 UTC) and photos (2023-")
    assert "0.97 h apart: another time zone, or another walk" in note
    assert not list(notes_on_times(of_log(WALK_S + 1.7e9, words, offset_s=3600.0), WALK_S + 1.7e9 + 3600))


def test_ranges_that_last_a_fraction_of_the_walk_are_told() -> None:
    (note,) = notes_on_times(of_log(1e-3 * WALK_S), WALK_S)
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
    assert not list(notes_on_times(of_log(WALK_S[:num_ranges]), WALK_S[:num_photos]))


def test_keyframes_too_far_apart_for_the_ranges_between_them_are_told_and_one_pause_is_not() -> None:
    assert not list(notes_on_gaps(np.append(np.arange(10.0), 11.5), 2.0))
    assert not list(notes_on_gaps(np.array([3.0]), 2.0))
    assert not list(notes_on_gaps(np.concatenate([np.arange(10.0), 3600 + np.arange(10.0)]), 2.0))
    (note,) = notes_on_gaps(np.array([0.0, 1.0, 3.1, 5.2, 7.3]), 2.0)
    assert "for 86 % of the time keyframes are more than 2 s apart (in the median 2.1 s)" in note


@pytest.fixture
def model() -> pycolmap.Reconstruction:
    path, times = loop_path(30.0, seed=3), np.arange(1.0, 29.0)
    made = synthetic_model(*along(path, times), num_observations=40, pixel_stddev=1.0)
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


def triangles(of_pairs: Mapping[tuple[int, int], Sequence[tuple[float, float]]]) -> preflight._Triangles:
    """Bounds, shortest and longest, on the distances of pairs of anchors."""
    rows = [(pair, *bounds) for pair, of_pair in of_pairs.items() for bounds in of_pair]
    pairs, shortest_m, longest_m = zip(*rows, strict=True)
    return preflight._Triangles(np.array(pairs), np.array(shortest_m), np.array(longest_m))


def causes(of_pairs: Mapping[tuple[int, int], float], positions_m: Array) -> list[str]:
    """Causes of contradictions, for pairs of anchors A, B, C, ... that ranges find so far apart."""
    measured = triangles({pair: [(apart_m, apart_m)] * 10 for pair, apart_m in of_pairs.items()})
    return list(preflight._causes(measured, "ABCDE"[: len(positions_m)], positions_m, measured.bad_pairs(positions_m)))


def apart(positions_m: Array) -> dict[tuple[int, int], float]:
    """True distances of all pairs."""
    of_pairs = combinations(range(len(positions_m)), 2)
    return {(i, k): float(np.linalg.norm(positions_m[i] - positions_m[k])) for i, k in of_pairs}

"""Mistakes in simulated surveys are found and named, and clean surveys cause no alarm."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from tests.known import known
from tests.simulated.runs import run
from tests.simulated.surveys import SITES, MadeSurvey, surveyed
from tests.studies.mistakes import kinds

from rangesfm.measurements.mistakes import Correction, MistakeTest, MistakeTests
from rangesfm.measurements.ranges.mistakes.alternatives import alternatives
from rangesfm.measurements.ranges.mistakes.catalogue import STANDING
from rangesfm.measurements.ranges.mistakes.find_mistakes import find_mistakes
from rangesfm.measurements.ranges.mistakes.linearized import Linearized, linearized

HALL, YARD, DRONE = SITES
SEED = 3


@pytest.fixture(scope="module")
def of_yard() -> Linearized:
    """The linear problem of a clean survey."""
    return linearized(known(run(surveyed(YARD, SEED), SEED).on_map))


def diagnosis(given: MadeSurvey) -> MistakeTests:
    found = run(given, SEED).diagnosis
    assert found is not None
    return found


def correction(cause: MistakeTest) -> Correction:
    assert cause.correction is not None
    return cause.correction


def test_a_clean_survey_is_not_doubted() -> None:
    found = diagnosis(surveyed(DRONE, SEED))
    assert found.reasons == ()
    assert not any(test.rejected for test in found.tests)
    assert len({(test.name, test.subject) for test in found.tests}) == len(found.tests)


def test_a_clock_that_is_off_is_named_with_its_size() -> None:
    given = surveyed(DRONE, SEED)
    given.time_offset_s = 0.15
    found = diagnosis(given)
    assert [cause.name for cause in found.causes] == ["clock offset"]
    assert correction(found.causes[0]).time_shift_s == pytest.approx(-0.15, abs=0.03)


def test_a_lever_arm_with_the_wrong_sign_is_named_as_such() -> None:
    given = surveyed(DRONE, SEED)
    given.tag_in_cam_m = -4 * given.tag_in_cam_m
    given.tags_m = given.tags_m + given.world_from_cam @ (3 * np.array(DRONE.tag_in_cam_m))
    given.range_m = given.range_m + np.linalg.norm(given.tags_m - given.true_anchors_m["B"], axis=1)
    given.range_m -= np.linalg.norm(
        given.tags_m - given.world_from_cam @ (3 * np.array(DRONE.tag_in_cam_m)) - given.true_anchors_m["B"], axis=1
    )
    found = diagnosis(given)
    assert "lever arm's axes" in {cause.name for cause in found.causes}
    assert "wrong sign" in found.reasons[0]


def test_what_no_survey_with_one_unknown_anchor_can_show_is_not_claimed() -> None:
    given = surveyed(DRONE, SEED)
    given.range_m = 1.05 * given.range_m
    found = diagnosis(given)
    assert found.reasons == ()
    share = next(test for test in found.tests if test.name == "range scale")
    assert share.effect_on_scale > 0.2


def test_most_ranges_without_line_of_sight_are_a_finding() -> None:
    given = surveyed(DRONE, SEED)
    rng = np.random.default_rng(0)
    given.range_m = given.range_m + (rng.random(len(given.range_m)) < 0.7) * rng.exponential(1.0, len(given.range_m))
    assert "radios with a clear line of sight stay below" in diagnosis(given).reasons[0]


def test_an_anchor_that_is_mostly_blocked_is_named_before_what_that_looks_like() -> None:
    given = surveyed(HALL, SEED)
    rng, num = np.random.default_rng(0), len(given.range_m)
    given.range_m = given.range_m + (given.is_of("A1") & (rng.random(num) < 0.7)) * rng.exponential(1.5, num)
    likeliest = diagnosis(given).tests[0]
    assert (likeliest.name, likeliest.subject) == ("anchor's outliers", "A1")
    assert likeliest.words.startswith(f"{100 * known(likeliest.size):.0f} % of the ranges to anchor A1 ")


def test_ranges_to_another_anchor_under_a_label_are_named() -> None:
    given = surveyed(HALL, SEED)
    (mistake,) = [each for each in kinds(given.ids) if each.name == "a third of A1 is of A2"]
    mistake.make(given, 1.0, np.random.default_rng(SEED))
    assert "fit anchor A2 instead" in diagnosis(given).reasons[0]


def test_a_step_of_all_ranges_is_found_at_its_own_time() -> None:
    given = surveyed(DRONE, SEED)
    given.range_m = given.range_m + 0.5 * (given.time_s > np.quantile(given.time_s, 0.5))
    assert "the ranges jumped 50 s after the first range: since then they read about 0.5" in diagnosis(given).reasons[0]


def test_the_coordinate_that_was_typed_wrong_is_named() -> None:
    given = surveyed(replace(YARD, rate_hz=3.0), SEED)
    given.anchors_m["S"] = given.anchors_m["S"] + [2.0, 0.0, 0.0]
    found = diagnosis(given)
    assert f"anchor S's x is given as {given.anchors_m['S'][0]:.3f}" in found.reasons[0]
    assert correction(found.causes[0]).anchors_m == {"S": None}


@pytest.mark.parametrize(("axis", "factor"), [(0, 10.0), (1, -1.0)], ids=["point", "sign"])
def test_a_coordinate_without_its_point_or_its_sign_is_named(axis: int, factor: float) -> None:
    """No range to that anchor fits then, so that none has a weight."""
    given = surveyed(HALL, SEED)
    wrong, right = given.anchors_m["A6"].copy(), given.anchors_m["A6"]
    wrong[axis] *= factor
    given.anchors_m["A6"] = wrong
    cause = diagnosis(given).causes[0]
    assert (cause.name, cause.subject) in {("anchor place", "A6"), ("anchor coordinate", "A6 " + "xyz"[axis])}
    assert correction(cause).anchors_m == {"A6": None}
    [likeliest, *_] = find_mistakes(known(run(given, SEED).on_map)).causes
    np.testing.assert_allclose(likeliest.state.anchors_m[5], right, atol=0.5)


def test_two_labels_that_were_swapped_are_named() -> None:
    given = surveyed(YARD, SEED)
    anchors = given.anchors_m
    given.anchors_m = {**anchors, "N": anchors["E"], "E": anchors["N"]}
    found = diagnosis(given)
    assert found.causes[0].subject == "E, N"
    np.testing.assert_array_equal(correction(found.causes[0]).anchors_m["E"], anchors["E"])


@pytest.mark.parametrize("needs_search", [False, True], ids=["placed", "not placed"])
def test_photos_in_reverse_are_named(needs_search: bool) -> None:
    """This also holds if they leave the map without a place in the site, so that only the anchors' distances count."""
    given = surveyed(HALL, 5)
    given.time_s = given.time_s.min() + given.time_s.max() - given.time_s
    given.needs_search = needs_search
    assert [cause.name for cause in diagnosis(given).causes] == ["photos reversed"]


def test_labels_that_are_one_line_off_are_named() -> None:
    """The order is that of the file's lines, not the alphabet."""
    given = surveyed(YARD, SEED)
    at = list(given.anchors_m.values())
    given.anchors_m = dict(zip(given.anchors_m, [*at[1:], at[0]], strict=True))
    given.needs_search = True
    found = diagnosis(given)
    assert found.causes[0].name == "lines shifted"
    assert "in the line after it" in found.reasons[0]


def test_long_ranges_and_small_coordinates_are_named_together() -> None:
    given = surveyed(YARD, SEED)
    given.range_m = 1.06 * given.range_m
    assert {cause.name for cause in diagnosis(given).causes} == {"range scale", "anchors' scale"}


@pytest.mark.parametrize(("factor", "words"), [(0.94, "small"), (1.06, "large")])
def test_coordinates_that_are_too_small_are_not_called_too_large(factor: float, words: str) -> None:
    given = surveyed(YARD, SEED)
    true_m = given.anchors_m
    given.anchors_m = {name: factor * place_m for name, place_m in true_m.items()}
    found = diagnosis(given)
    said = re.search(r"anchors' coordinates are about ([0-9.]+) % too (\w+)", found.reasons[0])
    assert said is not None
    assert said[2] == words
    # The text states the correction in percent; each of two causes that look alike explains all of it.
    assert float(said[1]) == pytest.approx(100 * abs(1 / factor - 1), abs=1.0)
    (of_scale,) = (correction(cause) for cause in found.causes if cause.name == "anchors' scale")
    apart_m, corrected_m = (
        np.linalg.norm(known(places["N"]) - known(places["S"])) for places in (true_m, of_scale.anchors_m)
    )
    assert corrected_m == pytest.approx(apart_m, rel=0.01)


def test_an_anchor_that_reads_long_is_named_unless_radios_do_so() -> None:
    given = surveyed(HALL, SEED)
    of_a1 = given.is_of("A1")
    given.range_m = given.range_m + 0.8 * of_a1
    likeliest = diagnosis(given).causes[0]
    assert (likeliest.name, likeliest.subject) == ("anchor bias", "A1")
    given.range_m = given.range_m - 0.74 * of_a1
    assert diagnosis(given).reasons == ()


@pytest.mark.parametrize(
    ("kind", "size", "name"),
    [
        ("radio warms up", 1.0, "radio drift"),
        ("map breaks", 0.6, "map break"),
        ("tag slips", 0.6, "tag slipped"),
        ("surveyor in between", 0.25, "behind the camera"),
        ("anchors in feet", 1.0, "anchors' unit"),
    ],
)
def test_a_mistake_is_the_likeliest_cause(kind: str, size: float, name: str) -> None:
    given = surveyed(YARD, SEED)
    (mistake,) = [each for each in kinds(given.ids) if each.name == kind]
    mistake.make(given, size, np.random.default_rng(SEED))
    given.needs_search = mistake.of is None
    assert diagnosis(given).causes[0].name == name


def test_heights_that_nobody_measured_are_told_beside_one_anchor_of_which_they_may_be() -> None:
    given = surveyed(YARD, SEED)
    given.anchors_m = {name: at * [1.0, 1.0, 0.0] for name, at in given.anchors_m.items()}
    assert "all anchors are given the same height, 0 m, but the ranges fit heights that" in diagnosis(given).reasons[0]


def test_a_clock_that_runs_as_no_quartz_does_is_not_named_so() -> None:
    """Times stretched by 2 % are a mistake and are found, but no clock drifts by 20 000 ppm."""
    given = surveyed(HALL, SEED)
    given.time_s = given.time_s.mean() + 1.02 * (given.time_s - given.time_s.mean())
    found = diagnosis(given)
    assert found.reasons
    assert "ppm" not in " ".join(found.reasons)
    (row,) = [test for test in found.tests if test.name == "clock drift"]
    assert not row.rejected
    assert np.isnan(row.size)
    assert row.words == "no clock drift that can happen (0.0002 s/s at most) explains the measurements"


def test_a_tag_that_is_found_farther_than_its_camera_is_large_did_not_slip() -> None:
    given = surveyed(YARD, SEED)
    (slip,) = [each for each in kinds(given.ids) if each.name == "tag slips"]
    slip.make(given, 3.0, np.random.default_rng(SEED))
    found = diagnosis(given)
    assert found.reasons
    assert "tag slipped" not in {cause.name for cause in found.causes}
    assert all(not test.size >= 0.75 for test in found.tests if test.name == "tag slipped")


@pytest.mark.parametrize(("size", "said"), [(0.03, "3.0 % too long"), (-0.03, "3.0 % too short")])
def test_ranges_that_grow_too_much_are_said_to_be_too_long(size: float, said: str, of_yard: Linearized) -> None:
    (of_all,) = [h for of_kind in STANDING for h in of_kind(of_yard) if h.name == "range scale"]
    assert of_all.words(np.array([size])) == f"all ranges read about {said}"


def test_a_lever_arm_in_other_axes_is_as_long_as_it_was_given() -> None:
    given = surveyed(DRONE, SEED)
    of_arms = [each for each in alternatives(known(run(given, SEED).on_map)) if each.name == "lever arm's axes"]
    moves_m = [move_m for each in of_arms for move_m in each.correction(np.zeros(0)).tag_moves_m.values()]
    arm_m = np.asarray(given.tag_in_cam_m)
    assert len(moves_m) == 5
    np.testing.assert_allclose(np.linalg.norm(arm_m + np.array(moves_m), axis=1), np.linalg.norm(arm_m), rtol=1e-6)
    assert len(np.unique(np.round(moves_m, 6), axis=0)) == 5

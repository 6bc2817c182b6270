"""The side of a nearly flat path on which an unknown anchor stands, with a map that may have drifted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tests.known import known
from tests.simulated.runs import run, run_stages
from tests.simulated.surveys import DRONE, MadeSurvey, surveyed
from tests.studies.drifting_maps import lap_of_drift

from rangesfm.measurements.joint_map import find_kind
from rangesfm.measurements.ranges.mistakes.bent_path import likelier_sides
from rangesfm.measurements.ranges.scale.range_scale import RangeScale
from rangesfm.measurements.ranges.scale.ranges_on_map import RangesOnMap
from rangesfm.pipeline.metric_result import MetricResult

DRIFT_M, NUM_KEYFRAMES = 0.5, 100
# As one piece, this map fits better with the anchor below the path. The anchor is above it, which is -y here.
FITS_BELOW = 1
# This one tells the sides apart neither before nor after it is refined.
TELLS_NOTHING = 2


def lap(seed: int) -> MadeSurvey:
    return lap_of_drift(DRIFT_M, seed, "unknown", num_keyframes=NUM_KEYFRAMES)


@pytest.fixture(scope="module")
def crossed() -> MetricResult:
    return run_stages(lap(FITS_BELOW), 0)


def test_an_anchor_that_drift_puts_on_the_wrong_side_is_brought_to_the_right_one(crossed: MetricResult) -> None:
    [anchor] = crossed.anchors
    truth_m = lap(FITS_BELOW).anchors_m["A1"]
    assert np.linalg.norm(anchor.position_m - truth_m) < 3 * np.sqrt(3) * anchor.position_stddev_m
    assert anchor.mirror_position_m is None
    assert crossed.estimate.verdict == "good", crossed.estimate.reasons


def on_moved_map(metric: MetricResult) -> RangesOnMap:
    at_rest = metric.all_measured
    return known(find_kind(at_rest.kinds, RangeScale)).moved(at_rest.posterior).on(at_rest)


def test_an_anchor_on_the_right_side_stays_there(crossed: MetricResult) -> None:
    sides = likelier_sides(on_moved_map(crossed))
    assert not sides.has_crossed
    assert sides.mirrors_m == {"A1": None}
    assert sides.applied_to(crossed.anchors) == crossed.anchors


def test_sides_that_the_ranges_do_not_tell_apart_are_both_given() -> None:
    survey = lap(TELLS_NOTHING)
    found = run_stages(survey, 0)
    [anchor] = found.anchors
    places_m = np.array([anchor.position_m, known(anchor.mirror_position_m)])
    off_m = np.linalg.norm(places_m - survey.anchors_m["A1"], axis=1)
    assert off_m.min() < 1.0
    assert off_m.max() > 10.0
    assert any("on which side of it the unknown anchors stand" in reason for reason in found.estimate.reasons)


def test_surveyed_anchors_are_left_alone(crossed: MetricResult) -> None:
    on_map = on_moved_map(crossed)
    surveyed_m = replace(on_map.problem, anchor_mean_m=on_map.state.anchors_m, anchor_stddev_m=np.array([0.02]))
    assert likelier_sides(on_map.with_problem(surveyed_m)).mirrors_m == {}


def test_a_path_that_goes_up_and_down_leaves_nothing_open() -> None:
    on_map = known(run(surveyed(DRONE, 3), 3).on_map)
    sides = likelier_sides(on_map)
    assert sides.on_map is on_map
    assert sides.mirrors_m == {"B": None}

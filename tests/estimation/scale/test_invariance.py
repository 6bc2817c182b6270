"""The scale does not depend on units, on the origins of the worlds, or on the order of the input."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rangesfm.demo.simulated_radio import Radio
from rangesfm.errors import GeometryError
from rangesfm.estimation.scale.initialize import initialize_scale
from rangesfm.estimation.scale.scale_estimate import ScaleEstimate
from rangesfm.measurements.ranges.association import associate
from rangesfm.util.geometry.similarity import Similarity

if TYPE_CHECKING:
    from tests.estimation.scale.conftest import MakeSurvey, Survey

    from rangesfm.measurements.ranges.range_log import RangeLog

SAME = 1e-9
ANCHORS = ("A", "B", "C", "D", "E")
a_few = settings(max_examples=4)


@pytest.fixture(scope="module")
def survey(make_survey: MakeSurvey) -> Survey:
    return make_survey(radio=Radio(range_stddev_m=0.05), num_keyframes=20)


def estimate(survey: Survey, frame: str = "first_camera", log: RangeLog | None = None) -> ScaleEstimate:
    known = () if frame == "unknown" else ANCHORS
    return survey.scale(frame, known, log=log)


def assert_same(found: ScaleEstimate, expected: ScaleEstimate, factor: float = 1.0) -> None:
    assert found.value == pytest.approx(factor * expected.value, rel=SAME)
    assert found.interval_95 == pytest.approx([factor * end for end in expected.interval_95], rel=1e-6)
    assert (found.verdict, found.frame) == (expected.verdict, expected.frame)


@given(exponent=st.floats(-6, 6))
@a_few
def test_any_unit_of_the_map_will_do(survey: Survey, exponent: float) -> None:
    unit = 10.0**exponent
    smaller = replace(survey, trajectory=survey.trajectory.transformed(Similarity(1 / unit, np.eye(3), np.zeros(3))))
    assert_same(estimate(smaller), estimate(survey), unit)


@given(origin=st.tuples(*[st.floats(-1e7, 1e7)] * 3))
@a_few
def test_the_origin_of_the_map_may_be_10_000_km_away(survey: Survey, origin: tuple[float, float, float]) -> None:
    away = replace(survey, trajectory=survey.trajectory.transformed(Similarity(1.0, np.eye(3), np.array(origin))))
    found, expected = estimate(away), estimate(survey)
    # Coordinates have a resolution of 2e-9 there, which limits the accuracy.
    assert found.value == pytest.approx(expected.value, rel=1e-7)
    assert found.verdict == expected.verdict


@pytest.mark.parametrize("frame", ["first_camera", "unknown"])
def test_the_order_of_ranges_and_anchors_does_not_matter(survey: Survey, frame: str) -> None:
    rng = np.random.default_rng(0)
    expected = estimate(survey, frame)
    log = survey.log.subset(rng.permutation(len(survey.log)))
    assert_same(estimate(survey, frame, log=log), expected)
    positions = list(survey.anchors_m.items())
    turned = replace(survey, anchors_m=dict(reversed(positions)))
    anchors = {anchor.anchor_id: anchor for anchor in turned.anchors("first_camera", ANCHORS)}
    if frame == "first_camera":
        observations = associate(log, survey.trajectory, survey.tag_in_cam_m)
        in_order = [anchors[name] for name in log.anchor_ids]
        found = initialize_scale(observations, survey.trajectory, in_order, anchor_frame=frame)
        assert_same(found, expected)


def test_a_tag_exactly_on_an_anchor_does_no_harm(make_survey: MakeSurvey, survey: Survey) -> None:
    tag_m = survey.centers_m[5] + survey.world_from_cam[5] @ survey.tag_in_cam_m
    on_it = make_survey(num_keyframes=20, anchors_m={"A": tuple(tag_m), "B": (6.0, 0.0, 2.5)})
    log = on_it.log_with(np.maximum(on_it.distance_m, 1e-9))
    found = on_it.scale("first_camera", ("A", "B"), log)
    assert on_it.relative_error(found) == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize("frame", ["site", "unknown"])
@pytest.mark.parametrize("range_m", [1e-300, 5.0, 1e6])
def test_ranges_that_are_all_alike_are_refused(survey: Survey, frame: str, range_m: float) -> None:
    with pytest.raises(GeometryError, match="no range changed"):
        estimate(survey, frame, log=survey.log_with(np.full(len(survey.log), range_m)))


def test_ranges_that_are_all_alike_are_refused_where_the_first_camera_has_a_place(survey: Survey) -> None:
    with pytest.raises(GeometryError, match="the scale is not determined: ranges and photos leave the shape"):
        estimate(survey, log=survey.log_with(np.full(len(survey.log), 1e6)))

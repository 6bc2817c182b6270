"""The page of a plan shows the plan's figures, and colours the path by its expected uncertainty."""

from __future__ import annotations

import html
import re
from dataclasses import replace

import numpy as np
import pytest
from tests.planning.plans import COPLANAR_M, FIVE_ANCHORS_M, loop, planned

from rangesfm.measurements.mistake_words import mistake_in_words
from rangesfm.measurements.positions.control_points import ControlPoint
from rangesfm.planning.paths import path_through
from rangesfm.planning.planned_photos import PlannedPhotos
from rangesfm.planning.survey_plan import SurveyPlan, plan_survey
from rangesfm.report.plan_page import accuracy_views, render_plan


@pytest.fixture(scope="module")
def plan() -> SurveyPlan:
    return plan_survey(planned(FIVE_ANCHORS_M, "site", loop(30.0, 40)))


def test_every_keyframe_has_the_colour_of_its_accuracy(plan: SurveyPlan) -> None:
    series = accuracy_views(plan).panels[0].series
    for one in series:
        # Legend entries read "below 0.1 m", "0.1 m to 0.12 m" or "above 0.2 m".
        ends = [float(end) for end in re.findall(r"[\d.]+", one.name)]
        low, high = {"b": [0.0, *ends], "a": [*ends, np.inf]}.get(one.name[0], ends)
        for stddev_m, at in zip(plan.expected.keyframe_stddevs_m, one.points, strict=True):
            assert np.isfinite(at).all() or not low < 1.96 * stddev_m < high
    assert len({one.color for one in series}) == len(series)
    ends_m = [float(one.name.split()[-2]) for one in series[:-1]]
    assert ends_m[3] == pytest.approx(10 * ends_m[0])  # a factor of 10 around the median
    assert ends_m[1] <= 1.96 * np.median(plan.expected.keyframe_stddevs_m) <= ends_m[2]


def test_walls_are_drawn_from_above(plan: SurveyPlan) -> None:
    corners = np.array([[-9.0, -9.0], [9.0, -9.0], [9.0, 9.0]])
    walled = replace(plan.expected.planned, walls_m=(corners,))
    views = accuracy_views(replace(plan, expected=replace(plan.expected, planned=walled))).panels
    walls = [[one for one in view.series if one.name == "walls"] for view in views]
    assert [len(of_view) for of_view in walls] == [1, 0]
    np.testing.assert_array_equal(walls[0][0].points[:-1], corners)
    assert views[0].x_range is not None
    assert views[0].x_range[0] < -9 < 9 < views[0].x_range[1]


def test_the_area_is_known_less_further_out(plan: SurveyPlan) -> None:
    picture = accuracy_views(plan).panels[0].picture
    assert picture is not None
    middle, corner = picture[picture.shape[0] // 2, picture.shape[1] // 2, :3], picture[0, 0, :3]
    assert middle.tolist() != corner.tolist()


def test_the_page_ranks_the_advice_and_fetches_nothing(plan: SurveyPlan) -> None:
    page = render_plan(plan)
    first = plan.advice_for_place[0].words.replace("'", "&#39;")
    assert f"1. {first}" in page
    assert "default-src &#39;none&#39;" in page
    low, high = plan.scale_interval_95
    assert f"± {50 * (high - low):.2g}\u00a0%" in page


def test_what_is_open_is_called_so() -> None:
    path = loop(30.0, 40, height_amplitude_m=0.0)
    level = replace(path, centers=path.centers * [1.0, 1.0, 0.0] + [0.0, 0.0, 1.6])
    plan = plan_survey(planned(COPLANAR_M, "site", level))
    assert [series.name for series in accuracy_views(plan).panels[0].series][-1] == "open"
    assert "open" in render_plan(plan)


def test_page_and_terminal_list_the_same_advice_and_the_same_mistakes(plan: SurveyPlan) -> None:
    page, lines = html.unescape(render_plan(plan)), "\n".join(plan.lines)
    for advice in (*plan.advice_for_scale, *plan.advice_for_place):
        assert advice.words in page
        assert advice.words in lines
    for text in (page, lines):
        assert "range share" not in text
    for mistake in plan.largest_mistakes:
        assert mistake_in_words(mistake.name, mistake.subject) in page
        assert mistake_in_words(mistake.name, mistake.subject) in lines
    num_advised = len(plan.advice_for_scale) + len(plan.advice_for_place)
    assert len(re.findall(r"^  \d+\. ", lines, re.MULTILINE)) == num_advised
    assert len(re.findall(r'<th scope="row">\d+\. ', page)) == num_advised


def test_the_page_of_a_refused_plan_says_what_would_make_it_possible() -> None:
    short = path_through([(0.0, 0.0, 1.6), (0.5, 0.0, 1.6)], speed_m_per_s=0.5, photo_rate_hz=2.0)
    page = html.unescape(render_plan(plan_survey(planned(FIVE_ANCHORS_M[:2], "site", short, rate_hz=1.0))))
    assert "Scale: refused" in page
    assert "ranges lie on the path" in page
    assert "walk the path 5 times, there and back" in page


def test_control_points_are_drawn_and_both_kinds_of_measurement_compared() -> None:
    places = PlannedPhotos().aside(loop(30.0, 40), np.array([0, 13, 26]))
    points = tuple(ControlPoint(f"C{k}", at, 0.01, "control", k) for k, at in enumerate(places[:3]))
    beside = plan_survey(replace(planned(FIVE_ANCHORS_M, "site", loop(30.0, 40)), points=points))
    marks = [mark.label for mark in accuracy_views(beside).panels[0].marks if mark.name == "control point"]
    assert marks == ["C0", "C1", "C2"]
    page = render_plan(beside)
    assert "What each kind of measurement would give" in page
    assert "positions alone" in page

"""A plan gives the expected uncertainty, the mistakes that would be found and what to change, in numbers that hold."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tests.planning.plans import COPLANAR_M, FIVE_ANCHORS_M, loop, planned

from rangesfm.measurements.mistake_words import mistake_in_words
from rangesfm.planning.advice import advise
from rangesfm.planning.expected import expect
from rangesfm.planning.survey_plan import SurveyPlan, plan_survey, size_in_words
from rangesfm.report.plan_page import write_plan


@pytest.fixture(scope="module")
def plan() -> SurveyPlan:
    return plan_survey(planned(FIVE_ANCHORS_M, "site"))


def test_the_budget_adds_up_to_the_stddev_and_the_interval_is_1_96_of_it(plan: SurveyPlan) -> None:
    assert np.linalg.norm(list(plan.expected.uncertainty.components.values())) == pytest.approx(
        plan.expected.uncertainty.empirical
    )
    assert np.log1p(plan.scale_interval_95) == pytest.approx(
        [-1.96 * plan.expected.uncertainty.empirical, 1.96 * plan.expected.uncertainty.empirical]
    )


def test_advice_that_is_followed_gains_what_it_promised(plan: SurveyPlan) -> None:
    survey = planned(FIVE_ANCHORS_M, "site")
    learn = next(advice for advice in plan.advice_for_scale if advice.kind == "calibration")
    followed = expect(replace(survey, curve_stddev_m=0.02))
    assert followed.uncertainty.empirical == pytest.approx(learn.scale_stddev, rel=0.1)
    raised = next(advice for advice in plan.advice_for_place if advice.kind == "anchor height")
    height_m = float(raised.words.split()[-2])
    anchors = tuple(
        replace(a, position_m=np.array([*at[:2], height_m])) if a.anchor_id == raised.subject else a
        for a, at in zip(survey.anchors, survey.anchors_m, strict=True)
    )
    assert expect(replace(survey, anchors=anchors)).worst_keyframe_m == pytest.approx(raised.place_stddev_m, rel=0.1)


def test_advice_is_ranked_by_its_gain_and_each_thing_is_advised_once(plan: SurveyPlan) -> None:
    for ranking, gain in (
        (plan.advice_for_scale, [advice.scale_gain for advice in plan.advice_for_scale]),
        (plan.advice_for_place, [advice.place_gain for advice in plan.advice_for_place]),
    ):
        assert gain == sorted(gain, reverse=True)
        assert min(gain) > 0
        assert len({(advice.kind, advice.subject) for advice in ranking}) == len(ranking)


@pytest.fixture(scope="module")
def level_plan() -> SurveyPlan:
    """A plan whose anchors are all at the height of a rover's path."""
    path = loop(height_amplitude_m=0.0)
    level = replace(path, centers=path.centers * [1.0, 1.0, 0.0] + [0.0, 0.0, 1.6])
    return plan_survey(planned(COPLANAR_M, "site", level, path_is_level=True))


def test_with_all_anchors_at_a_rovers_height_the_first_advice_is_to_raise_one(level_plan: SurveyPlan) -> None:
    assert level_plan.place is not None
    assert np.isinf(level_plan.place.stddev_m[2])
    first = level_plan.advice_for_place[0]
    assert first.kind == "anchor height"
    assert first.words.startswith("raise anchor")
    assert first.place_stddev_m < 2.0
    assert any("z open" in line for line in level_plan.lines)


def test_anchors_stay_within_the_heights_that_are_allowed() -> None:
    plan = plan_survey(planned(FIVE_ANCHORS_M, "site", heights_m=(0.0, 2.0)))
    heights = [float(a.words.split()[-2]) for a in plan.advice if a.kind == "anchor height"]
    assert heights
    assert all(0.0 <= height <= 2.0 for height in heights)


def test_advice_stays_within_the_walls() -> None:
    """The path is 8 m wide: 1.5 times as wide it leads through walls that are 10 m apart, and not 1.25 times."""
    survey = planned(FIVE_ANCHORS_M, "site", loop(30.0, 60))
    half_m = np.abs(survey.trajectory.centers[:, :2]).max(axis=0)

    def widths(share: float) -> set[str]:
        corners = share * half_m * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]])
        advice = advise(expect(replace(survey, walls_m=(corners,))))
        return {each.words for each in advice if each.kind == "wider path"}

    assert widths(3.0) == {"walk 1.5 times as wide", "walk 1.25 times as wide"}
    assert widths(1.4) == {"walk 1.25 times as wide"}
    assert widths(1.1) == set()


def test_mistakes_that_would_be_found_have_a_size_and_an_effect(plan: SurveyPlan) -> None:
    places = [mistake for mistake in plan.mistakes if mistake.name == "anchor place"]
    assert {mistake.subject for mistake in places} == {
        anchor.anchor_id for anchor in planned(FIVE_ANCHORS_M, "site").anchors
    }
    for mistake in places:
        assert 0.05 < mistake.smallest_detectable < 5.0
        assert np.isfinite(mistake.effect_on_scale)


def test_ten_times_the_ranges_average_out_their_noise_and_hardly_anything_else() -> None:
    few, many = (expect(planned(FIVE_ANCHORS_M, "site", rate_hz=rate)) for rate in (1.0, 10.0))
    assert many.planned.num_ranges == 10 * few.planned.num_ranges
    assert many.uncertainty.components["white"] < 0.7 * few.uncertainty.components["white"]
    assert 0.8 * few.uncertainty.empirical < many.uncertainty.empirical < 1.05 * few.uncertainty.empirical


def test_plan_json_holds_it_all_and_what_is_open_is_null(level_plan: SurveyPlan, tmp_path: Path) -> None:
    content = json.loads(write_plan(level_plan, tmp_path / "plan")[0].read_text())
    assert content["scale_stddev"] == level_plan.expected.uncertainty.empirical
    assert content["place"]["stddev_m"][2] is None
    assert len(content["advice_for_place"]) == len(level_plan.advice_for_place)


def test_a_survey_with_unknown_anchors_has_no_place() -> None:
    plan = plan_survey(planned(FIVE_ANCHORS_M[:2], "unknown"))
    assert plan.expected.frame == "first_camera"
    assert plan.place is None
    assert {advice.kind for advice in plan.advice_for_place} == {"control points"}


def test_a_plan_has_the_verdicts_of_a_run_in_its_words(plan: SurveyPlan) -> None:
    assert plan.place is not None
    assert (plan.verdict, plan.place.verdict) == ("good", "good")
    (words,) = plan.place.reasons
    worst = f"{1.96 * plan.place.worst_keyframe_stddev_m:.2g}"
    assert words.startswith("the map's place is known to ")
    assert words.endswith(f"each keyframe to {worst} m or better (95 %)")
    assert {f"  {words}", f"  {plan.reasons[0]}"} < set(plan.lines)
    coarse = tuple(replace(anchor, position_stddev_m=2.0) for anchor in planned(FIVE_ANCHORS_M, "site").anchors)
    vague = plan_survey(replace(planned(FIVE_ANCHORS_M, "site", loop(30.0, 60)), anchors=coarse)).place
    assert vague is not None
    assert vague.verdict == "doubtful"


def test_every_mistake_of_the_catalogue_has_plain_words(plan: SurveyPlan) -> None:
    level = tuple((x, y, 2.0) for x, y, _ in FIVE_ANCHORS_M)
    expected = plan_survey(planned(level, "site", loop(30.0, 60)))
    for mistake in (*plan.mistakes, *expected.mistakes):
        words = mistake_in_words(mistake.name, mistake.subject)
        assert words != f"{mistake.name} {mistake.subject}".strip() or mistake.name == "lever arm"
        assert mistake.subject in words or not mistake.subject
    names = [mistake.name for mistake in expected.largest_mistakes]
    assert "anchor heights" in names
    assert len(set(names)) == len(names)
    assert size_in_words(0.031, "1") == "3.1 %"
    assert size_in_words(np.inf, "m") == "never found"

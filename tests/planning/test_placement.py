"""Anchors that may stand anywhere in a box are put where they help most."""

from __future__ import annotations

import numpy as np
from tests.planning.plans import loop, planned

from rangesfm.planning.expected import expect
from rangesfm.planning.paths import path_through
from rangesfm.planning.placement import place_anchors, places_in_box, places_on_walls, spread_anchors
from rangesfm.planning.survey_plan import plan_survey

LOW, HIGH = (-7.0, -6.0, 0.3), (7.0, 6.0, 3.0)


def test_spread_anchors_begin_in_the_corners() -> None:
    anchors = spread_anchors(4, places_in_box(LOW, HIGH), 0.02)
    assert [anchor.anchor_id for anchor in anchors] == ["P1", "P2", "P3", "P4"]
    for anchor in anchors:
        assert anchor.position_m is not None
        assert np.all((anchor.position_m == LOW) | (anchor.position_m == HIGH))
    assert len({tuple(anchor.position_m) for anchor in anchors if anchor.position_m is not None}) == 4


def test_places_on_walls_lie_on_them_at_both_heights() -> None:
    square, shelf = [(0, 0), (8, 0), (8, 8), (0, 8), (0, 0)], [(2, 4), (6, 4)]
    places = places_on_walls([square, shelf], (0.5, 3.0))
    assert len(np.unique(places, axis=0)) == len(places) >= 32
    x, y, z = places.T
    on_square = np.isin(x, [0, 8]) & (y >= 0) & (y <= 8) | np.isin(y, [0, 8]) & (x >= 0) & (x <= 8)
    on_shelf = (y == 4) & (x >= 2) & (x <= 6)
    assert np.all(on_square | on_shelf)
    assert on_shelf.sum() >= 4
    assert set(z) == {0.5, 3.0}


def test_placed_anchors_stand_in_the_box_and_know_more_than_a_bad_choice() -> None:
    # All in one corner, at one height.
    crowded = [(-7.0, -6.0, 0.3), (-7.0, -2.0, 0.3), (-2.333, -6.0, 0.3)]
    some = places_in_box(LOW, HIGH)[::2]
    before = planned(crowded, "site", loop(30.0, 60), allowed_m=some, is_placed=False)
    after = place_anchors(before)
    assert np.all((after.anchors_m >= LOW) & (after.anchors_m <= HIGH))
    assert expect(after).worst_keyframe_m < 0.7 * expect(before).worst_keyframe_m
    assert len(np.unique(after.anchors_m, axis=0)) == 3


def test_anchors_that_stand_where_they_do_are_left_there() -> None:
    fixed = planned([(6.0, 0.0, 2.5), (-6.0, 1.0, 0.4)], "unknown")
    assert place_anchors(fixed) is fixed


def test_a_path_with_hardly_any_range_is_refused_with_advice_wherever_anchors_stand() -> None:
    short = path_through([(0.0, 0.0, 1.6), (0.5, 0.0, 1.6)], speed_m_per_s=0.5, photo_rate_hz=2.0)
    survey = planned([LOW, HIGH], "site", short, rate_hz=1.0, allowed_m=places_in_box(LOW, HIGH), is_placed=False)
    plan = plan_survey(place_anchors(survey))
    assert plan.verdict == "refused"
    assert "ranges lie on the path" in plan.reasons[0]
    assert any(advice.words == "walk the path 5 times, there and back" for advice in plan.advice_for_scale)

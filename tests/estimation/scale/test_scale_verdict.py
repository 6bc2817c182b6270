"""The verdict names what makes a scale doubtful, and what to do about it next time."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
from tests.known import known

from rangesfm.demo.simulated_radio import Radio
from rangesfm.errors import GeometryError
from rangesfm.estimation.scale.initialize import initialize_scale
from rangesfm.estimation.scale.scale_estimate import Verdict, judge, refuse_unknown
from rangesfm.measurements.lengths.length_scale import lengths_between_points
from rangesfm.measurements.lengths.locate_lengths import LocatedDistances
from rangesfm.measurements.positions.position_scale import doubts_of_positions
from rangesfm.measurements.ranges.range_observations import RangeStatus
from rangesfm.options import ScaleOptions
from rangesfm.solver.bending import WalkBending
from rangesfm.solver.posterior import ScaleUncertainty
from rangesfm.util.geometry.trajectory import Trajectory

if TYPE_CHECKING:
    from tests.estimation.scale.conftest import MakeSurvey

NOISE = Radio(range_stddev_m=0.05)
ONE_ANCHOR_M = {"A": (6.0, 0.0, 2.5)}
FAR_ANCHORS_M = {"A": (30.0, 5.0, 8.0), "B": (-28.0, 6.0, 1.0), "C": (2.0, 31.0, 4.0), "D": (3.0, -29.0, 0.2)}
NEAR_ANCHORS_M = {"A": (3.0, 0.0, 2.5), "B": (-3.0, 1.0, 0.4), "C": (0.5, 3.0, 3.0), "D": (1.0, -3.0, 0.2)}


def on_a_line() -> np.ndarray:
    return np.stack([np.linspace(0.0, 10.0, 40), np.zeros(40), np.full(40, 1.6)], axis=1)


def test_far_anchors_and_little_noise_are_good(make_survey: MakeSurvey) -> None:
    centers = 4.0 * make_survey().centers_m
    estimate = make_survey(centers_m=centers, anchors_m=FAR_ANCHORS_M, radio=NOISE, num_epochs=3).scale("site", "ABCD")
    assert estimate.verdict == "good"
    assert estimate.advice == ()
    low, high = estimate.interval_95
    assert low < estimate.value < high


def test_a_radio_without_error_curve_near_its_anchors_is_doubtful(make_survey: MakeSurvey) -> None:
    centers = 0.2 * make_survey().centers_m
    survey = make_survey(centers_m=centers, anchors_m=NEAR_ANCHORS_M, radio=Radio(range_stddev_m=0.02), num_epochs=5)
    estimate = survey.scale("unknown")
    assert estimate.verdict == "doubtful"


def test_a_straight_path_is_said_to_be_straight(make_survey: MakeSurvey) -> None:
    estimate = make_survey(centers_m=on_a_line(), radio=NOISE, num_epochs=3).scale("unknown")
    assert any("straight" in reason for reason in estimate.reasons)


def test_a_flat_path_with_unknown_anchors_is_to_be_raised_and_lowered(make_survey: MakeSurvey) -> None:
    centers = make_survey().centers_m.copy()
    centers[:, 2] = 1.6
    estimate = make_survey(centers_m=centers, anchors_m=ONE_ANCHOR_M, radio=NOISE, num_epochs=3).scale("unknown")
    assert any("raise and lower the camera" in advice for advice in estimate.advice)


def test_few_ranges_and_many_outliers_have_their_advice(make_survey: MakeSurvey) -> None:
    few = make_survey(anchors_m=ONE_ANCHOR_M, radio=NOISE).scale("first_camera", "A")
    assert any("range more often" in advice for advice in few.advice)
    obstructed = Radio(range_stddev_m=0.05, obstructed_share=0.45, obstructed_mean_m=5.0)
    many = make_survey(radio=obstructed, num_epochs=4).scale("first_camera", "ABCDE")
    assert any("nothing stands between" in advice for advice in many.advice)
    status = many.ranges.observations.status
    outliers = np.mean(status[status <= RangeStatus.OUTLIER] == RangeStatus.OUTLIER)
    assert any(reason.startswith(f"{100 * outliers:.0f} % of the ranges do not fit") for reason in many.reasons)


def test_two_surveyed_anchors_ask_for_a_third(make_survey: MakeSurvey) -> None:
    survey = make_survey(anchors_m={name: FAR_ANCHORS_M[name] for name in "AB"}, radio=NOISE, num_epochs=3)
    estimate = survey.scale("site", "AB")
    assert any("survey three anchors or more" in advice for advice in estimate.advice)


def test_a_straight_path_leaves_the_roll_of_a_map_in_the_site_uncertain(make_survey: MakeSurvey) -> None:
    centers = on_a_line() + 0.05 * np.sin(np.linspace(0.0, 9.0, 40))[:, None] * [0.0, 1.0, 0.7]
    survey = make_survey(centers_m=centers, radio=NOISE, num_epochs=3)
    estimate = survey.scale("site", "ABCDE")
    assert any("roll about it" in reason for reason in estimate.reasons)


def test_an_anchor_that_is_hardly_heard_is_named(make_survey: MakeSurvey) -> None:
    survey = make_survey(radio=NOISE, num_epochs=3)
    log = survey.log
    rows = np.flatnonzero((log.anchor_index != 4) | (np.cumsum(log.anchor_index == 4) <= 3))
    estimate = survey.scale("first_camera", "ABCD", log.subset(rows))
    assert "anchor E has too few ranges on the path to be placed: left out" in estimate.reasons
    assert "range more often, or survey them all" in estimate.advice


def test_anchors_in_wrong_places_disagree(make_survey: MakeSurvey) -> None:
    survey = make_survey(radio=NOISE, num_epochs=3)
    anchors = [
        replace(anchor, position_m=np.asarray(anchor.position_m) + shift)
        for anchor, shift in zip(survey.anchors("first_camera", "ABCDE"), np.linspace(-1.0, 1.0, 5), strict=True)
    ]
    options = ScaleOptions(max_relative_stddev=0.5)
    estimate = initialize_scale(
        survey.observations(), survey.trajectory, anchors, anchor_frame="first_camera", options=options
    )
    assert any("the anchors disagree" in reason for reason in estimate.reasons)
    assert any("check the anchors' positions" in advice for advice in estimate.advice)


@pytest.mark.parametrize(("off_m", "is_said"), [(0.0, False), (0.8, True)])
def test_anchors_that_make_the_scale_less_certain_than_unknown_ones_are_said_to_do_so(
    off_m: float, is_said: bool, make_survey: MakeSurvey
) -> None:
    survey = make_survey(radio=NOISE, num_epochs=3)
    anchors = [
        replace(anchor, position_m=np.asarray(anchor.position_m) + off_m * np.roll([1.0, 0.0, 0.0], k))
        for k, anchor in enumerate(survey.anchors("first_camera", "ABCDE"))
    ]
    found, unknown = (
        initialize_scale(survey.observations(), survey.trajectory, anchors, anchor_frame=frame)
        for frame in ("first_camera", "unknown")
    )
    said = [reason for reason in found.reasons if "with the anchors unknown it would be known to" in reason]
    assert bool(said) == is_said
    assert (found.uncertainty.half_width_95 > 1.1 * unknown.uncertainty.half_width_95) == is_said


def test_a_refusal_says_what_to_do(make_survey: MakeSurvey) -> None:
    survey = make_survey(anchors_m=ONE_ANCHOR_M, radio=Radio(range_stddev_m=0.1))
    with pytest.raises(
        GeometryError, match=r"worse than the 0.196 % allowed \(1.96 times max_relative_stddev\): .*next time: "
    ):
        survey.scale("unknown", options=ScaleOptions(max_relative_stddev=0.001))


def test_a_radio_that_reads_short_at_short_range_is_noticed(make_survey: MakeSurvey) -> None:
    centers = 0.4 * make_survey(num_keyframes=100).centers_m
    survey = make_survey(centers_m=centers, anchors_m=NEAR_ANCHORS_M, radio=Radio(range_stddev_m=0.03), num_epochs=10)
    true = survey.distance_m
    noise = survey.log.range_m - true
    short_m, off = [], []
    for error in (0 * true, -0.4 * np.exp(-true / 1.0)):
        estimate = survey.scale("unknown", (), survey.log_with(true + noise + error))
        short_m.append(estimate.ranges.error_stddevs["short"])
        off.append(abs(survey.relative_error(estimate)) / estimate.uncertainty.half_width_95)
    assert short_m[1] > short_m[0]
    assert max(off) < 1


def test_known_positions_that_leave_the_scale_open_are_too_close_together() -> None:
    narrow, wide = ScaleUncertainty(0.01, {}), ScaleUncertainty(0.03, {})

    def judged(num: int, uncertainty: ScaleUncertainty, *, has_check: bool = False) -> Verdict:
        return judge(doubts_of_positions(num, uncertainty, has_check=has_check), (), uncertainty, ScaleOptions())

    assert judged(3, narrow, has_check=True).verdict == "good"
    assert judged(4, narrow).verdict == "good"
    alone = judged(3, narrow)
    assert (alone.verdict, len(alone.reasons)) == ("doubtful", 1)
    assert alone.reasons[0].startswith("the map rests on 3 known positions")
    doubted = judged(4, wide)
    assert doubted.verdict == "doubtful"
    assert doubted.reasons == (
        "the scale is known to 5.9 % (95 % interval), worse than 4 %",
        "the known positions are too close together for their standard deviations",
    )
    with pytest.raises(
        GeometryError, match=r"only known to 21.6 % .*, worse than the 19.6 % allowed .* close together"
    ):
        judged(4, ScaleUncertainty(0.11, {}))


def test_short_lengths_are_said_to_be_short() -> None:
    path = Trajectory(np.arange(2), ("a", "b"), np.arange(2.0), np.eye(3)[:2], np.tile(np.eye(3), (2, 1, 1)))
    narrow, wide = ScaleUncertainty(0.01, {}), ScaleUncertainty(0.03, {})

    def judged(num: int, uncertainty: ScaleUncertainty) -> Verdict:
        one = np.ones(num)
        lengths = known(lengths_between_points(LocatedDistances.between_points(one, one, one), WalkBending(path)))
        return judge(lengths.doubts(uncertainty), (), uncertainty, ScaleOptions())

    assert judged(2, narrow).verdict == "good"
    assert judged(1, narrow).reasons[0].startswith("the scale depends on one length")
    doubted = judged(2, wide)
    assert (doubted.verdict, doubted.reasons[1:]) == (
        "doubtful",
        ("the measured lengths are too short for their standard deviations",),
    )
    assert doubted.advice == ("measure more and longer lengths",)


def test_a_scale_of_which_nothing_is_known_is_not_given_a_size() -> None:
    def refused(half_width: float, reasons: tuple[str, ...]) -> str:
        with pytest.raises(GeometryError) as caught:
            refuse_unknown(half_width, reasons, ["walk on"], ScaleOptions(max_relative_stddev=0.1))
        return str(caught.value)

    assert refused(1e30, ("it stands still",)) == "the scale is not determined: it stands still; next time: walk on"
    assert refused(1.97, ()) == "the scale is not determined; next time: walk on"
    assert refused(1.95, ()) == (
        "the scale is only known to 195.0 % (95 % interval), worse than the 19.6 % allowed (1.96 times "
        "max_relative_stddev); next time: walk on"
    )


def test_a_refusal_gives_one_reason_and_one_piece_of_advice_and_else_the_plan() -> None:
    options = ScaleOptions(max_relative_stddev=0.1)
    refuse_unknown(0.1959, ["a"], [], options)
    with pytest.raises(GeometryError) as told:
        refuse_unknown(0.1961, ["first", "second"], ["do this", "and that"], options)
    assert str(told.value) == (
        "the scale is only known to 19.6 % (95 % interval), worse than the 19.6 % allowed (1.96 times "
        "max_relative_stddev): first; next time: do this"
    )
    with pytest.raises(GeometryError, match=r"times max_relative_stddev\); next time: plan the survey first"):
        refuse_unknown(0.5, [], [], options)

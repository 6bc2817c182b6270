"""Evidence against a finished map is named with its numbers, and a clean map causes no doubt."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from tests.known import known
from tests.scale.conftest import MakeSurvey, Survey, make_survey

from rangesfm.colmap.pieces import LoosePiece
from rangesfm.colmap.reprojection import MISMATCHED, PointErrors
from rangesfm.demo.simulated_radio import Radio
from rangesfm.diagnostics import finished_map
from rangesfm.diagnostics.finished_map import Doubt, by_similarity, doubts_of_map, doubts_of_pieces, place_of_map
from rangesfm.geometry.similarity import similarity_motions
from rangesfm.geometry.trajectory import Trajectory
from rangesfm.options import ScaleOptions
from rangesfm.scale.initialize import initialize_scale
from rangesfm.scale.scale_estimate import ScaleEstimate

__all__ = ["make_survey"]

Array = npt.NDArray[np.float64]
GOOD_POINTS = PointErrors(np.full(100, 0.6), np.zeros((100, 3)), 4.0)
COMMON_BIAS_STDDEV_M = 0.1


OPTIONS = ScaleOptions()
RADIO = Radio(range_stddev_m=0.06)


@pytest.fixture(scope="module")
def walked(make_survey: MakeSurvey) -> Survey:
    return make_survey(num_epochs=4, radio=RADIO)


NOT_BENT = np.zeros(0)


@pytest.fixture(scope="module")
def estimate(walked: Survey) -> ScaleEstimate:
    """The estimate of a clean survey with five surveyed anchors."""
    anchors = [replace(anchor, position_stddev_m=0.02) for anchor in walked.anchors("site", tuple(walked.anchors_m))]
    return initialize_scale(walked.observations(), walked.trajectory, anchors, anchor_frame="site", options=OPTIONS)


def path_in_site(walked: Survey, estimate: ScaleEstimate) -> Trajectory:
    moved = estimate.metric_from_sfm
    return walked.trajectory.transformed(moved.scale, moved.rotation, moved.translation)


@pytest.mark.parametrize("seed", range(2))
def test_a_clean_map_is_doubted_of_nothing_and_its_place_is_good(make_survey: MakeSurvey, seed: int) -> None:
    walked = make_survey(num_epochs=4, radio=RADIO, seed=seed)
    estimate = walked.scale("site", tuple(walked.anchors_m), options=OPTIONS)
    assert list(doubts_of_map(None, GOOD_POINTS)) == []
    place = known(place_of_map(estimate, None, path_in_site(walked, estimate), [], NOT_BENT))
    assert place.verdict == "good"
    off_m = path_in_site(walked, estimate).centers - walked.centers_m
    assert np.all(np.abs(off_m.mean(axis=0)) < 4 * np.array(place.stddev_m))
    assert np.linalg.norm(off_m, axis=1).max() < 3 * place.worst_keyframe_stddev_m


def test_points_that_are_not_of_the_photos_are_said_of_the_place_too(walked: Survey, estimate: ScaleEstimate) -> None:
    (doubt,) = doubts_of_map(None, PointErrors(np.full(9, 82.0), np.zeros((9, 3)), 4.8))
    assert doubt.reason.startswith("the map's points lie 82 px (median) from where the photos show them")
    assert doubt.advice
    place = known(place_of_map(estimate, None, path_in_site(walked, estimate), [doubt.reason], NOT_BENT))
    assert (place.verdict, place.reasons) == ("doubtful", (doubt.reason,))


@pytest.mark.parametrize("what", ["shift", "heading"])
def test_a_wide_place_is_doubtful(walked: Survey, estimate: ScaleEstimate, what: str) -> None:
    placement = np.zeros((7, 7))
    placement[(slice(4, 7),) * 2 if what == "shift" else (3, 3)] = np.eye(3) * 0.5**2 if what == "shift" else 0.03**2
    place = known(
        place_of_map(replace(estimate, placement=placement), None, path_in_site(walked, estimate), [], NOT_BENT)
    )
    assert place.verdict == "doubtful"
    if what == "shift":
        assert place.stddev_m == pytest.approx((0.5, 0.5, 0.5))
        assert place.worst_keyframe_stddev_m == pytest.approx(np.sqrt(3) * 0.5)
    else:
        assert place.heading_stddev_deg == pytest.approx(np.degrees(0.03))


def test_a_scaled_maps_place_errs_as_its_stddevs_say(make_survey: MakeSurvey) -> None:
    """This tests the formal part of the stddevs; they are widened in the same way as the scale's interval."""
    squares, rng = [], np.random.default_rng(0)
    for seed in range(6):
        walked = make_survey(num_epochs=4, radio=RADIO, seed=seed)
        log = walked.simulated.log
        # The biases are drawn with the stddevs that the range model assumes.
        bias_m = COMMON_BIAS_STDDEV_M * rng.standard_normal() + 0.01 * rng.standard_normal(len(log.anchor_ids))
        log = walked.log_with(log.range_m + bias_m[log.anchor_index])
        estimate = walked.scale("site", tuple(walked.anchors_m), log=log, options=OPTIONS)
        uncertainty = estimate.uncertainty
        widening = uncertainty.half_width_95 / (1.96 * uncertainty.formal)
        place = known(place_of_map(estimate, None, path_in_site(walked, estimate), [], NOT_BENT))
        off_m = (path_in_site(walked, estimate).centers - walked.centers_m).mean(axis=0)
        squares.append((off_m / (np.array(place.stddev_m) / widening)) ** 2)
    # The mean of 18 chi-squares with one degree of freedom each is beyond this in one case of a thousand.
    assert 0.2 < np.mean(squares) < 2.5


def test_a_map_in_the_first_cameras_frame_has_no_place(walked: Survey) -> None:
    estimate = walked.scale("unknown")
    assert place_of_map(estimate, None, path_in_site(walked, estimate), [], NOT_BENT) is None


def test_motions_of_a_similarity_are_its_derivatives() -> None:
    points = np.random.default_rng(0).normal(size=(5, 3))
    motions = similarity_motions(points)
    np.testing.assert_allclose(motions @ np.eye(7)[0], points)
    np.testing.assert_allclose(motions @ [0, 0.1, 0.2, 0.3, 0, 0, 0], np.cross([0.1, 0.2, 0.3], points))
    np.testing.assert_allclose(motions @ np.eye(7)[5], np.tile(np.eye(3)[1], (5, 1)))


@pytest.mark.parametrize(("share", "is_said"), [(0.4, False), (0.6, True)])
def test_points_thrown_away_are_said_if_they_are_most(share: float, is_said: bool) -> None:
    """Reprojection errors do not show this: along its ray a point may move far with a small error."""
    points = np.random.default_rng(0).standard_normal((100, 3))
    thrown = np.where((np.arange(100) < 100 * share)[:, None], 1e4 * points, points)
    reasons = list(finished_map._elsewhere(points, thrown))
    assert [reason.split(":")[0] for reason in reasons] == is_said * ["the points moved away from the path"]


@pytest.mark.parametrize(("factor", "is_said"), [(1.95, False), (2.05, True)])
def test_points_are_thrown_away_if_their_median_distance_doubles(factor: float, is_said: bool) -> None:
    points = np.array([[0.0, 3, 4], [0, 0, 1], [10, 0, 0]])
    reasons = list(finished_map._elsewhere(points, factor * points))
    assert reasons == is_said * ["the points moved away from the path: from 5 to 10.2 m (median)"]
    assert list(finished_map._elsewhere(points[:0], points)) == []
    assert list(finished_map._elsewhere(points[:0], points[:0])) == []


def summary_of(**attributes: Any) -> Any:
    """A refinement that went well, unless it is said."""
    return SimpleNamespace(
        **{"converged": True, "message": "", "misfits": (), "pixel_stddev": 0.5, "anchors": (), "covariance": None}
        | attributes
    )


def test_doubts_about_a_refinement_are_its_end_and_its_misfits() -> None:
    misfits = [SimpleNamespace(reason=f"reason {k}", remedy=f"remedy {k}") for k in range(2)]
    stopped, first, second = doubts_of_map(
        summary_of(converged=False, message="50 iterations", misfits=misfits), GOOD_POINTS
    )
    assert stopped.reason == "the refinement stopped before it converged: 50 iterations"
    assert "max_num_iterations" in stopped.advice
    assert first == Doubt("after the refinement reason 0", "remedy 0")
    assert second == Doubt("after the refinement reason 1", "remedy 1")
    assert list(doubts_of_map(summary_of(message="converged"), GOOD_POINTS)) == []
    apart, also = doubts_of_map(summary_of(converged=False), replace(GOOD_POINTS, max_median_px=0.5))
    assert apart.advice == MISMATCHED
    assert also.reason.startswith("the refinement stopped")


def test_each_loose_piece_is_said_with_its_photos() -> None:
    first, second = doubts_of_pieces([LoosePiece(("b", "c", "d"), 7), LoosePiece(("x",), 0)], 20)
    assert "hold the map together: 3 of its 20 photos (b to d) share only 7 points with the others" in first.reason
    assert "hold the map together: 1 of its 20 photos (x to x) share only 0 points" in second.reason
    assert "rangesfm join" in first.advice
    assert doubts_of_pieces([], 20) == ()


@pytest.mark.parametrize(
    ("num_ranges", "num_other", "num_observations", "factor"),
    [
        (30, 0, 20, 1.5 * 2.0),  # 30 ranges of up to 4 squared pixels each, and 40 coordinates: 1 + 3
        (30, 9, 20, 1.5 * 2.0),  # those that take no part have no cost
        (0, 9, 20, 1.5),
        (16, 0, 0, 1.5 * np.sqrt(33.0)),
    ],
)
def test_reprojection_errors_may_grow_by_what_the_ranges_cost_at_most(
    num_ranges: int, num_other: int, num_observations: int, factor: float
) -> None:
    status = np.concatenate([np.arange(num_ranges) % 3, 3 + np.arange(num_other) % 7])
    scaled: Any = SimpleNamespace(compute_num_observations=lambda: num_observations)
    summary = summary_of(observations=SimpleNamespace(status=status))
    assert finished_map._max_growth(scaled, summary, 2.0) == pytest.approx(factor)


def errors_px(*of_points: float, max_median_px: float = 50.0) -> PointErrors:
    return PointErrors(np.array(of_points), np.zeros((len(of_points), 3)), max_median_px)


def out_of_line(before: PointErrors, after: PointErrors, max_growth: float = 3.0, pixel_stddev: float = 0.0) -> Any:
    return list(finished_map._out_of_line(before, after, summary_of(pixel_stddev=pixel_stddev), max_growth))


def test_errors_that_grew_by_more_than_the_ranges_account_for_are_said() -> None:
    grown = "the reprojection error grew from 1.00 to 3.10 px (median), by more than the "
    grown += "factor 3.0 that the ranges can cause"
    assert out_of_line(errors_px(1.0, 1.0, 4.0), errors_px(2.0, 3.1, 4.0)) == [grown]
    assert out_of_line(errors_px(1.0, 1.0, 4.0), errors_px(2.0, 2.9, 4.0)) == []


def test_growth_is_compared_with_the_noise_of_features_if_the_map_fitted_before() -> None:
    """A map of few points, each seen by two photos, has hardly any reprojection error."""
    before, after = errors_px(0.1, 0.1, 0.1), errors_px(2.9, 2.9, 2.9)
    assert out_of_line(before, after, pixel_stddev=1.0) == []
    assert len(out_of_line(before, after, pixel_stddev=0.9)) == 1
    # Of a map that did not fit, the noise is not known.
    apart = replace(before, max_median_px=0.05)
    assert len(out_of_line(apart, after, pixel_stddev=1.0)) == 1


@pytest.mark.parametrize(
    ("num_before", "num_after", "is_said"), [(0, 6, True), (0, 5, False), (20, 26, True), (20, 25, False)]
)
def test_five_percent_more_points_with_large_errors_are_too_many(
    num_before: int, num_after: int, is_said: bool
) -> None:
    """Large are 10 times what the error may grow to: here 30 px."""

    def with_large(num: int) -> PointErrors:
        return errors_px(*[1.0] * (98 - num), *[30.5] * num, 29.5, 29.5)

    said = f"{num_after} % of the points are far from where the photos show them, {num_before} % before"
    assert out_of_line(with_large(num_before), with_large(num_after)) == is_said * [said]


def test_of_points_that_do_not_fit_the_photos_at_all_nothing_more_is_said() -> None:
    (reason,) = out_of_line(errors_px(1.0), errors_px(60.0))
    assert reason.startswith("the refined map's points lie 60 px (median) from where the photos show them")


# A path with standard deviations of 3 and 4 m along two axes.
PATH_M = np.array([[3.0, 4, 0], [-3, 4, 0], [3, -4, 0], [-3, -4, 0]])


def apart_from_ranges(
    old_m: Sequence[float] | None = (),
    new_m: Sequence[float] = (0.1,),
    noise_m: float = 0.05,
    anchors: Sequence[Any] = (),
) -> list[str]:
    """Residuals before and after, metres; None: there were no ranges. Ranges without a place have no residual."""
    solution = None if old_m is None else SimpleNamespace(fit=SimpleNamespace(residuals_m=np.array(old_m)))
    estimate: Any = SimpleNamespace(solution=solution, noise_stddev_m=noise_m)
    measured_m = np.linspace(4.0, 9.0, len(new_m))
    log = SimpleNamespace(range_m=measured_m)
    summary = summary_of(
        predicted_m=measured_m + np.array(new_m), observations=SimpleNamespace(log=log), anchors=anchors
    )
    return list(finished_map._apart_from_ranges(estimate, summary, PATH_M))


def test_residuals_of_ranges_that_double_are_said() -> None:
    old_m = (0.1, -0.1, 5.0)
    assert apart_from_ranges(old_m, (0.19, -0.19, 7.0)) == []
    said = "the difference of ranges and map grew from 0.1 to 0.21 m (median)"
    assert apart_from_ranges(old_m, (-0.21, 0.21, 7.0)) == [said]
    assert apart_from_ranges(old_m, (np.nan, -0.21, 0.21, np.nan)) == [said]
    # What is within the noise did not grow.
    assert apart_from_ranges(old_m, (0.21, 0.21, 0.21), noise_m=0.11) == []
    assert apart_from_ranges(None, (9.0, 9.0)) == []


@pytest.mark.parametrize(
    ("far_m", "stddev_m", "is_said"),
    [
        (4.9, 0.02, False),
        (5.1, 0.02, True),  # the path is 5 m large
        (5.9, 0.6, False),  # 10 stddevs are more
        (6.1, 0.6, True),
        (99.0, np.inf, False),
    ],
)
def test_an_anchor_is_lost_beyond_the_size_of_the_path_and_of_its_own_uncertainty(
    far_m: float, stddev_m: float, is_said: bool
) -> None:
    given_m = np.array([1.0, 2.0, 3.0])
    anchors = [
        SimpleNamespace(anchor_id="free", position_m=given_m, prior_position_m=None, prior_position_stddev_m=np.inf),
        SimpleNamespace(
            anchor_id="A7",
            position_m=given_m + np.array([0.6, 0.0, -0.8]) * far_m,
            prior_position_m=given_m,
            prior_position_stddev_m=stddev_m,
        ),
    ]
    said = [f"anchor A7 was moved {far_m:.3g} m from its surveyed position"]
    assert apart_from_ranges((0.1,), (0.1,), anchors=anchors) == is_said * said


def in_words(shift_m: Sequence[float], turn: float, worst_m: float, size_m: float) -> tuple[str, bool]:
    stddevs = np.array([0.7, 0.8, 0.9, turn, *shift_m])
    return finished_map.place_in_words(stddevs, worst_m, size_m)


def test_a_place_is_said_with_its_half_widths_of_95_percent() -> None:
    words, is_wide = in_words((0.3, 0.0, 0.4), 0.01, 1.0, 100.0)
    assert words == "the map's place is known to 0.98 m, its heading to 1.1 deg, each keyframe to 2 m or better (95 %)"
    assert not is_wide
    words, is_wide = in_words((0.3, 0.0, 0.4), 0.01, 3.0, 100.0)
    assert words.endswith("; to be good, each keyframe has to be known to 4 m, 4 % of the site's size")
    assert is_wide
    words, _ = in_words((0.3, 0.0, 0.4), 0.03, 1.0, 100.0)
    assert words.endswith("; to be good, the heading has to be known to 2.3 deg")
    words, is_wide = in_words((np.inf, 0.0, 0.4), np.inf, np.inf, 100.0)
    assert "place is known to nothing, its heading to nothing, each keyframe to nothing or" in words
    assert is_wide


@pytest.mark.parametrize(
    ("turn", "worst_m", "is_wide"),
    [
        (0.0203, 2.03, False),
        (0.0205, 2.03, True),  # 1.96 times that is more than 0.04
        (0.0203, 2.05, True),  # and more than 0.04 of a site of 100 m
    ],
)
def test_a_place_is_wide_from_4_percent_of_the_site_or_of_a_radian(turn: float, worst_m: float, is_wide: bool) -> None:
    assert in_words((9.0, 9.0, 9.0), turn, worst_m, 100.0)[1] == is_wide


def moved(centers_m: Array, step: Array) -> Array:
    """Centres after a small scaling and turn about the first one, and a shift."""
    off_m = centers_m - centers_m[0]
    return np.asarray(centers_m + step[0] * off_m + np.cross(step[1:4], off_m) + step[4:])


def test_covariances_of_a_rigid_map_are_those_of_the_centres_that_it_moves() -> None:
    """Each number of the similarity moves the centres and their middle, and covariances follow from that."""
    rng = np.random.default_rng(0)
    centers_m, root = rng.standard_normal((5, 3)) + 20.0, rng.standard_normal((7, 7))
    of_middle, of_each = by_similarity(root @ root.T, centers_m)
    steps_m = np.stack([moved(centers_m, column) - centers_m for column in root.T])
    np.testing.assert_allclose(of_each, np.einsum("sni,snj->nij", steps_m, steps_m))
    middle_m = steps_m.mean(axis=1)
    np.testing.assert_allclose(of_middle[4:, 4:], middle_m.T @ middle_m)
    np.testing.assert_allclose(of_middle[:4, :4], (root @ root.T)[:4, :4])
    np.testing.assert_allclose(of_middle[:4, 4:], root[:4] @ middle_m)


CENTERS_M = np.array([[0.0, 0, 0], [10, 0, 0], [20, 0, 0]])
# Frames are numbered against the time.
FRAME_IDS = np.array([3, 5, 7])
PATH = Trajectory(FRAME_IDS[::-1], ("a", "b", "c"), None, CENTERS_M, np.array([np.eye(3)] * 3))


def estimate_of(
    shift_m: float, heading: float = 0.0, *, has_positions: bool = False, anchors: Sequence[Any] = ()
) -> Any:
    """An estimate whose map may be shifted along y and turned about z, about its first camera."""
    placement = np.diag([0.0, 0, 0, heading**2, 0, shift_m**2, 0])
    return SimpleNamespace(placement=placement, positions=object() if has_positions else None, anchors=anchors)


def place(estimate: Any, summary: Any = None, doubts: Sequence[str] = (), bent_by_m: Array = NOT_BENT) -> Any:
    return known(place_of_map(estimate, summary, PATH, doubts, bent_by_m))


def test_the_place_of_a_rigid_map_is_that_of_its_middle_and_of_its_least_certain_keyframe() -> None:
    found = place(estimate_of(0.03, 0.004))
    assert found.stddev_m == pytest.approx((0.0, np.hypot(0.03, 10 * 0.004), 0.0))
    assert found.heading_stddev_deg == pytest.approx(np.degrees(0.004))
    assert found.worst_keyframe_stddev_m == pytest.approx(np.hypot(0.03, 20 * 0.004))
    assert found.verdict == "good"
    assert len(found.reasons) == 1
    assert found.reasons[0].startswith("the map's place is known to 0.098 m, its heading to 0.45 deg, each keyframe to")


def test_a_map_that_is_bent_has_less_certain_keyframes() -> None:
    bent_by_m = np.array([0.3, 0.0, 0.06])
    found = place(estimate_of(0.03, 0.004), bent_by_m=bent_by_m)
    assert found.worst_keyframe_stddev_m == pytest.approx(np.hypot(0.03, 0.3))
    refined = summary_of(
        covariance=SimpleNamespace(frame_ids=FRAME_IDS, similarity=np.eye(7) * 0.01**2, centers=np.zeros((3, 3, 3)))
    )
    assert place(estimate_of(0.03), refined, bent_by_m=bent_by_m).worst_keyframe_stddev_m == 0.0


def test_the_place_of_a_refined_map_is_that_of_its_own_covariance() -> None:
    centers_m2 = np.stack([np.diag([0.01, 0.02, 0.06]), np.zeros((3, 3)), np.eye(3) * 0.01])
    covariance = SimpleNamespace(
        frame_ids=FRAME_IDS, similarity=np.diag([0, 0, 0, 0.002, 0.01, 0.02, 0.03]) ** 2, centers=centers_m2
    )
    found = place(estimate_of(0.5, 0.05), summary_of(covariance=covariance))
    assert found.stddev_m == pytest.approx((0.01, 0.02, 0.03))
    assert found.heading_stddev_deg == pytest.approx(np.degrees(0.002))
    assert found.worst_keyframe_stddev_m == pytest.approx(0.3)
    # Without a covariance, it is that of one piece.
    assert place(estimate_of(0.03), summary_of()).stddev_m == pytest.approx((0.0, 0.03, 0.0))


def test_known_positions_err_for_long_so_that_the_whole_map_is_no_more_certain_than_by_them() -> None:
    covariance = SimpleNamespace(frame_ids=FRAME_IDS, similarity=np.eye(7) * 1e-6, centers=np.zeros((3, 3, 3)))
    found = place(estimate_of(0.05, 0.001, has_positions=True), summary_of(covariance=covariance))
    assert found.stddev_m == pytest.approx((0.0, np.hypot(0.05, 0.01), 0.0))
    assert found.worst_keyframe_stddev_m == pytest.approx(np.hypot(0.05, 0.02))
    covariance.centers[1] = np.eye(3) * 0.12
    found = place(estimate_of(0.05, 0.001, has_positions=True), summary_of(covariance=covariance))
    assert found.worst_keyframe_stddev_m == pytest.approx(0.6)


def test_keyframes_that_hang_loose_are_named_beside_how_well_the_others_are_known() -> None:
    def reasons_of(*stddevs_m: float, doubts: Sequence[str] = ()) -> Any:
        centers = np.square(stddevs_m)[:, None, None] * np.eye(3) / 3
        covariance = SimpleNamespace(frame_ids=FRAME_IDS, similarity=np.zeros((7, 7)), centers=centers)
        return place(estimate_of(0.0), summary_of(covariance=covariance), doubts=doubts).reasons

    one = "the photos hardly tie keyframe a to the map; each other keyframe is known to 0.2 m or better (95 %)"
    assert reasons_of(0.1, 0.05, 600.0, doubts=["it is broken"])[1:] == (one, "it is broken")
    # None is far less certain than most, and one that is known well enough is no matter.
    assert len(reasons_of(300.0, 150.0, 600.0)) == len(reasons_of(0.001, 0.001, 0.1)) == 1
    several = Trajectory(np.arange(5), tuple("abcde"), None, np.zeros((5, 3)), np.array([np.eye(3)] * 5))
    (said,) = finished_map._loose_ones(several, np.array([0.1, 5.0, 0.2, 7.0, 0.1]))
    assert said.startswith(
        "the photos hardly tie keyframe d (and 1 more) to the map; each other keyframe is known to 0.39"
    )


def test_the_size_of_the_site_is_that_of_path_and_surveyed_anchors() -> None:
    """A keyframe that is known to 0.98 m is no matter on a site of 25 m, but on one of 20 m."""
    assert place(estimate_of(0.5)).verdict == "doubtful"
    anchors = [
        SimpleNamespace(prior_position_m=None),
        SimpleNamespace(prior_position_m=np.array([5.0, 15.0, 0.0])),
    ]
    assert place(estimate_of(0.5, anchors=anchors)).verdict == "good"
    assert place(estimate_of(0.5, anchors=anchors[:1])).verdict == "doubtful"


def test_doubts_about_a_map_make_its_place_doubtful_and_come_after_its_own() -> None:
    found = place(estimate_of(0.03), doubts=["it is broken"])
    assert (found.verdict, found.reasons) == ("doubtful", ("it is broken",))
    wide = place(estimate_of(3.0), doubts=["it is broken"])
    assert wide.reasons[0].startswith("the map's place is known to 5.9 m")
    assert wide.reasons[1:] == ("it is broken",)


@pytest.mark.parametrize(("points_factor", "is_said"), [(1.0, False), (3.0, True)])
def test_a_map_that_moved_as_a_whole_is_not_broken(
    points_factor: float, is_said: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Points are compared with the middle of the path, which the refinement moved by 70 m."""
    points = np.array([[0.0, 3, 4], [0, 0, 5], [5, 0, 0], [0, 3, -4]])
    away_m = np.array([50.0, 40.0, 30.0])
    of_map: Any = {
        "scaled": PointErrors(np.ones(4), points + PATH_M.mean(axis=0), 4.0),
        "refined": PointErrors(np.ones(4), points_factor * points + PATH_M.mean(axis=0) + away_m, 4.0),
    }
    monkeypatch.setattr(finished_map, "point_errors", lambda model: of_map[model])
    monkeypatch.setattr(finished_map, "_max_growth", lambda *_: 2.0)
    paths = {"scaled": SimpleNamespace(centers=PATH_M), "refined": SimpleNamespace(centers=PATH_M + away_m)}
    trajectory = SimpleNamespace(as_in=lambda model: paths[model])
    anchor = SimpleNamespace(
        anchor_id="A7", position_m=np.full(3, 4.0), prior_position_m=np.zeros(3), prior_position_stddev_m=0.1
    )
    names: Any = ("scaled", "refined", trajectory, SimpleNamespace(solution=None), summary_of(anchors=[anchor]), 2.0)
    thrown = ["the points moved away from the path: from 5 to 15 m (median)"]
    lost = ["anchor A7 was moved 6.93 m from its surveyed position"]
    assert [*finished_map.why_broken(*names)] == is_said * thrown + lost

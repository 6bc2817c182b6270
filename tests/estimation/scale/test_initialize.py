"""The scale stage recovers every case of anchors, and says what the geometry leaves open."""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.distance import pdist
from scipy.spatial.transform import Rotation
from tests.estimation.scale.conftest import lengths_among
from tests.known import known
from tests.simulated.path import orbit_path
from tests.simulated.positions_at_origin import known_positions

from rangesfm.demo.simulated_radio import Radio
from rangesfm.errors import GeometryError, InputError
from rangesfm.estimation.scale.initialize import initialize_scale
from rangesfm.measurements.joint_map import KindOnMap, find_kind
from rangesfm.measurements.lengths.length_scale import LengthScale
from rangesfm.measurements.lengths.locate_lengths import LocatedDistances
from rangesfm.measurements.positions.known_positions import KnownPositions
from rangesfm.measurements.positions.position_scale import PositionScale, scale_by_positions
from rangesfm.measurements.ranges.anchors.anchor_distances import AnchorDistances
from rangesfm.measurements.ranges.range_log import RangeLog
from rangesfm.measurements.ranges.range_observations import RangeObservations, RangeStatus, hold_out
from rangesfm.measurements.ranges.scale.range_scale import RangeScale
from rangesfm.options import RangeModelOptions, RangesOptions, ScaleOptions
from rangesfm.solver.bending import WalkBending
from rangesfm.util.geometry.moments import ByPhoto
from rangesfm.util.geometry.similarity import Similarity
from rangesfm.util.geometry.trajectory import Trajectory

if TYPE_CHECKING:
    from tests.estimation.scale.conftest import MakeSurvey, Survey

    from rangesfm.estimation.scale.scale_estimate import ScaleEstimate

Array = npt.NDArray[np.float64]

NOISE = Radio(range_stddev_m=0.1)
FLAT_ANCHORS_M = {"A": (6.0, 0.0, 1.0), "B": (-6.0, 1.0, 1.0), "C": (0.5, 6.0, 1.0), "D": (1.0, -6.0, 1.0)}
THREE_ANCHORS_M = {"A": (6.0, 0.0, 2.5), "B": (-6.0, 1.0, 0.4), "D": (1.0, -6.0, 0.2)}
ONE_ANCHOR_M = {"A": (6.0, 0.0, 2.5)}

CASES = {
    "first camera, one anchor": ("first_camera", ONE_ANCHOR_M, "A"),
    "first camera, five anchors": ("first_camera", None, "ABCDE"),
    "first camera, one of five known": ("first_camera", None, "A"),
    "site, five anchors": ("site", None, "ABCDE"),
    "site, three anchors": ("site", THREE_ANCHORS_M, "ABD"),
    "site, four anchors in a plane": ("site", FLAT_ANCHORS_M, "ABCD"),
    "site, four of five known": ("site", None, "ABCD"),
    "one unknown anchor": ("unknown", ONE_ANCHOR_M, ""),
    "five unknown anchors": ("unknown", None, ""),
}


def on_a_line() -> Array:
    return np.stack([np.linspace(0.0, 10.0, 40), np.zeros(40), np.full(40, 1.6)], axis=1)


def on_a_loop_at_one_height(make_survey: MakeSurvey) -> Array:
    centers = make_survey().centers_m.copy()
    centers[:, 2] = 1.6
    return centers


def on_a_sphere() -> Array:
    centers = orbit_path(40.0, height_amplitude_m=1.5).centers(np.linspace(0.0, 40.0, 40))
    on_sphere: Array = 4.0 * centers / np.linalg.norm(centers, axis=1, keepdims=True)
    return on_sphere


class TestWithoutNoise:
    @pytest.mark.parametrize("case", CASES)
    def test_the_similarity_is_recovered(self, make_survey: MakeSurvey, case: str) -> None:
        self.assert_recovered(make_survey, case, 1e3, (0.05, -0.12, -0.03))

    @pytest.mark.parametrize("case", ["first camera, five anchors", "site, five anchors", "five unknown anchors"])
    def test_so_it_is_from_millimetres_with_the_tag_in_the_camera(self, make_survey: MakeSurvey, case: str) -> None:
        self.assert_recovered(make_survey, case, 1e-3, (0.0, 0.0, 0.0))

    def assert_recovered(
        self, make_survey: MakeSurvey, case: str, scale: float, tag_in_cam_m: tuple[float, float, float]
    ) -> None:
        frame, anchors_m, known = CASES[case]
        survey = make_survey(scale=scale, anchors_m=anchors_m, tag_in_cam_m=tag_in_cam_m, seed=len(known))
        estimate = survey.scale(frame, known)
        truth = survey.truth(estimate.frame)
        assert estimate.frame == ("site" if frame == "site" else "first_camera")
        assert estimate.value == pytest.approx(truth.scale, rel=1e-6)
        np.testing.assert_allclose(estimate.metric_from_sfm.rotation, truth.rotation, atol=1e-6)
        centers = survey.trajectory.centers
        np.testing.assert_allclose(estimate.metric_from_sfm.apply(centers), truth.apply(centers), atol=1e-6)
        from_site = survey.frame_from_site(estimate.frame)
        for anchor in estimate.ranges.anchors:
            position = from_site.apply(survey.anchors_m[anchor.anchor_id])
            places = [place for place in (anchor.position_m, anchor.mirror_position_m) if place is not None]
            assert min(float(np.linalg.norm(place - position)) for place in places) < 1e-5

    def test_each_anchor_alone_gives_the_same_scale(self, make_survey: MakeSurvey) -> None:
        survey = make_survey()
        estimate = survey.scale("first_camera", "ABCDE")
        assert estimate.ranges.per_anchor.keys() == survey.anchors_m.keys()
        np.testing.assert_allclose(list(estimate.ranges.per_anchor.values()), survey.site_from_sfm.scale, rtol=1e-6)

    def test_the_papers_method_takes_its_own_scale(self, make_survey: MakeSurvey) -> None:
        towards = np.stack([np.linspace(0.0, 4.0, 40), np.sin(np.linspace(0.0, 3.0, 40)), np.full(40, 1.6)], axis=1)
        survey = make_survey(centers_m=towards, anchors_m={"A": (12.0, 1.0, 2.0)})
        estimate = survey.scale("first_camera", "A", options=ScaleOptions(method="two-candidate"))
        assert estimate.method == "two-candidate"
        assert estimate.ranges.two_candidate is not None
        assert estimate.value == estimate.ranges.two_candidate.scale
        assert survey.relative_error(estimate) == pytest.approx(0.0, abs=1e-6)

    def test_the_papers_scale_says_nothing_of_its_error(self, make_survey: MakeSurvey) -> None:
        survey = make_survey(centers_m=on_a_sphere(), anchors_m={"A": (12.0, 1.0, 2.0)}, radio=NOISE)
        robust = survey.scale("first_camera", "A")
        table = known(robust.ranges.two_candidate)
        assert not robust.interval_95[0] < table.scale < robust.interval_95[1]
        with pytest.raises(GeometryError, match=f"two-candidate gives {table.scale:.4g} m per unit, outside the 95 %"):
            survey.scale("first_camera", "A", options=ScaleOptions(method="two-candidate"))
        paper = survey.scale("first_camera", "A", options=ScaleOptions(method="two-candidate-unchecked"))
        assert (paper.method, paper.value, paper.verdict) == ("two-candidate", table.scale, "doubtful")
        assert paper.stddev_empirical == paper.stddev_formal == np.inf
        assert (paper.placement, paper.ranges.per_anchor, paper.by_kind) == (None, {}, {})


class TestWithOutliers:
    @pytest.mark.parametrize(
        ("frame", "known"), [("site", "ABCDE"), ("first_camera", "ABCDE"), ("unknown", "")], ids=lambda value: value
    )
    def test_thirty_percent_of_long_ranges_leave_the_scale_within_its_uncertainty(
        self, make_survey: MakeSurvey, frame: str, known: str
    ) -> None:
        radio = Radio(range_stddev_m=0.1, obstructed_share=0.3, obstructed_mean_m=3.0)
        survey = make_survey(radio=radio, num_epochs=3)
        estimate = survey.scale(frame, known)
        stddev = max(estimate.uncertainty.formal, estimate.uncertainty.empirical)
        assert abs(survey.relative_error(estimate)) < 3 * stddev
        assert stddev < 0.02

    def test_they_are_marked_and_have_no_say(self, make_survey: MakeSurvey) -> None:
        radio = Radio(range_stddev_m=0.1, obstructed_share=0.3, obstructed_mean_m=3.0)
        survey = make_survey(radio=radio)
        estimate = survey.scale("first_camera", "ABCDE")
        status = estimate.ranges.observations.status
        too_long = survey.log.range_m - survey.distance_m
        assert np.all(status[too_long > 2.0] == RangeStatus.OUTLIER)
        assert np.mean(status[np.abs(too_long) < 0.1] == RangeStatus.USED) > 0.99
        # By Geman-McClure's loss, far outliers pull by the inverse cube of their size; by Cauchy's, by the inverse.
        weights = estimate.ranges.errors.robust_weights(too_long)
        assert weights[np.abs(too_long) < 0.1].min() > 0.7
        assert weights[too_long > 2.0].max() < 0.005


class TestRefused:
    """Surveys that end with a GeometryError whose text names what is wrong."""

    def refuse(self, survey: Survey, frame: str, known: str, match: str) -> None:
        with pytest.raises(GeometryError, match=match):
            survey.scale(frame, known)

    @pytest.mark.parametrize(
        ("frame", "known", "match"),
        [
            ("site", "ABCDE", "hardly moved"),
            ("unknown", "", "hardly moved"),
            ("first_camera", "ABCDE", "no scale explains"),
        ],
        ids=["site", "unknown", "first camera"],
    )
    def test_a_camera_that_stands_still(self, make_survey: MakeSurvey, frame: str, known: str, match: str) -> None:
        self.refuse(make_survey(centers_m=np.tile([[1.0, 2.0, 1.6]], (40, 1))), frame, known, match)

    def test_a_camera_that_stands_still_far_from_the_origin_of_its_world(self, make_survey: MakeSurvey) -> None:
        """There, rounding spreads its centres over nanometres."""
        survey = make_survey(centers_m=np.tile([[1.0, 2.0, 1.6]], (40, 1)))
        shaken = survey.trajectory.transformed(Similarity(1.0, np.eye(3), np.full(3, 1e7)))
        shaken.centers[:] += np.random.default_rng(0).choice([-2e-9, 0.0, 2e-9], (40, 3))
        self.refuse(replace(survey, trajectory=shaken), "first_camera", "ABCDE", "no scale explains")

    def test_a_circle_round_an_anchor(self, make_survey: MakeSurvey) -> None:
        """All ranges are alike, and differ by rounding only."""
        angles = np.linspace(0.0, 6.0, 40)
        circle = np.stack([5.0 * np.cos(angles), 5.0 * np.sin(angles), np.zeros(40)], axis=1)
        survey = make_survey(centers_m=circle, anchors_m={"A": (0.0, 0.0, 1.0)}, tag_in_cam_m=(0, 0, 0))
        self.refuse(survey, "unknown", "", "no range changed")

    def test_a_camera_that_moves_less_than_the_noise(self, make_survey: MakeSurvey) -> None:
        shaking = np.array([1.0, 2.0, 1.6]) + 0.002 * np.random.default_rng(0).standard_normal((40, 3))
        survey = make_survey(centers_m=shaking, anchors_m=THREE_ANCHORS_M, radio=NOISE)
        self.refuse(survey, "unknown", "", "that the camera moved|stands still")

    @pytest.mark.parametrize("seed", range(3))
    def test_a_flat_circle_round_one_unknown_anchor(self, make_survey: MakeSurvey, seed: int) -> None:
        circle = orbit_path(40.0, height_amplitude_m=0.0).centers(np.linspace(0.0, 40.0, 40))
        survey = make_survey(centers_m=circle, anchors_m={"A": (1.0, 0.5, 0.3)}, radio=NOISE, seed=seed)
        self.refuse(survey, "unknown", "", "flat circle.*walk another shape")

    @pytest.mark.parametrize(
        ("seed", "anchor_m"), [(0, (1.0, 0.5, 0.3)), (1, (7.0, 0.5, 0.3))], ids=["inside", "outside"]
    )
    def test_a_path_on_a_sphere_and_one_unknown_anchor(
        self, make_survey: MakeSurvey, seed: int, anchor_m: tuple[float, float, float]
    ) -> None:
        """The radius of the path and the anchor's distance from its centre can be exchanged."""
        survey = make_survey(
            centers_m=on_a_sphere(), anchors_m={"A": anchor_m}, tag_in_cam_m=(0, 0, 0), radio=NOISE, seed=seed
        )
        self.refuse(survey, "unknown", "", "two scales fit.*the path lies on a sphere")

    def test_a_straight_path_in_the_site_frame(self, make_survey: MakeSurvey) -> None:
        """The map can be rotated about the path."""
        survey = make_survey(centers_m=on_a_line(), tag_in_cam_m=(0, 0, 0), radio=NOISE)
        self.refuse(survey, "site", "ABCDE", "nearly straight")

    def test_the_papers_method_where_its_steadier_branch_is_negative(self, make_survey: MakeSurvey) -> None:
        survey = make_survey()
        robust = survey.scale("first_camera", "ABCDE")
        assert robust.ranges.two_candidate is not None
        assert robust.ranges.two_candidate.scale < 0
        with pytest.raises(GeometryError, match="two-candidate found no positive scale"):
            survey.scale("first_camera", "ABCDE", options=ScaleOptions(method="two-candidate"))


def test_an_anchor_of_the_log_that_is_not_given_is_bad_input(make_survey: MakeSurvey) -> None:
    survey = make_survey()
    anchors = survey.anchors("first_camera", "ABCDE")[:-1]
    with pytest.raises(InputError, match="'E' of the log is not among the anchors"):
        initialize_scale(survey.observations(), survey.trajectory, anchors, anchor_frame="first_camera")


class TestOpenButNotFatal:
    @pytest.mark.parametrize(("seed", "obstructed_share"), [(0, 0.0), (1, 0.5)])
    def test_three_unknown_anchors_settle_the_scale_of_a_path_on_a_sphere(
        self, make_survey: MakeSurvey, seed: int, obstructed_share: float
    ) -> None:
        """Their distances from the centre differ, so that only the true radius fits all of them."""
        anchors_m = {"A": (6.5, 1.0, 1.2), "B": (-6.0, 2.0, -1.2), "C": (0.5, -8.5, 1.4)}
        radio = Radio(range_stddev_m=0.05, obstructed_share=obstructed_share, obstructed_mean_m=2.0)
        survey = make_survey(
            centers_m=on_a_sphere(),
            anchors_m=anchors_m,
            tag_in_cam_m=(0, 0, 0),
            radio=radio,
            num_epochs=3,
            seed=seed,
        )
        assert survey.relative_error(survey.scale("unknown")) == pytest.approx(0.0, abs=0.01)

    def test_anchors_on_a_line_give_the_scale_alone_and_say_so(self, make_survey: MakeSurvey) -> None:
        survey = make_survey(anchors_m={"A": (6.0, 0.0, 2.0), "B": (-2.0, 0.1, 2.0), "C": (-7.0, 0.0, 2.0)})
        estimate = survey.scale("site", "ABC")
        assert estimate.frame == "first_camera"
        assert estimate.verdict == "doubtful"
        assert any("on one line" in reason and "no place in the site" in reason for reason in estimate.reasons)
        assert survey.relative_error(estimate) == pytest.approx(0.0, abs=1e-6)

    def test_a_straight_path_past_unknown_anchors_is_named(self, make_survey: MakeSurvey) -> None:
        survey = make_survey(centers_m=on_a_line(), radio=NOISE, num_epochs=3)
        estimate = survey.scale("unknown")
        assert estimate.verdict == "doubtful"
        assert any("straight" in reason for reason in estimate.reasons)
        stddev = max(estimate.uncertainty.formal, estimate.uncertainty.empirical)
        assert abs(survey.relative_error(estimate)) < 3 * stddev

    def test_a_straight_path_is_no_harm_with_anchors_in_the_first_cameras_frame(self, make_survey: MakeSurvey) -> None:
        estimate = make_survey(centers_m=on_a_line(), radio=NOISE).scale("first_camera", "ABCDE")
        assert not any("straight" in reason for reason in estimate.reasons)

    def test_above_and_below_a_flat_path_an_unknown_anchor_has_two_places(self, make_survey: MakeSurvey) -> None:
        survey = make_survey(
            centers_m=on_a_loop_at_one_height(make_survey), anchors_m=ONE_ANCHOR_M, radio=NOISE, num_epochs=3
        )
        estimate = survey.scale("unknown")
        (anchor,) = estimate.ranges.anchors
        assert anchor.mirror_position_m is not None
        assert any("flat" in reason for reason in estimate.reasons)
        truth = survey.frame_from_site("first_camera").apply(survey.anchors_m["A"])
        places = np.array([anchor.position_m, anchor.mirror_position_m])
        assert np.linalg.norm(places - truth, axis=1).min() < 0.5
        # The path lies half-way between the two.
        in_frame = estimate.metric_from_sfm.apply(survey.trajectory.centers)
        normal = np.linalg.svd(in_frame - in_frame.mean(axis=0))[2][2]
        heights = (places - in_frame.mean(axis=0)) @ normal
        assert heights[0] == pytest.approx(-heights[1], abs=0.3)

    def test_an_unknown_anchor_with_hardly_any_ranges_is_left_out_and_named(self, make_survey: MakeSurvey) -> None:
        survey = make_survey()
        log = survey.log
        of_e = np.flatnonzero(log.anchor_index == log.anchor_ids.index("E"))
        keep = np.setdiff1d(np.arange(len(log)), of_e[3:])
        ids = [log.anchor_ids[k] for k in log.anchor_index[keep]]
        thinned = RangeLog.from_arrays(ids, log.range_m[keep], timestamp_s=log.timestamp_s[keep])
        estimate = survey.scale("first_camera", "ABCD", thinned)
        assert any("anchor E" in reason for reason in estimate.reasons)
        assert survey.relative_error(estimate) == pytest.approx(0.0, abs=1e-6)
        assert set(estimate.ranges.observations.status[np.array(ids) == "E"]) == {RangeStatus.UNKNOWN_ANCHOR}


class TestBias:
    def test_a_delay_common_to_all_anchors_is_found(self, make_survey: MakeSurvey) -> None:
        biases = dict.fromkeys("ABCDE", 0.15)
        survey = make_survey(radio=Radio(range_stddev_m=0.02, range_bias_m=biases), num_epochs=3)
        estimate = survey.scale("first_camera", "ABCDE")
        assert [anchor.range_bias_m for anchor in estimate.ranges.anchors] == pytest.approx([0.15] * 5, abs=0.03)
        assert survey.relative_error(estimate) == pytest.approx(0.0, abs=0.005)

    def test_with_a_prior_of_zero_it_is_held_at_zero(self, make_survey: MakeSurvey) -> None:
        survey = make_survey(radio=NOISE)
        held = RangeModelOptions(range_bias_stddev_m=0.0, common_bias_stddev_m=0.0)
        estimate = survey.scale("first_camera", "ABCDE", range_model=held)
        assert [anchor.range_bias_m for anchor in estimate.ranges.anchors] == [0.0] * 5


def test_ranges_set_aside_as_checks_have_no_say(make_survey: MakeSurvey) -> None:
    survey = make_survey(radio=NOISE, num_epochs=2)
    held_out = hold_out(survey.observations(), RangesOptions(check_share=0.2), seed=0)
    is_check = held_out.status == RangeStatus.CHECK
    spoilt = survey.observations(survey.log_with(np.where(is_check, 1.0, survey.log.range_m)))
    spoilt.status[is_check] = RangeStatus.CHECK
    anchors = survey.anchors("first_camera", "ABCDE")
    first, second = (
        initialize_scale(observations, survey.trajectory, anchors, anchor_frame="first_camera")
        for observations in (held_out, spoilt)
    )
    assert first.value == second.value
    assert np.all(second.ranges.observations.status[is_check] == RangeStatus.CHECK)
    assert np.all(np.isnan(second.ranges.errors.stddev_m[is_check]))


def between_cameras(survey: Survey, *, factor: float = 1.0) -> LocatedDistances:
    """Two taped distances between cameras, which are the true ones times a factor."""
    pairs = np.array([[0, len(survey.times) // 2], [len(survey.times) // 4, -1]])
    model = np.linalg.norm(np.diff(survey.trajectory.centers[pairs], axis=1)[:, 0], axis=1)
    metric = factor * np.linalg.norm(np.diff(survey.centers_m[pairs], axis=1)[:, 0], axis=1)
    return LocatedDistances.between_points(metric, np.full(2, 0.005), model)


def between_anchors(survey: Survey, stddev_m: float = 0.005) -> AnchorDistances:
    """The true distance from the first anchor to every other."""
    places = np.array(list(survey.anchors_m.values()))
    pairs = np.array([[0, k] for k in range(1, len(places))])
    lengths = np.linalg.norm(places[1:] - places[0], axis=1)
    return AnchorDistances(pairs, lengths, np.full(len(lengths), stddev_m))


def test_control_distances_between_cameras_hold_a_scale_that_long_ranges_would_spoil(make_survey: MakeSurvey) -> None:
    survey = make_survey(anchors_m=THREE_ANCHORS_M, radio=NOISE, num_epochs=2)
    long = survey.log_with(survey.log.range_m * 1.04)
    truth = survey.truth("first_camera").scale
    alone = survey.scale("unknown", log=long)
    held = survey.scale("unknown", log=long, lengths=between_cameras(survey))
    assert abs(alone.value / truth - 1) > 0.02
    assert held.value == pytest.approx(truth, rel=0.005)
    assert held.uncertainty.formal < 0.5 * alone.uncertainty.formal
    # The judged problem holds the scale no better than the lengths do in a map that bends.
    [by_lengths] = known(find_kind(held.on_map.kinds, RangeScale)).solved.problem.scales
    assert by_lengths == known(find_kind(held.on_map.kinds, LengthScale)).alone.scale


@pytest.mark.parametrize("wrong", [0, 1])
def test_ranges_tell_which_of_two_distances_is_wrong(make_survey: MakeSurvey, wrong: int) -> None:
    survey = make_survey(radio=NOISE, num_epochs=2)
    lengths = between_cameras(survey)
    mistyped = replace(lengths, distance_m=lengths.distance_m * np.where(np.arange(2) == wrong, 1.3, 1.0))
    found = survey.scale("unknown", lengths=mistyped)
    low, high = found.interval_95
    np.testing.assert_array_equal(known(find_kind(found.on_map.kinds, LengthScale)).is_kept, np.arange(2) != wrong)
    assert low < survey.truth("first_camera").scale < high
    assert found.value == pytest.approx(survey.scale("unknown", lengths=lengths).value, rel=0.005)


def test_lengths_in_feet_do_not_mislead_the_scale_by_the_ranges_alone(make_survey: MakeSurvey) -> None:
    survey = make_survey(radio=NOISE)
    found = survey.scale("unknown", lengths=between_cameras(survey, factor=1 / 0.3048))
    alone = survey.scale("unknown")
    assert found.by_kind["lengths"].value == pytest.approx(alone.value / 0.3048, rel=0.02)
    assert found.by_kind["ranges"] == alone.on_map.scale


def test_control_distances_between_anchors_put_unknown_anchors_in_their_places(make_survey: MakeSurvey) -> None:
    survey = make_survey(radio=NOISE)
    log = survey.log_with(survey.log.range_m + 0.3)
    truth = survey.frame_from_site("first_camera").apply(np.array(list(survey.anchors_m.values())))

    def spread_m(estimate: ScaleEstimate) -> float:
        """Return the largest error of the distances between anchors."""
        found = np.array([anchor.position_m for anchor in estimate.ranges.anchors])
        return float(np.abs(pdist(found) - pdist(truth)).max())

    alone, held = survey.scale("unknown", log=log), survey.scale("unknown", log=log, distances=between_anchors(survey))
    assert spread_m(alone) > 0.2
    assert spread_m(held) < 0.5 * spread_m(alone)
    assert abs(held.value / survey.truth("first_camera").scale - 1) < 0.02


def test_ranges_between_anchors_of_the_log_do_so_too(make_survey: MakeSurvey) -> None:
    survey = make_survey(radio=NOISE)
    log, ids = survey.log_with(survey.log.range_m + 0.3), list(survey.anchors_m)
    pairs = list(itertools.combinations(ids, 2))
    lengths = pdist(np.array(list(survey.anchors_m.values())))
    with_peers = RangeLog.from_arrays(
        [*(log.anchor_ids[k] for k in log.anchor_index), *(b for _, b in pairs)],
        np.append(log.range_m, lengths),
        timestamp_s=np.append(log.timestamp_s, np.full(len(pairs), log.timestamp_s[0])),
        tag_id=["tag"] * len(log) + [a for a, _ in pairs],
        range_stddev_m=np.append(np.full(len(log), np.nan), np.full(len(pairs), 0.01)),
    ).with_anchors(set(ids))
    alone, held = survey.scale("unknown", log=log), survey.scale("unknown", log=with_peers)
    off_m = [
        np.abs(pdist(np.array([anchor.position_m for anchor in estimate.ranges.anchors])) - lengths).max()
        for estimate in (alone, held)
    ]
    assert off_m[1] < 0.75 * off_m[0]


def test_the_noise_is_found_from_the_ranges_themselves(make_survey: MakeSurvey) -> None:
    radio = Radio(range_stddev_m=0.07, obstructed_share=0.1, obstructed_mean_m=3.0)
    estimate = make_survey(radio=radio, num_epochs=4).scale("first_camera", "ABCDE")
    assert estimate.ranges.noise_stddev_m == pytest.approx(0.07, rel=0.2)


def test_noise_that_the_log_states_is_believed(make_survey: MakeSurvey) -> None:
    survey = make_survey(radio=NOISE)
    log = survey.log
    stated = RangeLog.from_arrays(
        [log.anchor_ids[k] for k in log.anchor_index],
        log.range_m,
        timestamp_s=log.timestamp_s,
        range_stddev_m=np.full(len(log), 0.3),
    )
    far = log.range_m > 5.0
    stddev = survey.scale("first_camera", "ABCDE", stated).ranges.errors.stddev_m
    np.testing.assert_allclose(stddev[far], 0.3, rtol=0.01)


def test_the_prior_of_a_bias_is_told_as_it_was_given(make_survey: MakeSurvey) -> None:
    """Errors that last make the ranges say less, so that priors weigh more beside them, and are no others."""
    survey = make_survey(radio=NOISE, num_epochs=4)
    log = survey.log_with(survey.log.range_m + 0.1 * np.sin(survey.log.timestamp_s / 5))
    estimate = survey.scale("first_camera", "ABCDE", log)
    assert estimate.ranges.errors.inflation > 1.2
    given_m = RangeModelOptions().range_bias_stddev_m
    np.testing.assert_allclose([each.prior_bias_stddev_m for each in estimate.ranges.anchors], given_m, rtol=1e-12)


def no_ranges() -> RangeObservations:
    none, no, nowhere = np.zeros(0, dtype=np.int64), np.zeros(0), np.zeros((0, 3))
    log = RangeLog((), none, no, ByPhoto(()), no, no, (), none, none, np.zeros(0, dtype=np.int8), none)
    status = np.zeros(0, dtype=np.int8)
    return RangeObservations(none, none, no, nowhere, nowhere, nowhere, no, no, log, status)


def turned_path() -> Trajectory:
    rng = np.random.default_rng(0)
    centers = rng.uniform(-3.0, 3.0, (12, 3)) + np.array([7.0, 8.0, 9.0])
    rotations = Rotation.from_rotvec(rng.standard_normal((12, 3))).as_matrix()
    return Trajectory(np.arange(12), tuple(map(str, range(12))), np.arange(12.0), centers, rotations)


def points_in_site(num: int, scale: float) -> KnownPositions:
    """Control points with a standard deviation of a centimetre, without any errors."""
    places = np.random.default_rng(1).uniform(-3.0, 3.0, (num, 3))
    positions = replace(known_positions([True] * num, 12, stddev_m=0.01), places=places)
    return replace(positions, position_m=positions.predicted_m(Similarity(scale, np.eye(3), np.array([1.0, 2.0, 3.0]))))


def taped(scale: float, stddev_m: float = 0.01) -> LocatedDistances:
    return LocatedDistances.between_points(scale * np.array([4.0, 5.0, 6.0]), np.full(3, stddev_m), np.arange(4.0, 7.0))


def of_no_ranges(*kinds: KindOnMap) -> ScaleEstimate:
    return initialize_scale(no_ranges(), turned_path(), [], anchor_frame="unknown", others=kinds)


def test_lengths_that_agree_with_known_positions_make_the_scale_more_certain() -> None:
    known_m = points_in_site(3, 0.5)
    known_m = replace(known_m, covariance_m2=100 * known_m.covariance_m2)
    bending = WalkBending(turned_path())
    positions = scale_by_positions(PositionScale.begun(known_m, bending))
    [lengths] = lengths_among(taped(0.502, 0.001), turned_path())
    alone, both = of_no_ranges(positions), of_no_ranges(positions, lengths)
    assert (both.method, both.frame) == ("positions", "site")
    assert both.by_kind["positions"].stddev == pytest.approx(alone.value * alone.uncertainty.empirical)
    assert both.by_kind["lengths"] == lengths.alone.scale
    assert both.uncertainty.empirical < 0.8 * alone.uncertainty.empirical
    assert alone.value < both.value < lengths.alone.scale.value
    assert alone.by_kind == {}

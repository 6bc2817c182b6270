"""Mistakes that last for the whole survey: what they do to the ranges, when they can be, and what is said of them."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from tests.diagnostics.test_linearized import ANCHORS_M, slopes, small_map, with_longer
from tests.known import known

from rangesfm.arrays import Array
from rangesfm.diagnostics import catalogue
from rangesfm.diagnostics.hypothesis import Hypothesis, corrected
from rangesfm.diagnostics.linearized import Linearized, RangesOnMap, linearized
from rangesfm.ranging.anchors.site import Site

NUM = 120


def placed_exactly(heights_m: tuple[float, ...] = (2.0, 1.5, 3.0)) -> RangesOnMap:
    """Return ranges to anchors whose coordinates are exact, so that a wrong one shows in the ranges alone."""
    on_map = small_map((0.0, 0.0, 0.0), num_tags=2)
    means_m = np.column_stack([ANCHORS_M[:, :2], heights_m])
    return replace(on_map, problem=replace(on_map.problem, anchor_mean_m=means_m))


@pytest.fixture(scope="module")
def problem() -> Linearized:
    return linearized(placed_exactly())


def all_standing(problem: Linearized) -> dict[tuple[str, str], Hypothesis]:
    return {each.key: each for of_kind in catalogue.STANDING for each in of_kind(problem)}


@pytest.fixture(scope="module")
def standing(problem: Linearized) -> dict[tuple[str, str], Hypothesis]:
    return all_standing(problem)


def given_means(problem: Linearized, means_m: Array, stddevs_m: tuple[float, ...] = (0.0, 0.0, 0.0)) -> Linearized:
    """Return the problem with other coordinates of the anchors, at the same state."""
    ranges = replace(problem.on_map.problem, anchor_mean_m=means_m, anchor_stddev_m=np.array(stddevs_m))
    return replace(problem, on_map=replace(problem.on_map, problem=ranges))


def test_every_kind_of_lasting_mistake_is_in_the_catalogue(standing: dict[tuple[str, str], Hypothesis]) -> None:
    assert list(standing) == [
        *(("anchor place", name) for name in "ABC"),
        *(("anchor bias", name) for name in "ABC"),
        ("common bias", ""),
        ("range scale", ""),
        *(("anchor range scale", name) for name in "ABC"),
        ("anchors' scale", ""),
        ("lever arm", "T"),
        ("lever arm", "U"),
        ("radio drift", ""),
        ("behind the camera", ""),
        ("clock offset", ""),
        ("clock drift", ""),
    ]
    # The size of an anchor's wrong place is not proportional to what it does, and so on.
    nonlinear = {"anchor place", "anchors' scale", "lever arm", "clock offset", "clock drift"}
    assert {each.name for each in standing.values() if not each.is_linear} == nonlinear
    of_radios = {"anchor bias", "common bias", "range scale", "anchor range scale", "anchors' scale"}
    assert {each.name for each in standing.values() if each.is_in_interval} == of_radios


def test_a_correction_takes_from_the_residuals_what_the_mistake_has_added(
    problem: Linearized, standing: dict[tuple[str, str], Hypothesis]
) -> None:
    coordinates = [each for h in standing.values() for each in h.sub_hypotheses]
    assert [each.subject for each in coordinates[3:6]] == ["B x", "B y", "B z"]
    for each in (*standing.values(), *coordinates):

        def residual_m(size: Array, each: Hypothesis = each) -> Array:
            return problem.bins.mean(corrected(problem.on_map, each.correction(size)).residual_m)

        # A drift of the clocks is nearly the same within a bin, and ranges are the distances but for 0.2 m of delay.
        within = {"clock drift": 0.05, "range scale": 0.201}.get(each.name, 1e-6)
        np.testing.assert_allclose(each.effect.columns, -slopes(residual_m, each.num), atol=within, err_msg=each.name)
        assert not each.effect.priors.size


def in_grid(problem: Linearized, offset_m: tuple[float, float, float]) -> Linearized:
    """The same problem of a site whose coordinates were given in a grid."""
    posed: Any = SimpleNamespace(**(vars(problem.on_map.posed) | {"site": Site(np.array(offset_m))}))
    return replace(problem, on_map=replace(problem.on_map, posed=posed))


class TestAnchorPlaces:
    """An anchor may be elsewhere than where its coordinates say."""

    def test_only_given_places_can_be_wrong(self) -> None:
        assert [each.subject for each in catalogue.anchor_places(linearized(small_map()))] == ["A", "B"]

    def test_it_is_within_its_ranges_of_the_path(self, problem: Linearized) -> None:
        of_b = list(catalogue.anchor_places(problem))[1]
        farthest_m = problem.on_map.problem.range_m[1::3].max()
        # Its ranges read 0.2 m more than the distances, which are averaged in bins.
        assert of_b.most == pytest.approx(2 * farthest_m - 0.2, abs=0.1)
        assert of_b.sub_hypotheses[0].most == of_b.most
        assert of_b.most_unnoticed == 1.0

    def test_its_place_and_each_coordinate_are_told(self, problem: Linearized) -> None:
        of_b = list(catalogue.anchor_places(problem))[1]
        size = np.array([0.3, -0.4, 1.2])
        said = "anchor B is about 1.30 m from where its coordinates say (by +0.30, -0.40, +1.20 m in x, y, z)"
        assert of_b.words(size) == said
        at = known(of_b.correction(size).anchors_m["B"])
        np.testing.assert_allclose(at, [-4.7, 6.6, 2.7])
        assert of_b.adoption is not None
        assert of_b.adoption(size).anchors_m == {"B": None}
        for axis, (coordinate, words, corrected_m) in enumerate(
            zip(
                of_b.sub_hypotheses,
                (
                    "x is given as -5.000 where about -4.50",
                    "y is given as 7.000 where about 7.50",
                    "z is given as 1.500",
                ),
                ([-4.5, 7.0, 1.5], [-5.0, 7.5, 1.5], [-5.0, 7.0, 2.0]),
                strict=True,
            )
        ):
            assert coordinate.key == ("anchor coordinate", f"B {'xyz'[axis]}")
            told = coordinate.words(np.array([0.5]))
            assert told.startswith(f"anchor B's {words}")
            assert told.endswith(" fits (+0.50 m)")
            surveyed = in_grid(problem, (2_600_000.0, 1_200_000.0, 450.0))
            (_, there, _) = catalogue.anchor_places(surveyed)
            assert ("2599995.000", "1200007.000", "451.500")[axis] in there.sub_hypotheses[axis].words(np.array([0.5]))
            assert ("2599995.50", "1200007.50", "452.00")[axis] in there.sub_hypotheses[axis].words(np.array([0.5]))
            assert f"check its {'xyz'[axis]}, or " in coordinate.remedy
            np.testing.assert_allclose(known(coordinate.correction(np.array([0.5])).anchors_m["B"]), corrected_m)

    def test_on_a_known_map_it_would_be_seen_in_the_ranges_of_the_anchor(self) -> None:
        """The coordinates are a prior here, so that the ranges do not show their error."""
        problem = linearized(small_map((0.1, 0.2, np.inf)))
        of_b = list(catalogue.anchor_places(problem))[1]
        np.testing.assert_array_equal(of_b.effect.columns, np.zeros((60, 3)))
        is_of_b = problem.bins.anchor_index == 1
        seen = known(of_b.seen)
        np.testing.assert_allclose(seen[is_of_b], problem.gradient.by_tag[is_of_b])
        np.testing.assert_array_equal(seen[~is_of_b], 0.0)
        np.testing.assert_array_equal(known(of_b.sub_hypotheses[2].seen), seen[:, 2:])
        np.testing.assert_allclose(of_b.effect.priors, np.vstack([np.zeros((3, 3)), np.eye(3) / 0.2]))


class TestLongRanges:
    """Ranges may be longer than the distance by a constant or by a share of it."""

    def test_a_constant_error_is_of_one_anchor_or_of_all(self, standing: dict[tuple[str, str], Hypothesis]) -> None:
        of_b, of_all = standing["anchor bias", "B"], standing["common bias", ""]
        assert of_b.words(np.array([0.3])) == "the ranges to anchor B read about 0.30 m too long"
        assert of_all.words(np.array([-0.3])) == "the ranges to every anchor read about 0.30 m too short"
        np.testing.assert_array_equal(
            known(of_b.correction(np.array([0.3])).longer_m), np.tile([0.0, 0.3, 0.0], NUM // 3)
        )
        np.testing.assert_array_equal(known(of_all.correction(np.array([0.3])).longer_m), 0.3)

    def test_no_range_is_too_long_by_more_than_itself(
        self, problem: Linearized, standing: dict[tuple[str, str], Hypothesis]
    ) -> None:
        range_m = problem.on_map.problem.range_m
        assert standing["anchor bias", "B"].most == range_m[1::3].max()
        assert standing["common bias", ""].most == range_m.max()

    @pytest.mark.parametrize("share", [0.25, -0.2])
    def test_ranges_that_are_too_long_by_a_share_are_divided_by_it(self, problem: Linearized, share: float) -> None:
        range_m = problem.on_map.problem.range_m
        on_map = with_longer(problem.on_map, share * range_m)
        (of_all,) = (h for h in catalogue.range_shares(replace(problem, on_map=on_map)) if h.name == "range scale")
        assert (of_all.most, of_all.unit) == (0.5, "1")
        found = corrected(on_map, of_all.correction(np.array([share])))
        np.testing.assert_allclose(found.problem.range_m, range_m)

    def test_the_share_is_told_in_percent(self, standing: dict[tuple[str, str], Hypothesis]) -> None:
        words = standing["range scale", ""].words
        assert words(np.array([0.034])) == "all ranges read about 3.4 % too long"
        assert words(np.array([-0.034])) == "all ranges read about 3.4 % too short"

    def test_ranges_to_an_anchor_grow_about_their_mean(
        self, problem: Linearized, standing: dict[tuple[str, str], Hypothesis]
    ) -> None:
        of_b = standing["anchor range scale", "B"]
        assert (of_b.most, of_b.unit) == (2.0, "1")
        longer_m = known(of_b.correction(np.array([0.5])).longer_m)
        distance_m = np.linalg.norm(problem.on_map.from_anchor_m, axis=1)[1::3]
        np.testing.assert_allclose(longer_m[1::3], 0.5 * (distance_m - distance_m.mean()), atol=1e-6)
        assert not longer_m[::3].any()
        assert not longer_m[2::3].any()
        assert of_b.adoption is not None
        np.testing.assert_array_equal(known(of_b.adoption(np.array([0.5])).left_out), np.tile([False, True, False], 40))

    def test_ranges_that_hardly_grow_with_the_distance_are_stuck(
        self, standing: dict[tuple[str, str], Hypothesis]
    ) -> None:
        words = standing["anchor range scale", "B"].words
        assert words(np.array([0.25])) == "the ranges to anchor B grow by 1.25 m for each metre of distance"
        assert words(np.array([-0.69])) == "the ranges to anchor B grow by 0.31 m for each metre of distance"
        for size in (-0.71, -1.5):
            assert words(np.array([size])).startswith("the ranges to anchor B hardly change with the distance")

    def test_of_a_single_anchor_only_all_ranges_are_told(self) -> None:
        on_map = small_map((0.0, 0.0, 0.0))
        of_one = replace(on_map, problem=replace(on_map.problem, anchor_index=np.ones(NUM, dtype=np.int64)))
        problem = linearized(of_one)
        assert [each.key for each in catalogue.anchor_biases(problem)] == [("common bias", "")]
        assert [each.key for each in catalogue.range_shares(problem)] == [("range scale", "")]


class TestAnchorsScale:
    """Coordinates may be in a unit that is not the metre."""

    def test_all_anchors_move_away_from_their_middle(self, standing: dict[tuple[str, str], Hypothesis]) -> None:
        scale = standing["anchors' scale", ""]
        assert (scale.most, scale.unit) == (0.5, "1")
        assert scale.words(np.array([0.06])) == "the anchors' coordinates are about 6.0 % too small"
        assert scale.words(np.array([-0.06])) == "the anchors' coordinates are about 6.0 % too large"
        moved_m = scale.correction(np.array([0.1])).anchors_m
        middle_m = ANCHORS_M.mean(axis=0)
        for name, at_m in zip("ABC", ANCHORS_M, strict=True):
            np.testing.assert_allclose(known(moved_m[name]), middle_m + 1.1 * (at_m - middle_m))

    def test_two_known_anchors_have_a_scale_and_one_has_none(self, problem: Linearized) -> None:
        means_m = ANCHORS_M.copy()
        means_m[2] = np.nan
        (scale,) = catalogue.anchors_in_another_scale(given_means(problem, means_m, (0.0, 0.0, np.inf)))
        moved_m = scale.correction(np.array([0.5])).anchors_m
        assert list(moved_m) == ["A", "B"]
        # The middle between both is (0.5, 4, 1.75).
        np.testing.assert_allclose(known(moved_m["A"]), [8.75, -0.5, 2.125])
        # The third does not move.
        np.testing.assert_array_equal(scale.effect.columns[problem.bins.anchor_index == 2], 0.0)
        means_m[1, 0] = np.nan
        assert not list(catalogue.anchors_in_another_scale(given_means(problem, means_m, (0.0, np.inf, np.inf))))

    def test_anchors_that_were_not_given_have_no_unit(self, problem: Linearized) -> None:
        assert list(catalogue.anchors_in_another_scale(given_means(problem, ANCHORS_M, (np.inf, 0.0, np.inf))))
        assert not list(catalogue.anchors_in_another_scale(given_means(problem, ANCHORS_M, (np.inf,) * 3)))


class TestHeights:
    """Anchors that were all given one height were not measured, unless they really have it."""

    @staticmethod
    def found(problem: Linearized, means_m: Array, stddevs_m: tuple[float, ...] = (0.0,) * 3) -> list[Hypothesis]:
        return list(catalogue.heights_never_measured(given_means(problem, means_m, stddevs_m)))

    def test_heights_that_agree_to_a_millimetre_were_not_measured(self, problem: Linearized) -> None:
        assert len(self.found(problem, ANCHORS_M * [1, 1, 0] + [[0, 0, 0], [0, 0, 0.0009], [0, 0, 0.0004]])) == 1
        assert not self.found(problem, ANCHORS_M * [1, 1, 0] + [[0, 0, 0], [0, 0, 0.0011], [0, 0, 0.0004]])

    def test_fewer_than_three_anchors_may_have_one_height(self, problem: Linearized) -> None:
        level_m = ANCHORS_M * [1, 1, 0] + [0, 0, 2.5]
        assert self.found(problem, level_m)
        level_m[0] = np.nan
        assert not self.found(problem, level_m, (np.inf, 0.0, 0.0))

    def test_an_anchor_that_was_not_given_may_have_the_height_of_the_others(self, problem: Linearized) -> None:
        assert not self.found(problem, ANCHORS_M * [1, 1, 0] + [0, 0, 2.5], (0.0, 0.0, np.inf))

    def test_each_anchor_has_a_height_of_its_own(self, problem: Linearized) -> None:
        (heights,) = self.found(problem, ANCHORS_M * [1, 1, 0] + [0, 0, 2.5])
        for k in range(3):
            expected = np.where(problem.bins.anchor_index == k, problem.gradient.by_tag[:, 2], 0.0)
            np.testing.assert_allclose(heights.effect.columns[:, k], expected)
        size = np.array([-0.4, 0.2, 1.1])
        assert heights.words(size) == (
            "all anchors are given the same height, 2.5 m, but the ranges fit heights that differ by 1.5 m"
        )
        (heights,) = self.found(in_grid(problem, (1012.0, 5003.0, 413.5)), ANCHORS_M * [1, 1, 0] + [0, 0, 2.5])
        assert "the same height, 416 m" in heights.words(size)
        moved_m = heights.correction(size).anchors_m
        np.testing.assert_allclose([known(moved_m[name])[2] for name in "ABC"], [2.1, 2.7, 3.6])
        np.testing.assert_allclose([known(moved_m[name])[:2] for name in "ABC"], ANCHORS_M[:, :2])
        # Each may be off by the longest range.
        assert heights.most == pytest.approx(np.sqrt(3) * problem.on_map.problem.range_m.max())
        assert not heights.is_linear


class TestLeverArms:
    """A tag may be elsewhere on its camera."""

    def test_its_length_is_that_of_a_tag_or_of_the_longest(self, problem: Linearized) -> None:
        # The arms are (0.1, -0.2, 0.05) and (0.3, 0.1, -0.1).
        assert catalogue.lever_arm_m(problem, 0) == pytest.approx(np.sqrt(0.0525))
        assert catalogue.lever_arm_m(problem, 1) == pytest.approx(np.sqrt(0.11))
        assert catalogue.lever_arm_m(problem) == pytest.approx(np.sqrt(0.11))

    def test_it_is_on_the_rig_and_nobody_overlooks_that_it_is_on_the_other_side(self, problem: Linearized) -> None:
        of_t, of_u = catalogue.wrong_lever_arms(problem)
        assert of_t.most == pytest.approx(3.0 + np.sqrt(0.0525))
        assert of_t.most_unnoticed == pytest.approx(0.2 + 2 * np.sqrt(0.0525))
        assert of_u.most_unnoticed == pytest.approx(0.2 + 2 * np.sqrt(0.11))

    def test_one_of_several_tags_is_named(self, problem: Linearized) -> None:
        of_t, of_u = catalogue.wrong_lever_arms(problem)
        assert (of_t.subject, of_u.subject) == ("T", "U")
        said = "the lever arm of tag U is off by about 0.13 m (+0.03, -0.04, +0.12 m along the camera's x, y, z)"
        assert of_u.words(np.array([0.03, -0.04, 0.12])) == said

    def test_a_lever_arm_that_was_not_given_is_not_called_off(self) -> None:
        (only,) = catalogue.wrong_lever_arms(linearized(small_map(arms_m=[(0.0, 0.0, 0.0)])))
        assert only.subject == ""
        assert only.words(np.array([0.3, -0.4, 1.2])) == (
            "no lever arm is given, and the tag sits about 1.30 m from the lens "
            "(+0.30, -0.40, +1.20 m along the camera's x, y, z)"
        )
        (only,) = catalogue.wrong_lever_arms(linearized(small_map(arms_m=[(0.0, 0.01, 0.0)])))
        assert only.words(np.array([0.3, -0.4, 1.2])).startswith("the lever arm is off by about 1.30 m (")


class TestTimes:
    """A radio may warm up, and clocks may differ, by amounts that can be."""

    def test_a_radio_that_warms_up_is_told_with_its_change_in_the_whole_survey(
        self, standing: dict[tuple[str, str], Hypothesis]
    ) -> None:
        drift = standing["radio drift", ""]
        assert drift.words(np.array([0.4])) == "the ranges get longer and longer, by about 0.40 m within 10 s"
        assert drift.words(np.array([-0.4])) == "the ranges get shorter and shorter, by about 0.40 m within 10 s"
        longer_m = known(drift.correction(np.array([0.4])).longer_m)
        assert np.ptp(longer_m) == pytest.approx(0.4)
        assert longer_m[-1] == longer_m.max() == pytest.approx(0.2)
        assert (drift.most, drift.unit) == (5.0, "m")

    def test_without_times_it_is_told_along_the_path(self) -> None:
        on_map = small_map(has_times=False)
        problem = linearized(replace(on_map, time_s=4.0 * on_map.time_s))
        (drift,) = catalogue.radios_warming(problem)
        assert drift.words(np.array([0.4])).endswith(" by about 0.40 m within 39 m of the path")

    def test_ranges_to_anchors_behind_the_camera_are_longer(
        self, problem: Linearized, standing: dict[tuple[str, str], Hypothesis]
    ) -> None:
        blocked = standing["behind the camera", ""]
        on_map = problem.on_map
        # The camera looks along its z axis, so that an anchor in front of it has a positive third coordinate there.
        in_cam_m = np.einsum("nji,nj->ni", on_map.world_from_cam, -on_map.from_anchor_m)
        expected = np.where(in_cam_m[:, 2] < 0, 0.7, 0.0)
        assert 0 < np.count_nonzero(expected) < NUM
        np.testing.assert_array_equal(known(blocked.correction(np.array([0.7])).longer_m), expected)
        assert (blocked.most, blocked.most_unnoticed) == (2.0, 0.2)
        assert blocked.words(np.array([0.7])) == "the ranges to anchors behind the camera read about 0.70 m too long"

    def test_clocks_that_are_off_are_told_with_the_sign_of_the_offset(
        self, problem: Linearized, standing: dict[tuple[str, str], Hypothesis]
    ) -> None:
        offset = standing["clock offset", ""]
        assert offset.words(np.array([-0.15])) == (
            "the time offset between the clocks is wrong: it needs about -0.15 s more"
        )
        assert offset.correction(np.array([-0.15])).time_shift_s == -0.15
        # Otherwise they have no moment in common.
        assert offset.most == pytest.approx(9.75)
        assert offset.unit == "s"
        assert problem.by_time is not None

    def test_a_clock_that_drifts_is_told_in_parts_per_million(
        self, standing: dict[tuple[str, str], Hypothesis]
    ) -> None:
        drift = standing["clock drift", ""]
        assert drift.words(np.array([5e-5])) == "the radio's clock runs 50 ppm too slow"
        assert drift.words(np.array([-5e-5])) == "the radio's clock runs 50 ppm too fast"
        shift_s = np.asarray(drift.correction(np.array([1e-4])).time_shift_s)
        assert np.ptp(shift_s) == pytest.approx(9.75e-4)
        assert shift_s.mean() == pytest.approx(0.0, abs=1e-9)
        # Two quartzes of 100 ppm each.
        assert drift.can_be(np.array([1.99e-4]))
        assert not drift.can_be(np.array([2.01e-4]))
        assert drift.unit == "s/s"

    def test_ranges_without_times_have_no_clocks(self) -> None:
        assert not list(catalogue.clocks(linearized(small_map(has_times=False))))

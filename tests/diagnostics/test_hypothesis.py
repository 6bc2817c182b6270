"""Ranges as they would be without a mistake, and what a mistake does to them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tests.diagnostics.test_linearized import ANCHORS_M, ARM_M, small_map, with_longer
from tests.known import known

from rangesfm.diagnostics.hypothesis import (
    Correction,
    Effect,
    Hypothesis,
    corrected,
    duration_s,
    in_axes,
    is_given,
    longest_m,
    of_anchor_place,
    of_bins,
    too_long,
    where_ranges_meet,
)
from rangesfm.diagnostics.linearized import Linearized, RangesOnMap, linearized


@pytest.fixture(scope="module")
def on_map() -> RangesOnMap:
    """Ranges to A, whose coordinates are exact, to B, of which they are known to 0.1 m, and to C, an unknown one."""
    return small_map(num_tags=2)


@pytest.fixture(scope="module")
def problem(on_map: RangesOnMap) -> Linearized:
    return linearized(on_map)


def rows_of(problem: Linearized, anchor: int) -> list[bool]:
    """Return for each row of the priors whether it is of an anchor: its residual changes as the anchor moves."""
    moves = problem.prior_design[:, problem.columns.anchor[anchor] : problem.columns.anchor[anchor] + 3]
    return list(np.any(moves != 0, axis=1))


class TestAnchorPlace:
    """A wrong coordinate shows in the ranges if it is taken for exact, and in its prior otherwise."""

    DIRECTIONS = np.array([[1.0, 0.0], [0.5, 2.0], [0.0, -1.0]])

    def test_exact_coordinates_show_in_the_ranges(self, problem: Linearized) -> None:
        effect = of_anchor_place(problem, 0, self.DIRECTIONS)
        is_of = problem.bins.anchor_index == 0
        # The true place is nearer to a tag that is in its direction, so that the map's ranges are longer.
        np.testing.assert_allclose(effect.columns[is_of], (problem.gradient.by_tag @ self.DIRECTIONS)[is_of])
        np.testing.assert_array_equal(effect.columns[~is_of], 0.0)
        np.testing.assert_array_equal(effect.priors, np.zeros((3, 2)))

    def test_uncertain_coordinates_show_in_their_prior(self) -> None:
        # The third anchor is unknown, and has no prior.
        for stddevs_m, anchor, row in (
            ((0.0, 0.1, np.inf), 1, 0),
            ((0.3, 0.1, np.inf), 1, 3),
            ((0.3, np.inf, 0.1), 2, 3),
            ((0.3, 0.2, 0.1), 2, 6),
            ((0.1, 0.2, 0.3), 0, 0),
            ((0.3, 0.0, 0.1), 2, 3),
        ):
            problem = linearized(small_map(stddevs_m))
            effect = of_anchor_place(problem, anchor, self.DIRECTIONS)
            assert not effect.columns.any()
            expected = np.zeros((problem.num_priors, 2))
            expected[row : row + 3] = self.DIRECTIONS / 0.1
            expected *= 0.1 / stddevs_m[anchor]
            np.testing.assert_allclose(effect.priors, expected)
            assert list(np.any(effect.priors != 0, axis=1)) == rows_of(problem, anchor)

    def test_a_place_is_given_with_all_its_coordinates_and_their_accuracy(
        self, on_map: RangesOnMap, problem: Linearized
    ) -> None:
        assert [is_given(problem, k) for k in range(3)] == [True, True, False]
        means_m = ANCHORS_M.copy()
        means_m[0, 1] = np.nan
        ranges = replace(on_map.problem, anchor_mean_m=means_m)
        assert [is_given(replace(problem, on_map=replace(on_map, problem=ranges)), k) for k in (0, 2)] == [False, False]


class TestEffects:
    """Effects of mistakes are joined or added, and found again for large sizes."""

    FIRST = Effect(np.ones((2, 1)), np.array([[2.0]]))
    OTHER = Effect(np.array([[3.0], [4.0]]), np.array([[5.0]]))

    def test_mistakes_with_numbers_of_their_own_are_columns(self) -> None:
        joined = Effect.of_all([self.FIRST, self.OTHER])
        np.testing.assert_array_equal(joined.columns, [[1, 3], [1, 4]])
        np.testing.assert_array_equal(joined.priors, [[2, 5]])

    def test_mistakes_that_share_a_number_add_up(self) -> None:
        added = Effect.of_sum([self.FIRST, self.OTHER])
        np.testing.assert_array_equal(added.columns, [[4], [5]])
        np.testing.assert_array_equal(added.priors, [[7]])

    def test_a_large_mistake_has_the_slope_of_its_own_size(self, on_map: RangesOnMap, problem: Linearized) -> None:
        by_range = np.linspace(1.0, 2.0, 120)
        each = Hypothesis(
            "bent",
            of_bins(problem, np.zeros((60, 2))),
            words=str,
            remedy="",
            correction=lambda size: Correction(longer_m=by_range * size[0] ** 2 + 3.0 * size[1]),
            most=5.0,
        )
        found = each.at_size(problem, np.array([2.0, 1.0]))
        # The residuals of the map without the mistake are lower by the change of its length.
        np.testing.assert_allclose(found.effect.columns[:, 0], -4.0 * problem.bins.mean(by_range), rtol=1e-4)
        np.testing.assert_allclose(found.effect.columns[:, 1], -3.0, rtol=1e-6)
        assert found.effect.priors.shape == (3, 2)
        shifting = replace(each, correction=lambda size: Correction(time_shift_s=float(size[0])))
        assert shifting.at_size(problem, np.array([2.0, 1.0])) is shifting

    def test_a_size_up_to_the_largest_is_possible(self, problem: Linearized) -> None:
        each = Hypothesis("any", of_bins(problem, np.zeros((60, 2))), str, "", lambda _: Correction(), 5.0)
        assert each.can_be(np.array([3.0, -4.0]))
        assert not each.can_be(np.array([3.0, -4.01]))
        assert each.num == 2
        assert each.most_unnoticed == 5.0
        assert replace(each, max_unnoticed=2.0).most_unnoticed == 2.0


def test_the_longest_range_is_of_one_anchor_or_of_all(on_map: RangesOnMap, problem: Linearized) -> None:
    range_m = on_map.problem.range_m
    assert longest_m(problem, 1) == range_m[1::3].max()
    assert longest_m(problem) == range_m.max()
    assert longest_m(problem, 1) > longest_m(problem, 2)
    assert duration_s(problem) == pytest.approx(9.75)


def test_errors_are_told_with_their_sign() -> None:
    assert too_long(np.array([0.254])) == "read about 0.25 m too long"
    assert too_long(np.array([-0.254])) == "read about 0.25 m too short"
    assert in_axes(np.array([0.3, -0.456, 0.0])) == "+0.30, -0.46, +0.00 m"


class TestCorrected:
    """A correction changes what it names, and nothing else."""

    def test_a_tag_moves_in_the_frame_of_its_camera(self, on_map: RangesOnMap) -> None:
        found = corrected(on_map, Correction(tag_moves_m={"U": np.array([0.2, 0.0, -0.1])}))
        arms_m = np.einsum("nji,nj->ni", on_map.model_from_cam, found.problem.tag_from_center)
        is_u = on_map.tag_index == 1
        np.testing.assert_allclose(arms_m[is_u], np.tile([0.5, 0.1, -0.2], (60, 1)))
        np.testing.assert_allclose(arms_m[~is_u], np.tile(ARM_M, (60, 1)))

    def test_an_anchor_gets_another_place(self, on_map: RangesOnMap) -> None:
        found = corrected(on_map, Correction({"B": np.array([1.0, 2.0, 3.0])}))
        for places_m in (found.state.anchors_m, found.problem.anchor_mean_m):
            np.testing.assert_array_equal(places_m[:2], [ANCHORS_M[0], [1.0, 2.0, 3.0]])
        np.testing.assert_array_equal(found.problem.anchor_stddev_m, [0.0, 0.1, np.inf])
        np.testing.assert_array_equal(on_map.state.anchors_m, ANCHORS_M)

    def test_an_anchor_that_counts_as_unknown_is_where_its_ranges_meet(self, on_map: RangesOnMap) -> None:
        off_m = np.array([0.0, 0.4, 0.2])
        elsewhere = replace(on_map, state=replace(on_map.state, anchors_m=ANCHORS_M + off_m))
        found = corrected(elsewhere, Correction({"B": None}))
        # The ranges have the delay of their anchor, which is known.
        np.testing.assert_allclose(where_ranges_meet(elsewhere, 1), ANCHORS_M[1], atol=1e-5)
        np.testing.assert_allclose(found.state.anchors_m[1], ANCHORS_M[1], atol=1e-5)
        np.testing.assert_allclose(found.state.anchors_m[0], ANCHORS_M[0] + off_m)
        assert np.isnan(found.problem.anchor_mean_m[1]).all()
        np.testing.assert_array_equal(found.problem.anchor_stddev_m, [0.0, np.inf, np.inf])

    def test_ranges_get_shorter_by_what_they_read_too_long(self, on_map: RangesOnMap) -> None:
        longer_m = np.linspace(-1.0, 1.0, 120)
        found = corrected(with_longer(on_map, longer_m), Correction(longer_m=longer_m))
        np.testing.assert_allclose(found.residual_m, 0.0, atol=1e-12)

    def test_ranges_that_were_taken_later_are_farther_along_the_path(self, on_map: RangesOnMap) -> None:
        """Four steps of a quarter second later, each has the place and the turn of the range four steps after it."""
        found = corrected(on_map, Correction(time_shift_s=1.0))
        num = 120 - 4 * 3
        np.testing.assert_allclose(found.problem.centers[:num], on_map.problem.centers[12:])
        np.testing.assert_allclose(found.model_from_cam[:num], on_map.model_from_cam[12:])
        np.testing.assert_allclose(known(found.velocity)[:num], known(on_map.velocity)[12:])
        # The tag keeps its lever arm in the camera.
        arms_m = np.einsum("nji,nj->ni", found.model_from_cam, found.problem.tag_from_center)
        np.testing.assert_allclose(arms_m[:, 0], np.where(on_map.tag_index == 0, 0.1, 0.3))
        # The last ones go on from the end of the path.
        beyond = on_map.problem.centers[-1] + 1.0 * known(on_map.velocity)[-1]
        np.testing.assert_allclose(found.problem.centers[-1], beyond)

    @pytest.mark.parametrize(("shift_s", "expected"), [(0.4, 10.4), (0.6, 19.6), (-0.4, 9.6), (-0.6, 0.4)])
    def test_the_nearest_range_in_time_is_followed(self, on_map: RangesOnMap, shift_s: float, expected: float) -> None:
        """The camera is 10 units farther each second, and moves at 1 unit a second at each range."""
        second = np.arange(120.0)
        slow = replace(
            on_map,
            problem=replace(on_map.problem, centers=np.outer(10.0 * second, [1.0, 0.0, 0.0])),
            time_s=second,
            velocity=np.tile([1.0, 0.0, 0.0], (120, 1)),
        )
        found = corrected(slow, Correction(time_shift_s=shift_s)).problem.centers[:, 0]
        np.testing.assert_allclose(found[1:-1], expected + 10.0 * (second[1:-1] - 1.0), atol=1e-9)

    def test_ranges_before_the_first_go_back_from_it(self, on_map: RangesOnMap) -> None:
        found = corrected(on_map, Correction(time_shift_s=-0.6))
        expected = on_map.problem.centers[0] - 0.6 * known(on_map.velocity)[0]
        np.testing.assert_allclose(found.problem.centers[:3], np.tile(expected, (3, 1)))

    def test_ranges_need_not_be_in_the_order_of_time(self, on_map: RangesOnMap) -> None:
        mixed = np.random.default_rng(1).permutation(120)
        assert on_map.velocity is not None
        in_disorder = replace(
            on_map,
            problem=on_map.problem.subset(mixed),
            model_from_cam=on_map.model_from_cam[mixed],
            velocity=on_map.velocity[mixed],
            time_s=on_map.time_s[mixed],
        )
        shift_s = np.linspace(-0.3, 0.4, 120)
        expected = corrected(on_map, Correction(time_shift_s=shift_s)).problem
        found = corrected(in_disorder, Correction(time_shift_s=shift_s[mixed])).problem
        np.testing.assert_allclose(found.centers, expected.centers[mixed], atol=1e-12)

    def test_ranges_without_times_cannot_be_taken_later(self) -> None:
        of_photos = small_map(has_times=False)
        assert corrected(of_photos, Correction(time_shift_s=1.0)).problem is not None
        np.testing.assert_array_equal(
            corrected(of_photos, Correction(time_shift_s=1.0)).problem.centers, of_photos.problem.centers
        )

"""Ranges on a map as a linear problem: its derivatives, its bins, its errors and its steps."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rangesfm.arrays import Array
from rangesfm.diagnostics import linearized as module
from rangesfm.diagnostics.linearized import (
    Linearized,
    RangesOnMap,
    _off_neighbours,
    after_step,
    at_state,
    linearized,
    near_m,
    ranges_on_map,
)
from rangesfm.geometry.similarity import Similarity
from rangesfm.ranging.anchors.site import Site
from rangesfm.ranging.range_observations import OnPath
from rangesfm.scale.range_equation import RangeProblem, RangeState, predicted_ranges, state_after

NUM_POINTS, NUM_ANCHORS = 40, 3
ARM_M = (0.1, -0.2, 0.05)
ANCHORS_M = np.array([[6.0, 1.0, 2.0], [-5.0, 7.0, 1.5], [2.0, -6.0, 3.0]])
PLACED = Similarity(2.0, Rotation.from_rotvec([0.2, -0.3, 0.9]).as_matrix(), np.array([0.5, -1.0, 1.0]))
# The first range was taken then; another one of each anchor follows four times a second.
BEGIN_S, EACH_S = 5.0, 0.25


def small_map(
    stddevs_m: Sequence[float] = (0.0, 0.1, np.inf),
    *,
    num_tags: int = 1,
    has_times: bool = True,
    frame_is_free: bool = True,
    arms_m: Sequence[Sequence[float]] = (ARM_M, (0.3, 0.1, -0.1)),
) -> RangesOnMap:
    """Return 120 ranges without noise of ten seconds to the anchors A, B and C; two of each anchor are a bin.

    Args:
        stddevs_m: of the anchors' given coordinates. arms_m: lever arms of the tags, which take turns.
    """
    points = np.repeat(np.arange(NUM_POINTS), NUM_ANCHORS)
    num, seconds = len(points), EACH_S * points
    # A curved path at a speed that changes.
    centers = np.column_stack([np.sin(0.5 * seconds), 0.04 * seconds**2 - 1.5, 0.3 * np.cos(0.9 * seconds)])
    velocity = np.column_stack([0.5 * np.cos(0.5 * seconds), 0.08 * seconds, -0.27 * np.sin(0.9 * seconds)])
    model_from_cam = Rotation.from_rotvec(np.outer(0.2 * seconds, [0.3, 0.1, 1.0])).as_matrix()
    tag_index = points // 2 % num_tags
    means_m = np.where(np.isfinite(stddevs_m)[:, None], ANCHORS_M, np.nan)
    problem = RangeProblem(
        centers=centers,
        tag_from_center=np.einsum("nij,nj->ni", model_from_cam, np.array(arms_m)[tag_index]),
        anchor_index=np.tile(np.arange(NUM_ANCHORS), NUM_POINTS),
        range_m=np.zeros(num),
        stddev_m=np.ones(num),
        anchor_mean_m=means_m,
        anchor_stddev_m=np.array(stddevs_m),
        bias_mean_m=np.array([0.1, 0.2, 0.0]),
        bias_stddev_m=np.full(NUM_ANCHORS, 0.1),
        common_bias_stddev_m=0.1,
        frame_is_free=frame_is_free,
    )
    state = RangeState(PLACED, ANCHORS_M.copy(), problem.bias_mean_m)
    posed: Any = SimpleNamespace(
        observations=SimpleNamespace(
            log=SimpleNamespace(
                anchor_ids=("A", "B", "C"), tag_ids=("T", "U")[:num_tags], tag_index=np.append(tag_index, 7)
            ),
            on_path=lambda rows: OnPath(points[rows], points[rows] + 1, np.zeros(len(rows))),
        ),
        rows=np.arange(num),
        curve_stddev_m=None,
        placing_stddev_m=lambda scale: np.full(num, 0.01 * scale),
        site=Site(),
    )
    return RangesOnMap(
        posed=posed,
        problem=replace(problem, range_m=predicted_ranges(problem, state)),
        state=state,
        model_from_cam=model_from_cam,
        velocity=velocity if has_times else None,
        time_s=np.asarray(BEGIN_S + seconds),
        weights=np.ones(num),
        bending=None,
    )


def with_longer(on_map: RangesOnMap, longer_m: Array) -> RangesOnMap:
    """Return the map with ranges that read longer by (n,) metres."""
    return replace(on_map, problem=replace(on_map.problem, range_m=on_map.problem.range_m + longer_m))


def slopes(function: Callable[[Array], Array], num: int, step: float = 1e-6) -> Array:
    """Return the derivatives at zero of a function of ``num`` numbers, which are the last axis."""
    steps = step * np.eye(num)
    return np.stack([(function(each) - function(-each)) / (2 * step) for each in steps], axis=-1)


@pytest.fixture(scope="module")
def on_map() -> RangesOnMap:
    return small_map()


@pytest.fixture(scope="module")
def problem(on_map: RangesOnMap) -> Linearized:
    return linearized(on_map)


def test_residuals_are_predicted_minus_measured_with_the_usual_delay_of_the_anchor(on_map: RangesOnMap) -> None:
    np.testing.assert_allclose(on_map.residual_m, 0.0, atol=1e-12)
    longer_m = np.linspace(0.0, 1.0, len(on_map.time_s))
    np.testing.assert_allclose(with_longer(on_map, longer_m).residual_m, -longer_m, atol=1e-12)


def test_the_tag_sits_at_its_lever_arm_from_the_turned_camera(on_map: RangesOnMap) -> None:
    cameras_m = PLACED.apply(on_map.problem.centers)
    tags_m = on_map.from_anchor_m + ANCHORS_M[on_map.problem.anchor_index]
    np.testing.assert_allclose(tags_m - cameras_m, on_map.world_from_cam @ np.array(ARM_M), atol=1e-12)


def test_tags_are_those_of_the_ranges_that_took_part() -> None:
    of_two = small_map(num_tags=2)
    np.testing.assert_array_equal(of_two.tag_index[:18], np.repeat([0, 1, 0], 6))
    assert len(of_two.tag_index) == len(of_two.time_s)


def test_a_solution_becomes_ranges_in_metres_of_its_own_state(on_map: RangesOnMap) -> None:
    num = len(on_map.time_s)
    posed: Any = SimpleNamespace(
        ranges=replace(on_map.problem, stddev_m=np.full(num, 0.2), share=np.full(num, 0.5)),
        rows=np.arange(num),
        model_from_cam=on_map.model_from_cam,
        velocity=on_map.velocity,
        times_s=lambda scale: np.arange(num) * scale,
    )
    weights = np.linspace(0.1, 1.0, num)
    solution: Any = SimpleNamespace(fit=SimpleNamespace(state=on_map.state, weights=weights))
    found = ranges_on_map(posed, solution, None)
    np.testing.assert_array_equal(found.problem.stddev_m, 1.0)
    assert found.problem.share is None
    np.testing.assert_allclose(found.time_s, 2.0 * np.arange(num))
    assert found.weights is weights


class TestDerivatives:
    """The linear problem is that of small changes of the map, averaged over each bin."""

    def test_two_ranges_of_an_anchor_are_a_bin(self, problem: Linearized) -> None:
        assert len(problem.bins) == 60
        assert problem.heard == [0, 1, 2]
        np.testing.assert_allclose(np.unique(problem.time_s), BEGIN_S + 0.5 * np.arange(20) + 0.125)
        np.testing.assert_allclose(problem.gradient.distance_m, problem.bins.distance_m)

    def test_the_design_has_the_slopes_of_the_residuals(self, on_map: RangesOnMap, problem: Linearized) -> None:
        def residual_m(x: Array) -> Array:
            moved = replace(on_map, state=state_after((problem.columns,), on_map.state, x))
            return problem.bins.mean(moved.residual_m)

        np.testing.assert_allclose(problem.design, slopes(residual_m, problem.columns.num), atol=1e-7)
        np.testing.assert_allclose(problem.residual_m, 0.0, atol=1e-12)

    def test_delays_of_anchors_are_errors_and_no_unknowns(self, problem: Linearized) -> None:
        assert problem.columns.num == 1 + 6 + 3 * 2
        np.testing.assert_array_equal(problem.columns.bias, -1)

    def test_priors_are_those_of_the_anchor_that_is_known_roughly(self, problem: Linearized) -> None:
        of_b = np.zeros((3, problem.columns.num))
        of_b[:, problem.columns.anchor[1] : problem.columns.anchor[1] + 3] = np.eye(3) / 0.1
        np.testing.assert_allclose(problem.prior_design, of_b)
        np.testing.assert_array_equal(problem.prior_residual, np.zeros(3))
        assert problem.num_priors == 3

    @pytest.mark.parametrize("frame_is_free", [True, False])
    def test_the_path_moves_with_the_map(self, frame_is_free: bool) -> None:
        # Without lever arms, so that camera and tag are at the same place.
        on_map = small_map(frame_is_free=frame_is_free, arms_m=[(0.0, 0.0, 0.0)])
        problem = linearized(on_map)

        def places_m(x: Array) -> Array:
            state = state_after((problem.columns,), on_map.state, x)
            return problem.bins.mean(state.metric_from_model.apply(on_map.problem.centers))

        np.testing.assert_allclose(problem.place, slopes(places_m, problem.columns.num), atol=1e-7)

    def test_the_lever_arm_is_one_of_the_camera(self, on_map: RangesOnMap, problem: Linearized) -> None:
        def residual_m(arm_m: Array) -> Array:
            arms_m = on_map.problem.tag_from_center + on_map.model_from_cam @ arm_m
            return problem.bins.mean(
                replace(on_map, problem=replace(on_map.problem, tag_from_center=arms_m)).residual_m
            )

        np.testing.assert_allclose(problem.by_lever_arm, slopes(residual_m, 3), atol=1e-7)

    def test_later_ranges_are_farther_along_the_path(self, on_map: RangesOnMap, problem: Linearized) -> None:
        def residual_m(later_s: Array) -> Array:
            assert on_map.velocity is not None
            centers = on_map.problem.centers + later_s * on_map.velocity
            return problem.bins.mean(replace(on_map, problem=replace(on_map.problem, centers=centers)).residual_m)

        assert problem.by_time is not None
        np.testing.assert_allclose(problem.by_time, slopes(residual_m, 1)[:, 0], atol=1e-7)

    def test_ranges_without_times_have_no_slope_by_them(self) -> None:
        assert linearized(small_map(has_times=False)).by_time is None

    def test_the_map_of_the_photos_alone_has_other_residuals(self, problem: Linearized) -> None:
        shift_m = np.linspace(-1.0, 2.0, len(problem.bins))
        shifted = replace(problem, expected=replace(problem.expected, shift_m=shift_m))
        np.testing.assert_allclose(at_state(shifted, problem.on_map).residual_m, shift_m, atol=1e-12)


class TestNeighbours:
    """A range is compared with the lower median of eight consecutive ones of its anchor."""

    def test_every_eight_ranges_have_a_median_of_their_own(self) -> None:
        # Lower medians: 4 of eight, 90 of three, and 7 of the next anchor's two.
        values = np.array([3.0, 1.0, 4.0, 2.0, 8.0, 7.0, 6.0, 5.0, 95.0, 90.0, 10.0, 9.0, 7.0])
        off, _ = _off_neighbours(values, np.repeat([0, 1], [11, 2]))
        np.testing.assert_allclose(off, [-1, -3, 0, -2, 4, 3, 2, 1, 5, 0, -80, 2, 0])

    def test_the_scatter_is_that_of_single_ranges(self) -> None:
        noise = np.random.default_rng(0).normal(0.0, 0.05, 4000)
        index = np.repeat([0, 1], 2000)
        _, scatter = _off_neighbours(noise + 100.0 * index, index)
        assert scatter == pytest.approx(0.05, rel=0.06)

    def test_the_step_from_one_anchor_to_the_next_is_no_scatter(self) -> None:
        _, scatter = _off_neighbours(np.array([3.0, 3.0, 7.0, 20.0]), np.array([0, 0, 1, 2]))
        assert scatter == pytest.approx(1e-9)
        _, scatter = _off_neighbours(np.array([3.0, 7.0]), np.array([0, 1]))
        assert scatter == pytest.approx(1e-9)

    def test_a_good_radio_may_err_by_a_quarter_of_a_metre_and_others_by_three_deviations(self) -> None:
        assert near_m(0.01) == pytest.approx(0.24)
        assert near_m(0.1) == pytest.approx(0.3)

    @pytest.mark.parametrize(("off_m", "counts"), [(0.235, True), (-0.235, True), (0.245, False), (-0.245, False)])
    def test_a_range_that_is_far_from_its_neighbours_does_not_count(
        self, on_map: RangesOnMap, off_m: float, counts: bool
    ) -> None:
        longer_m = np.zeros(len(on_map.time_s))
        longer_m[61] = off_m
        found = linearized(with_longer(on_map, longer_m))
        expected = np.ones(len(longer_m))
        expected[61] = counts
        np.testing.assert_allclose(found.bins.robust_weight, expected, rtol=1e-9)
        assert found.scatter_m == pytest.approx(1e-9)


class TestGarbage:
    """Garbage that happens to agree with its neighbours takes no part either."""

    def test_ranges_of_a_bin_that_agree_on_what_no_anchor_of_this_path_can_have(self, on_map: RangesOnMap) -> None:
        garbage = np.flatnonzero(on_map.problem.anchor_index == 1)[8:16]
        longer_m = np.zeros(len(on_map.time_s))
        longer_m[garbage] = 65535.0
        found = linearized(with_longer(on_map, longer_m)).bins.robust_weight
        np.testing.assert_array_equal(np.flatnonzero(found == 0), garbage)

    def test_a_few_ranges_most_of_which_are_garbage(self, on_map: RangesOnMap) -> None:
        garbage = np.flatnonzero(on_map.problem.anchor_index == 1)[8:14]
        longer_m = np.zeros(len(on_map.time_s))
        longer_m[garbage] = [3.0, 9.0, 14.0, 2.0, 5.0, 7.0]
        found = linearized(with_longer(on_map, longer_m)).bins.robust_weight
        assert (found[garbage] == 0).all()


class TestErrors:
    """Errors are expected before anything is measured, and learnt from what mistakes leave."""

    def test_ranges_wander_slowly_for_each_anchor_and_for_all(self, problem: Linearized) -> None:
        at = problem.errors.names.index("wandering")
        covariance = problem.errors.covariances_m2[at]
        np.testing.assert_allclose(np.diag(covariance), 2 * 0.025**2)
        index, time_s = problem.bins.anchor_index, problem.bins.time_s
        first, other = (int(np.flatnonzero((index == k) & (time_s < 0.5))[0]) for k in (0, 1))
        last = int(np.flatnonzero((index == 0) & (time_s > 9.5))[0])
        assert covariance[first, other] == pytest.approx(0.025**2)
        assert covariance[first, last] == pytest.approx(2 * 0.025**2 * np.exp(-9.5 / 60))

    def test_the_usual_noise_is_that_of_the_ranges(self, problem: Linearized) -> None:
        noisy = replace(problem, scatter_m=0.07)
        assert noisy.with_usual_errors().errors.stddev_of_component["white"] == pytest.approx(0.07)

    def test_errors_are_learnt_where_the_anchors_are_where_they_were_given(self, problem: Linearized) -> None:
        asked: dict[str, Any] = {}
        off_m = np.sin(np.arange(60.0))
        shift_m = np.cos(np.arange(60.0))
        expected: Any = SimpleNamespace(shift_m=shift_m, learnt=lambda **given: asked.update(given) or "learnt")
        # The state has the second anchor elsewhere than where it was given.
        elsewhere = np.zeros(problem.columns.num)
        elsewhere[problem.columns.anchor[1] : problem.columns.anchor[1] + 3] = [0.3, -0.2, 0.1]
        moved = replace(
            problem,
            residual_m=shift_m - off_m + problem.design @ elsewhere,
            prior_residual=problem.prior_design @ elsewhere,
            expected=expected,
            scatter_m=0.07,
        )
        columns, priors = np.arange(120.0).reshape(60, 2), np.arange(6.0).reshape(3, 2)
        near: Any = SimpleNamespace(stddev_of_component={"white": 0.1})
        learnt: Any = moved.with_learnt_errors(columns, priors, near).errors
        assert learnt == "learnt"
        np.testing.assert_allclose(asked["off_m"], off_m, atol=1e-9)
        np.testing.assert_array_equal(asked["design"], np.hstack([problem.design, columns]))
        np.testing.assert_array_equal(asked["prior_design"], np.hstack([problem.prior_design, priors]))
        assert asked["noise_m"] == 0.07
        assert asked["near"] == {"white": 0.1}
        moved.with_learnt_errors()
        np.testing.assert_array_equal(asked["design"], problem.design)
        np.testing.assert_array_equal(asked["prior_design"], problem.prior_design)
        assert asked["near"] is None


class TestSteps:
    """A step leads to the likeliest state, or part of the way if the ranges are less likely there."""

    def test_a_step_from_nearby_ends_where_the_ranges_fit(self, on_map: RangesOnMap, problem: Linearized) -> None:
        off = np.zeros(problem.columns.num)
        off[problem.columns.scale], off[problem.columns.anchor[2]] = 0.01, 0.05
        begun = at_state(problem, replace(on_map, state=state_after((problem.columns,), on_map.state, off)))
        found = after_step(begun)
        assert np.abs(begun.residual_m).max() > 0.02
        assert np.abs(found.residual_m).max() < 1e-3
        assert found.on_map.state.metric_from_model.scale == pytest.approx(2.0, rel=1e-3)

    @pytest.mark.parametrize(
        ("largest_share", "taken"),
        [(2.0, 1.0), (1.0, 1.0), (0.3, 0.25), (1 / 64, 1 / 64), (0.0, None)],
    )
    def test_a_step_is_halved_until_the_ranges_are_as_likely(
        self, monkeypatch: pytest.MonkeyPatch, largest_share: float, taken: float | None
    ) -> None:
        """The cost has two parts, 4 and 9 before, of which larger steps than that share increase the second."""

        def problem_at(share: float) -> Any:
            return SimpleNamespace(
                share=share,
                residual_m=np.array([2.0]),
                prior_residual=np.array([3.0 if share <= largest_share else 3.1]),
                on_map=SimpleNamespace(state=0.0),
            )

        # The ranges of the map are those of the state: replace() of a stand-in.
        monkeypatch.setattr(module, "state_after", lambda columns, state, step: state + float(step[0]))
        monkeypatch.setattr(module, "replace", lambda on_map, state: state)
        monkeypatch.setattr(module, "at_state", lambda problem, state: problem_at(state))
        begun = problem_at(0.0)
        begun.columns, begun.errors = None, SimpleNamespace(covariance_m2=None)
        begun.solved = lambda _: SimpleNamespace(step=np.array([1.0]), whitened=lambda r, p: np.vstack([r, p]))
        found: Any = after_step(begun)
        assert found is begun if taken is None else found.share == taken

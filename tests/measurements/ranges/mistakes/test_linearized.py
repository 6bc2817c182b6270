"""Ranges on a map as a linear problem: its derivatives."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rangesfm.arrays import Array
from rangesfm.measurements.ranges.anchors.site import Site
from rangesfm.measurements.ranges.mistakes.linearized import Linearized, linearized
from rangesfm.measurements.ranges.scale.range_equation import RangeProblem, RangeState, predicted_ranges, state_after
from rangesfm.measurements.ranges.scale.ranges_on_map import RangesOnMap
from rangesfm.measurements.ranges.scale.scale_problem import ScaleProblem
from rangesfm.solver.bending import Bending
from rangesfm.util.geometry.moments import ByTime
from rangesfm.util.geometry.similarity import IDENTITY, Similarity
from rangesfm.util.geometry.trajectory import OnPath

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
        share=np.ones(num),
    )
    state = RangeState(PLACED, ANCHORS_M.copy(), problem.bias_mean_m)
    problem = replace(problem, range_m=predicted_ranges(problem, state))
    given: Any = SimpleNamespace(
        observations=SimpleNamespace(
            log=SimpleNamespace(
                anchor_ids=("A", "B", "C"),
                tag_ids=("T", "U")[:num_tags],
                tag_index=np.append(tag_index, 7),
                shared_stddev_m=np.full(num, np.nan),
                moments=ByTime(np.asarray(BEGIN_S + seconds)),
            ),
            subset=lambda rows: OnPath(points[rows], points[rows] + 1, np.zeros(len(rows))),
            placing_stddev_m=lambda scale: np.full(num, 0.01 * scale),
        ),
        site=Site(),
    )
    errors: Any = None
    rigid: Any = SimpleNamespace(
        path=range(int(points.max()) + 2),
        of_functions=lambda by_pose, frame_is_free: Bending((), np.zeros((len(by_pose),) * 2), np.zeros(len(by_pose))),
    )
    return RangesOnMap(
        posed=ScaleProblem(
            given=given,
            bending=rigid,
            ranges=problem,
            model_from_path=IDENTITY,
            model_from_cam=model_from_cam,
            velocity=velocity,
            rows=np.arange(num),
            notes=(),
            left_out=(),
        ),
        state=state,
        weights=np.ones(num),
        errors=errors,
        noise_stddev_m=0.0,
    )


def slopes(function: Callable[[Array], Array], num: int) -> Array:
    """Return the derivatives at zero of a function of ``num`` numbers, which are the last axis."""
    steps = 1e-6 * np.eye(num)
    return np.stack([(function(each) - function(-each)) / 2e-6 for each in steps], axis=-1)


@pytest.fixture(scope="module")
def on_map() -> RangesOnMap:
    return small_map()


@pytest.fixture(scope="module")
def problem(on_map: RangesOnMap) -> Linearized:
    return linearized(on_map)


class TestDerivatives:
    """The linear problem is that of small changes of the map, averaged over each bin."""

    def test_the_design_has_the_slopes_of_the_residuals(self, on_map: RangesOnMap, problem: Linearized) -> None:
        def residual_m(x: Array) -> Array:
            moved = replace(on_map, state=state_after((problem.columns,), on_map.state, x))
            return problem.bins.mean(moved.residual_m)

        np.testing.assert_allclose(problem.design, slopes(residual_m, problem.columns.num), atol=1e-7)
        np.testing.assert_allclose(problem.residual_m, 0.0, atol=1e-12)

    @pytest.mark.parametrize("frame_is_free", [True, False])
    def test_the_path_moves_with_the_map(self, frame_is_free: bool) -> None:
        # Without lever arms, so that camera and tag are at the same place.
        on_map = small_map(frame_is_free=frame_is_free, arms_m=[(0.0, 0.0, 0.0)])
        problem = linearized(on_map)

        def places_m(x: Array) -> Array:
            state = state_after((problem.columns,), on_map.state, x)
            return problem.bins.mean(state.metric_from_model.apply(on_map.problem.centers))

        np.testing.assert_allclose(problem.place, slopes(places_m, problem.columns.num), atol=1e-7)

    @pytest.mark.parametrize("num_tags", [1, 2])
    def test_a_lever_arm_moves_the_tags_with_the_camera(self, num_tags: int) -> None:
        on_map = small_map(num_tags=num_tags)
        problem = linearized(on_map)

        def residual_m(arm_m: Array) -> Array:
            tags = on_map.problem.tag_from_center + on_map.posed.model_from_cam @ arm_m
            return problem.bins.mean(on_map.with_problem(replace(on_map.problem, tag_from_center=tags)).residual_m)

        np.testing.assert_allclose(problem.by_lever_arm, slopes(residual_m, 3), atol=1e-7)

"""The keyframe graph: what the photos determine and what they leave open, and how ranges unbend a map with it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from scipy.optimize import approx_fprime
from scipy.spatial.transform import Rotation
from tests.estimation.conftest import bent, poses_and_rays
from tests.known_errors import known_errors
from tests.simulated.model import SyntheticModel

from rangesfm.estimation import free_fit
from rangesfm.estimation.free_fit import KeyframeGraph, solve_graph
from rangesfm.estimation.vision_information import vision_information
from rangesfm.measurements.gravity import UpwardDirection
from rangesfm.measurements.kind import MapState
from rangesfm.measurements.prior import Prior
from rangesfm.measurements.ranges.anchors.anchor import AnchorEstimate
from rangesfm.measurements.ranges.association import associate
from rangesfm.measurements.ranges.radio import ranges_of_map
from rangesfm.measurements.ranges.range_log import RangeLog
from rangesfm.options import RefineOptions
from rangesfm.util.geometry.gravity import UP_IN_SITE, Gravity
from rangesfm.util.geometry.poses import Poses
from rangesfm.util.geometry.robust_statistics import GEMAN_MCCLURE
from rangesfm.util.geometry.similarity import IDENTITY, align_points, rmse
from rangesfm.util.geometry.trajectory import trajectory_from_reconstruction

Array = npt.NDArray[np.float64]
ANCHORS_M = np.array([[-40.0, -28.0, 12.0], [-15.0, -28.0, 0.0], [-28.0, -42.0, 9.0], [-30.0, -20.0, 15.0]])
TAG_IN_CAM_M = np.array([0.1, -0.2, 0.05])


def make_graph(
    model: SyntheticModel, origin: Poses, *, stddev_m: float, anchors_are_free: bool = False, held_frame: int = 0
) -> KeyframeGraph:
    """Build a graph with exact ranges to four anchors, at every keyframe and half-way to the next."""
    truth, rays = poses_and_rays(model)
    path = trajectory_from_reconstruction(model.reconstruction, model.timestamps_s)
    times = np.union1d(path.times_s, path.times_s[:-1] + np.diff(path.times_s) / 2)
    m = len(ANCHORS_M)
    ids = [f"A{k}" for k in range(m)] * len(times)
    log = RangeLog.from_arrays(ids, np.ones(len(ids)), timestamp_s=np.repeat(times, m))
    anchors = [anchor(k, anchors_are_free) for k in range(m)]
    placed = associate(log, path, TAG_IN_CAM_M)
    errors, options = known_errors(placed, stddev_m, common_bias_stddev_m=0.1), RefineOptions()
    begun = ranges_of_map(path, placed, IDENTITY, TAG_IN_CAM_M, anchors, errors, options)
    at_truth = {("anchor", f"A{k}"): at for k, at in enumerate(ANCHORS_M)}
    exact_m = begun.predicted_m(MapState(truth, {**begun.blocks, **at_truth})) + 0.05
    placed = replace(placed, log=replace(log, range_m=exact_m))
    ranges = ranges_of_map(path, placed, IDENTITY, TAG_IN_CAM_M, anchors, errors, options)
    # A loss that has practically no effect.
    ranges = replace(ranges, errors=replace(ranges.errors, loss=GEMAN_MCCLURE.scaled(1e6)))
    vision = replace(vision_information(rays, truth), origin=origin)
    return KeyframeGraph(vision, (ranges, *ranges.priors()), held_frame, ranges.blocks)


def anchor(k: int, is_free: bool) -> AnchorEstimate:
    return AnchorEstimate(
        anchor_id=f"A{k}",
        position_m=ANCHORS_M[k] + (0.3 if is_free else 0.0),
        position_stddev_m=0.0,
        prior_position_m=None if is_free else ANCHORS_M[k],
        prior_position_stddev_m=np.inf if is_free else 0.0,
        range_bias_m=0.0,
        prior_bias_m=0.0,
        prior_bias_stddev_m=0.01,
    )


def test_gradient_and_hessian_are_those_of_the_cost(chain: SyntheticModel) -> None:
    truth, _ = poses_and_rays(chain)
    graph = make_graph(chain, truth, stddev_m=0.1, anchors_are_free=True, held_frame=-1)
    # Each kind of prior is tight enough to have a share in the slope.
    gravity = UpwardDirection(Gravity(truth.world_from_rig[0].T @ UP_IN_SITE, 5e-4))
    surveyed = Prior.of_one(("anchor", "A0"), ANCHORS_M[0] + 0.1, 0.02)
    graph = replace(graph, kinds=(*graph.kinds, gravity, surveyed))
    rng = np.random.default_rng(0)
    state = free_fit._moved(graph.start, graph, 1e-3 * rng.standard_normal(len(graph.free)))
    direction = rng.standard_normal(len(graph.free))

    def cost(t: Array) -> float:
        return free_fit._Terms.at(graph, free_fit._moved(state, graph, t[0] * direction)).cost

    slope = approx_fprime(np.zeros(1), cost, 1e-8)[0]
    assert free_fit._Terms.at(graph, state).gradient @ direction == pytest.approx(slope, rel=1e-3)
    # At the origin all residuals are small, so Gauss-Newton's approximation is the true Hessian.
    at_start, step = free_fit._Terms.at(graph, graph.start), 1e-5 * direction
    moved = free_fit._Terms.at(graph, free_fit._moved(graph.start, graph, step))
    change = at_start.gradient @ step + 0.5 * step @ (at_start.hessian @ step)
    assert moved.cost - at_start.cost == pytest.approx(change, rel=1e-3)


@pytest.mark.parametrize(
    ("anchors_are_free", "held_frame"),
    [(False, 0), (False, -1), (True, 0)],
    ids=["first pose held", "site", "unknown anchors"],
)
def test_ranges_unbend_a_drifted_chain(chain: SyntheticModel, anchors_are_free: bool, held_frame: int) -> None:
    truth, _ = poses_and_rays(chain)
    drifted, _ = bent(truth, 25.0, 1.4)
    if held_frame < 0:
        drifted = aligned(drifted, truth)
    drift = rmse(align_points(drifted.centers, truth.centers).apply(drifted.centers) - truth.centers)
    assert drift > 0.5
    graph = make_graph(chain, drifted, stddev_m=1e-3, anchors_are_free=anchors_are_free, held_frame=held_frame)
    solution = solve_graph(graph, graph.start, tolerance_m=1e-5)
    # The relative poses of the bent map are wrong; exact ranges to four anchors outweigh them.
    assert np.sqrt(np.mean(graph.kinds[0].linearize(solution.state).residual ** 2)) < 0.02
    centers = solution.state.poses.centers
    # On such a straight way, unknown anchors would leave the map free to bend; known anchors do not.
    if not anchors_are_free:
        assert rmse(centers - truth.centers) < 0.5 * drift
    if held_frame >= 0:
        np.testing.assert_array_equal(centers[0], drifted.centers[0])


@pytest.mark.parametrize("held_frame", [-1, 0])
def test_a_free_map_turns_on_arcs_and_a_keyframe_that_is_held_stays(chain: SyntheticModel, held_frame: int) -> None:
    truth, _ = poses_and_rays(chain)
    graph = make_graph(chain, truth, stddev_m=0.3, held_frame=held_frame)
    turn = np.deg2rad([4.0, -2.0, 6.0])
    arms = truth.centers - truth.centers.mean(axis=0)
    steps = np.concatenate([truth.world_from_rig.transpose(0, 2, 1) @ turn, np.cross(turn, arms)], axis=1)
    step = np.zeros(graph.starts[-1])
    step[: graph.starts[0]] = steps.ravel()
    moved = free_fit._moved(graph.start, graph, step[graph.free]).poses
    if held_frame < 0:
        rotation = Rotation.from_rotvec(turn).as_matrix()
        np.testing.assert_allclose(moved.centers - truth.centers.mean(axis=0), arms @ rotation.T, atol=1e-12)
        np.testing.assert_allclose(moved.world_from_rig, rotation @ truth.world_from_rig, atol=1e-12)
    else:
        np.testing.assert_array_equal(moved.centers[0], truth.centers[0])
        np.testing.assert_array_equal(moved.world_from_rig[0], truth.world_from_rig[0])


def aligned(poses: Poses, truth: Poses) -> Poses:
    """Align poses with the truth, as the scale stage does in the site frame."""
    similarity = align_points(poses.centers, truth.centers)
    return Poses(similarity.rotation @ poses.world_from_rig, similarity.apply(poses.centers))


def test_the_ranges_determine_no_more_than_there_is(chain: SyntheticModel) -> None:
    truth, _ = poses_and_rays(chain)
    graphs = [make_graph(chain, truth, stddev_m=stddev_m) for stddev_m in (100.0, 0.1)]
    few, many = (solve_graph(graph, graph.start, tolerance_m=1e-4).num_absorbed[0] for graph in graphs)
    assert 0 <= few < many < len(graphs[0].kinds[0].weights.share)

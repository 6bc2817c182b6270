"""Unbends a drifted map before the full problem is solved, and finds what the ranges are worth on the way."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import pycolmap

from rangesfm.geometry import align_points, rmse
from rangesfm.gravity import Gravity
from rangesfm.ranging.anchors import AnchorEstimate
from rangesfm.ranging.observations import RangeObservations
from rangesfm.ranging.robust_loss import wider
from rangesfm.refinement.antennas import Antennas
from rangesfm.refinement.carry import carry_model
from rangesfm.refinement.keyframe_graph import GraphState, KeyframeGraph, local_scales, moved_anchors, solve_graph
from rangesfm.refinement.vision_information import model_observations, model_poses, vision_information
from rangesfm.refinement.weights import RangeWeights, likelier
from rangesfm.trajectory import Trajectory

Array = npt.NDArray[np.float64]

_MAX_NUM_ROUNDS = 12
# Relative; the noise itself is not known better from some hundred ranges.
SAME_WEIGHTS = 0.05
# Of the ranges' stddev: far less than what the full problem has to put right anyway.
_TOLERANCE = 0.1


@dataclass(frozen=True)
class Unbent:
    """What was found.

    Attributes:
        weights: of all ranges. num_absorbed: degrees of freedom that the map takes from them.
        anchors: where they are now.
        bend_m: root mean square distance of keyframes from where one similarity would have put them.
        num_steps: of the keyframe graph's solver.
    """

    weights: RangeWeights
    num_absorbed: float
    anchors: tuple[AnchorEstimate, ...]
    bend_m: float
    num_steps: int


def unbend(
    metric: pycolmap.Reconstruction,
    trajectory: Trajectory,
    observations: RangeObservations,
    antennas: Antennas,
    weights: RangeWeights,
    anchors: tuple[AnchorEstimate, ...],
    *,
    pixel_stddev: float,
    common_bias_stddev_m: float,
    first_pose_is_fixed: bool,
    gravity: Gravity | None,
) -> Unbent:
    """Solve the keyframe graph and, where it moves the map by more than the ranges' noise, move the model, in place.

    The weights are estimated anew with every solution. While drift is large, so are residuals and with them the
    stddevs: the robust loss, which counts in stddevs, tightens as the map straightens and takes no drift for an
    outlier. From there a bounded loss, which is that of the scale and of the full problem, sets aside what is one.
    """
    others = np.setdiff1d(np.array(metric.reg_frame_ids(), dtype=np.int64), trajectory.frame_ids)
    frame_ids = np.concatenate([trajectory.frame_ids, others])
    rays = model_observations(metric, frame_ids, pixel_stddev)
    before = model_poses(metric, frame_ids)
    rows = observations.placed_rows
    placed = weights.subset(rows)
    graph = KeyframeGraph(
        vision=vision_information(rays, before),
        antennas=antennas.subset(rows),
        anchor_index=placed.anchor_index,
        range_m=observations.log.range_m[rows],
        stddev_m=placed.stddev_m,
        share=placed.share,
        anchors=anchors,
        common_bias_stddev_m=common_bias_stddev_m,
        held_frame=0 if first_pose_is_fixed else None,
        gravity=gravity,
        loss=placed.loss,
    )
    fit = _solve_with_own_weights(graph, placed)
    state = fit.state
    if rmse(state.poses.centers - before.centers) > float(np.median(fit.weights.stddev_m)):
        carry_model(metric, frame_ids, rays, before, state.poses, local_scales(graph.vision, state.poses))
        anchors = moved_anchors(anchors, state)
    bend_m = _bend(before.centers, state.poses.centers)
    return Unbent(weights.with_rows(rows, fit.weights), fit.num_absorbed, anchors, bend_m, fit.num_steps)


@dataclass(frozen=True)
class _Fit:
    """A map, the weights that its residuals show, and what it took to find them."""

    state: GraphState
    weights: RangeWeights
    num_absorbed: float
    num_steps: int


def _solve_with_own_weights(graph: KeyframeGraph, weights: RangeWeights) -> _Fit:
    """With the wide loss, then with the bounded.

    Where so many ranges are wrong that the wide loss follows them, the map as it came is likelier, and the bounded one
    starts from there.
    """
    start = graph.start()
    wide = _alternate(graph, replace(weights, loss=wider(weights.loss)), start)
    seen, reached = (weights.noise_in(graph.residuals_m(state)) for state in (start, wide.state))
    if likelier(reached, seen) is reached:
        state, weights = wide.state, replace(wide.weights, loss=weights.loss, likeliest=reached)
    else:
        state, weights = start, replace(weights, likeliest=seen)
    bounded = _alternate(graph, weights.estimated(graph.residuals_m(state), wide.num_absorbed), state)
    return replace(bounded, num_steps=wide.num_steps + bounded.num_steps)


def _alternate(graph: KeyframeGraph, weights: RangeWeights, state: GraphState) -> _Fit:
    """Between the map and the weights that its residuals show."""
    num_steps = 0
    for _ in range(_MAX_NUM_ROUNDS):
        solution = solve_graph(
            graph.with_weights(weights), state, tolerance_m=_TOLERANCE * float(weights.stddev_m.min())
        )
        state, num_steps = solution.state, num_steps + solution.num_steps
        before, weights = weights, weights.estimated(graph.residuals_m(state), solution.num_absorbed)
        if before.change(weights) < SAME_WEIGHTS:
            break
    return _Fit(state, weights, solution.num_absorbed, num_steps)


def _bend(before: Array, after: Array) -> float:
    """RMS distance that no similarity explains; of a path too short for one, nothing does not."""
    return rmse(align_points(before, after).apply(before) - after) if len(before) > 2 else 0.0

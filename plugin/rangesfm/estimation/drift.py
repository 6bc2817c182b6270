"""Removal of drift before the full problem is solved, with an estimate of the measurements' noise (section 5.3)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import pycolmap
from scipy.spatial.transform import Rotation

from rangesfm.arrays import Array, Indices
from rangesfm.colmap.transform import transform
from rangesfm.estimation.free_fit import GraphSolution, KeyframeGraph, local_scales, solve_graph, with_gradient
from rangesfm.estimation.map_problem import MapProblem
from rangesfm.estimation.vision_information import (
    Loop,
    Rays,
    VisionInformation,
    costs_of_points,
    model_rays,
    photo_gradient,
    project,
    ray_residuals,
    robust_root_weights,
    steps_of_points,
    vision_information,
)
from rangesfm.measurements.kind import Block, MapState, Measurements
from rangesfm.solver.bending import FrameSteps
from rangesfm.solver.bundle_adjustment import farthest
from rangesfm.util.geometry.numerics import MAX_NUM_ROUNDS, NEGLIGIBLE_STDDEVS, SIGNIFICANT_STDDEVS
from rangesfm.util.geometry.poses import Poses, model_poses
from rangesfm.util.geometry.robust_statistics import wider
from rangesfm.util.geometry.similarity import Similarity, align_points, are_apart, rmse
from rangesfm.util.geometry.trajectory import pose_of

# Relative change of the weights that ends the iteration: with some hundred measurements noise is not known better.
SAME_NOISE = 0.05
# Movement of a keyframe, in standard deviations of a measurement, at which the solver stops. A turn of the whole world
# by centimetres costs the full problem tens of iterations, since all points have to follow; here it costs one step.
_TOLERANCE = 0.001


def straighten(problem: MapProblem, rays: Rays) -> GraphSolution:
    """Solve the keyframe graph and move the model accordingly, in place.

    The noise is estimated again with every solution. While the drift is large, the residuals and their standard
    deviations are large too. So the robust loss, which is relative to the standard deviations, tightens as the map
    straightens, and does not take drift for outliers. Then a bounded loss, as in the scale stage and in the full
    problem, removes the outliers. Without measurements nothing tells drift from the path.

    Args:
        rays: all observations of the photos.
    """
    if not problem.kinds:
        return GraphSolution(problem.start)
    graph = _graph(problem, rays, problem.start.blocks)
    fit = _solve_with_own_noise(graph, problem)
    _move(problem, rays, graph.vision, fit.state.poses)
    return fit


def straighten_again(problem: MapProblem, rays: Rays, blocks: Mapping[Block, Array]) -> Mapping[Block, Array]:
    """Solve the keyframe graph again from a model that was refined, with known noise, and move the model, in place.

    New weights turn the whole map slightly. That is one step here, but tens of rejected steps in the full problem,
    whose points follow a turn along straight lines.

    Args:
        rays: all observations of the photos. blocks: as they are now.

    Returns:
        the blocks with their new values.
    """
    graph = _graph(replace(problem, is_refined=True), rays, blocks)
    state = _solve_precisely(graph, problem, graph.start).state
    _move(problem, rays, graph.vision, state.poses)
    return state.blocks


def close_in_graph(
    problem: MapProblem, known: Sequence[Measurements], rays: Rays, loops: Sequence[Loop]
) -> MapState | None:
    """Close loops of a model that was refined, in place; None where that bends it by no more than photos just see.

    A map that bends leaves its ranges on the way, and would lose them as outliers. So their noise is estimated anew, as
    in ``straighten``.

    Args:
        problem: with the noise to begin with. known: its measurements with which the model was refined.
        rays: all observations of the photos. loops: of its keyframes.
    """
    refined = problem.like(known)
    graph = _graph(refined, rays, refined.start.blocks, loops)
    # A bundle adjustment follows in any case. More precisely, the graph takes tens of steps along weak modes.
    fit = solve_graph(graph, graph.start, tolerance_m=problem.visible_m)
    before, after = graph.vision.origin.centers, fit.state.poses.centers
    if farthest(align_points(before, after).apply(before), after) <= SIGNIFICANT_STDDEVS * problem.visible_m:
        return None
    if problem.kinds:
        fit = _solve_with_own_noise(replace(graph, kinds=problem.kinds), problem)
    _move(problem, rays, graph.vision, fit.state.poses)
    return fit.state


def _graph(problem: MapProblem, rays: Rays, blocks: Mapping[Block, Array], loops: Sequence[Loop] = ()) -> KeyframeGraph:
    """Set up the keyframe graph of the current model.

    In a refined model the measurements balance the gradient of the photos' cost. In a model of photos alone it is only
    what the mapper left. That goes along weak modes, of which information from pieces of tracks sees less than the
    photos do, so that steps by it would be many times too long.
    """
    takes_part = ~np.isin(rays.point_ids, list(problem.left_out_ids))[rays.point]
    seen, poses = rays.subset(np.flatnonzero(takes_part)), model_poses(problem.metric, problem.frame_ids)
    vision = vision_information(seen, poses)
    if problem.is_refined:
        vision = with_gradient(vision, photo_gradient(seen, poses))
    own = {name: at for name, at in blocks.items() if name[0] != "mark"}  # here marks are where their rays meet
    return KeyframeGraph(vision.with_loops(loops, problem.frame_ids), problem.kinds, problem.held_frame, own)


def _move(problem: MapProblem, rays: Rays, vision: VisionInformation, after: Poses) -> None:
    """Move the model: as a whole, which photos do not notice, or keyframe by keyframe if it bends.

    The full problem has the same difficulty with a part of the map that turns about a weak link as with the whole map.
    """
    metric, before = problem.metric, vision.origin
    whole = _as_a_whole(before, after, problem.held_frame)
    if rmse(after.centers - whole.apply(before.centers)) > NEGLIGIBLE_STDDEVS * problem.usual_stddev:
        carry_model(metric, problem.frame_ids, rays, before, after, local_scales(vision, after))
        return
    first = pose_of(metric.frame(int(problem.timed_ids[0]))).params
    held = first.copy()
    transform(metric, whole)
    if problem.first_pose_is_fixed:
        first[:] = held  # rounding may have changed it


def _as_a_whole(before: Poses, after: Poses, held_frame: int) -> Similarity:
    """Return the similarity with the mean turn that comes closest to the keyframes' movement; a held one stays."""
    if held_frame < 0:
        turn = Rotation.from_matrix(after.world_from_rig @ np.swapaxes(before.world_from_rig, 1, 2)).mean().as_matrix()
        start, end = before.centers.mean(axis=0), after.centers.mean(axis=0)
    else:
        turn, start, end = np.eye(3), before.centers[held_frame], after.centers[held_frame]
    turned = (before.centers - start) @ turn.T
    likeness = float(np.sum(turned * (after.centers - end)))
    # There is no scale for a single point or for a map turned inside out.
    scale = likeness / float(np.sum(turned**2)) if likeness > 0 and are_apart(before.centers) else 1.0
    return Similarity(scale, turn, end - scale * turn @ start)


def _solve_with_own_noise(graph: KeyframeGraph, problem: MapProblem) -> GraphSolution:
    """Estimate the map and the noise that its residuals show: with the wide loss, the bounded one, then precisely.

    If so many measurements are wrong that the wide loss follows them, the given map is more likely than its result.
    Then the bounded loss starts from the given map and noise.
    """
    start = graph.start
    wide, shown = _alternate(graph, problem.replaced(lambda _, kind: kind.under(wider(kind.weights.loss))), start)
    seen, reached = (_log_likelihood(problem, problem.residuals(state)) for state in (start, wide.state))
    state = wide.state if reached >= seen else start
    losses = [kind.weights.loss for kind in problem.kinds]
    again = shown.replaced(lambda k, kind: kind.under(losses[k])).with_noise_of(state, wide.num_absorbed)
    bounded, found = _alternate(graph, again, state)
    settled = _solve_precisely(graph, found, bounded.state)
    return replace(settled, num_steps=wide.num_steps + bounded.num_steps + settled.num_steps)


def _log_likelihood(problem: MapProblem, residuals: list[Array]) -> float:
    return sum(kind.log_likelihood(of) for kind, of in zip(problem.kinds, residuals, strict=True))


def _alternate(graph: KeyframeGraph, problem: MapProblem, start: MapState) -> tuple[GraphSolution, MapProblem]:
    """Alternate between solving the graph and estimating the noise; the solution counts the steps of all rounds."""
    num_steps, state = 0, start
    for _ in range(MAX_NUM_ROUNDS):
        tolerance_m = NEGLIGIBLE_STDDEVS * problem.smallest_stddev
        found = solve_graph(replace(graph, kinds=problem.kinds), state, tolerance_m=tolerance_m)
        num_steps, state = num_steps + found.num_steps, found.state
        before, problem = problem, problem.with_noise_of(state, found.num_absorbed)
        if before.change(problem) < SAME_NOISE:
            break
    return replace(found, num_steps=num_steps), problem


def _solve_precisely(graph: KeyframeGraph, problem: MapProblem, start: MapState) -> GraphSolution:
    return solve_graph(replace(graph, kinds=problem.kinds), start, tolerance_m=_TOLERANCE * problem.smallest_stddev)


def bend(metric: pycolmap.Reconstruction, steps: FrameSteps) -> None:
    """Move frames of a model by steps, in place, and its points with them."""
    frame_ids = np.array(sorted(metric.reg_frame_ids()), dtype=np.int64)
    before, (turns, shifts_m) = model_poses(metric, frame_ids), steps.at(frame_ids)
    after = Poses(before.world_from_rig @ Rotation.from_rotvec(turns).as_matrix(), before.centers + shifts_m)
    carry_model(metric, frame_ids, model_rays(metric, frame_ids), before, after, np.ones(len(frame_ids)))


def carry_model(
    metric: pycolmap.Reconstruction,
    frame_ids: Indices,
    rays: Rays,
    before: Poses,
    after: Poses,
    local_scale: Array,
) -> None:
    """Move frames and points of a model in place, so that a solver that uses their arrays sees the change.

    Args:
        frame_ids: (n,) ids of the frames. rays: to the model's points in these frames.
        before, after: current and new poses of the frames.
        local_scale: (n,) growth of the map around each frame.
    """
    points = _triangulated(rays, after, _carried(rays, before, after, local_scale))
    quaternions = Rotation.from_matrix(np.swapaxes(after.world_from_rig, 1, 2)).as_quat()
    translations = -np.einsum("nji,nj->ni", after.world_from_rig, after.centers)
    moved = np.any(after.centers != before.centers, axis=1) | np.any(
        after.world_from_rig != before.world_from_rig, axis=(1, 2)
    )
    for k in np.flatnonzero(moved):
        pose_of(metric.frame(int(frame_ids[k]))).params[:] = [*quaternions[k], *translations[k]]
    for point_id, point in zip(rays.point_ids, points, strict=True):
        metric.point3D(int(point_id)).xyz[:] = point


def _carried(rays: Rays, before: Poses, after: Poses, local_scale: Array) -> Array:
    """Return the (p, 3) points, each moved rigidly with the first keyframe that sees it and scaled about it."""
    points = rays.points.copy()
    seen, first = np.unique(rays.point, return_index=True)
    frame = rays.frame[first]
    in_rig = np.einsum("nji,nj->ni", before.world_from_rig[frame], points[seen] - before.centers[frame])
    in_rig *= local_scale[frame][:, None]
    points[seen] = after.centers[frame] + np.einsum("nij,nj->ni", after.world_from_rig[frame], in_rig)
    return points


def _triangulated(rays: Rays, poses: Poses, start: Array) -> Array:
    """Return the (p, 3) points that fit the rays best, by Gauss-Newton steps that are kept where they help."""
    points, cost = start, costs_of_points(rays, poses, start)
    for _ in range(5):  # in many more steps, points follow a camera that is out of its place, which then stays there
        _, in_cam, derivative = project(rays, poses, points)
        residuals = np.nan_to_num(ray_residuals(rays, in_cam), posinf=0.0)
        root = robust_root_weights(residuals)[:, None]
        to_rig = np.nan_to_num(derivative) @ rays.cam_from_rig_rotation
        to_point = to_rig @ np.swapaxes(poses.world_from_rig[rays.frame], 1, 2)
        trial = points + steps_of_points(rays, root[:, :, None] * to_point, root * residuals)
        trial_cost = costs_of_points(rays, poses, trial)
        points = np.where((trial_cost < cost)[:, None], trial, points)
        cost = np.fmin(trial_cost, cost)  # a point without any cost keeps its place
    return points

"""Removal of drift before the full problem is solved, with an estimate of the ranges' errors."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pycolmap
from scipy.spatial.transform import Rotation

from rangesfm.arrays import Array, Indices
from rangesfm.colmap.transform import transform
from rangesfm.geometry.numerics import MAX_NUM_ROUNDS, NEGLIGIBLE_STDDEVS
from rangesfm.geometry.similarity import Similarity, align_points, are_apart, rmse
from rangesfm.geometry.trajectory import pose_of
from rangesfm.ranging.anchors.anchor import AnchorEstimate
from rangesfm.ranging.errors.range_errors import RangeErrors, fit_with_own_errors
from rangesfm.ranging.errors.robust_loss import wider
from rangesfm.refine.keyframe_graph import (
    GraphSolution,
    GraphState,
    KeyframeGraph,
    local_scales,
    solve_graph,
    with_gradient,
)
from rangesfm.refine.radio import moved_anchors
from rangesfm.refine.refinement_problem import RefinementProblem
from rangesfm.refine.vision_information import (
    LoopPoses,
    Observations,
    Poses,
    VisionInformation,
    costs_of_points,
    model_poses,
    photo_gradient,
    project,
    ray_residuals,
    robust_root_weights,
    steps_of_points,
    vision_information,
)

# Relative change of the errors that ends the iteration: with some hundred ranges the noise is not known better.
SAME_ERRORS = 0.05
# Movement of a keyframe, in standard deviations of a range, at which the solver stops. A turn of the whole world by
# centimetres costs the full problem tens of iterations, since all points have to follow; here it costs one step.
_TOLERANCE = 0.001
# With many more steps, points follow a camera that is out of its place, which then stays there.
_NUM_TRIANGULATIONS = 5


@dataclass(frozen=True)
class Presolved:
    """Result of the removal of drift.

    Attributes:
        errors: of the ranges. num_absorbed: degrees of freedom of the ranges that the map absorbs.
        anchors: with their new positions and biases.
        bend_m: root mean square distance of the keyframes from their best fit by one similarity.
        num_steps: of the solver of the keyframe graph.
    """

    errors: RangeErrors
    num_absorbed: float
    anchors: tuple[AnchorEstimate, ...]
    bend_m: float
    num_steps: int


def presolve(problem: RefinementProblem, rays: Observations, errors: RangeErrors) -> Presolved:
    """Solve the keyframe graph and move the model accordingly, in place.

    The errors are estimated again with every solution. While the drift is large, the residuals and their standard
    deviations are large too. So the robust loss, which is relative to the standard deviations, tightens as the map
    straightens, and does not take drift for outliers. Then a bounded loss, as in the scale stage and in the full
    problem, removes the outliers.

    Args:
        rays: all observations of the photos. errors: of the ranges that take part.
    """
    if not len(problem.ranges.rows):  # a few lengths bend no map
        return Presolved(errors, 0.0, problem.radio.anchors, 0.0, 0)
    graph = _graph(problem, rays, errors, problem.radio.anchors)
    return _moved(problem, rays, graph, *_solve_with_own_errors(graph))


def presolve_again(
    problem: RefinementProblem, rays: Observations, errors: RangeErrors, anchors: tuple[AnchorEstimate, ...]
) -> Presolved:
    """Solve the keyframe graph again from a model that was refined, with known errors, and move the model, in place.

    New errors turn the whole map slightly. That is one step here, but tens of rejected steps in the full problem, whose
    points follow a turn along straight lines.

    Args:
        rays: all observations of the photos. errors: of the ranges that take part. anchors: as they are now.
    """
    graph = _graph(replace(problem, is_refined=True), rays, errors, anchors)
    return _moved(problem, rays, graph, _solve_precisely(graph, graph.start()), errors)


def presolve_with_loops(
    problem: RefinementProblem,
    rays: Observations,
    errors: RangeErrors,
    known_errors: RangeErrors,
    loops: LoopPoses,
    most_bend_m: float,
) -> tuple[Presolved, bool]:
    """Close loops of a model that was refined, in place, and return the result and whether the model stays near.

    A map that bends far leaves its ranges on the way, and would lose them as outliers. So known errors are kept only
    where closing bends the map by no more than ``most_bend_m``. Elsewhere they are estimated as in ``presolve``.

    Args:
        rays: all observations of the photos.
        errors, known_errors: of the ranges that take part, to begin with, and as the model was refined with.
        loops: by indices in ``problem.frame_ids``.
    """
    if not len(problem.ranges.rows):
        return presolve(problem, rays, errors), False
    graph = _graph(problem, rays, known_errors, problem.radio.anchors, loops)
    fit = _solve_precisely(graph, graph.start())
    if _bend(graph.vision.origin.centers, fit.state.poses.centers) <= most_bend_m:
        return _moved(problem, rays, graph, fit, known_errors), True
    graph = replace(graph, errors=errors)
    return _moved(problem, rays, graph, *_solve_with_own_errors(graph)), False


def _moved(
    problem: RefinementProblem, rays: Observations, graph: KeyframeGraph, fit: GraphSolution, errors: RangeErrors
) -> Presolved:
    """Move the model to a solution of its graph, in place, and return the result."""
    _move(problem, rays, graph.vision, fit.state.poses, errors)
    return Presolved(
        errors=errors,
        num_absorbed=fit.num_absorbed,
        anchors=moved_anchors(graph.anchors, fit.state.anchors_m, fit.state.biases_m),
        bend_m=_bend(graph.vision.origin.centers, fit.state.poses.centers),
        num_steps=fit.num_steps,
    )


def _graph(
    problem: RefinementProblem,
    rays: Observations,
    errors: RangeErrors,
    anchors: tuple[AnchorEstimate, ...],
    loops: LoopPoses | None = None,
) -> KeyframeGraph:
    """Set up the keyframe graph of the current model.

    In a refined model the ranges balance the gradient of the photos' cost. In a model of photos alone it is only what
    the mapper left. That goes along weak modes, of which information from pieces of tracks sees less than the photos
    do, so that steps by it would be many times too long.
    """
    ranges = problem.ranges
    takes_part = ~np.isin(rays.point_ids, list(problem.left_out_ids))[rays.point]
    seen, poses = rays.subset(np.flatnonzero(takes_part)), model_poses(problem.metric, problem.frame_ids)
    vision = vision_information(seen, poses)
    if problem.is_refined:
        vision = with_gradient(vision, photo_gradient(seen, poses))
    return KeyframeGraph(
        vision=vision if loops is None else vision.with_loops(loops),
        antennas=ranges.antennas.subset(ranges.rows),
        range_m=ranges.observations.log.range_m[ranges.rows],
        errors=errors,
        anchors=anchors,
        held_frame=problem.held_frame,
        gravity=problem.gravity,
    )


def _move(
    problem: RefinementProblem, rays: Observations, vision: VisionInformation, after: Poses, errors: RangeErrors
) -> None:
    """Move the model: as a whole, which photos do not notice, or keyframe by keyframe if it bends.

    The full problem has the same difficulty with a part of the map that turns about a weak link as with the whole map.
    """
    metric, before = problem.metric, vision.origin
    whole = _as_a_whole(before, after, problem.held_frame)
    if rmse(after.centers - whole.apply(before.centers)) > NEGLIGIBLE_STDDEVS * float(np.median(errors.stddev_m)):
        carry_model(metric, problem.frame_ids, rays, before, after, local_scales(vision, after))
        return
    first = pose_of(metric.frame(problem.first_frame_id)).params
    held = first.copy()
    transform(metric, whole)
    if problem.first_pose_is_fixed:
        first[:] = held  # rounding may have changed it


def _as_a_whole(before: Poses, after: Poses, held_frame: int | None) -> Similarity:
    """Return the similarity with the mean turn that comes closest to the keyframes' movement; a held one stays."""
    if held_frame is None:
        turn = Rotation.from_matrix(after.world_from_rig @ np.swapaxes(before.world_from_rig, 1, 2)).mean().as_matrix()
        start, end = before.centers.mean(axis=0), after.centers.mean(axis=0)
    else:
        turn, start, end = np.eye(3), before.centers[held_frame], after.centers[held_frame]
    turned = (before.centers - start) @ turn.T
    likeness = float(np.sum(turned * (after.centers - end)))
    # There is no scale for a single point or for a map turned inside out.
    scale = likeness / float(np.sum(turned**2)) if likeness > 0 and are_apart(before.centers) else 1.0
    return Similarity(scale, turn, end - scale * turn @ start)


def _solve_with_own_errors(graph: KeyframeGraph) -> tuple[GraphSolution, RangeErrors]:
    """Estimate the map and the errors that its residuals show: with the wide loss, the bounded one, then precisely.

    If so many ranges are wrong that the wide loss follows them, the given map is more likely than its result. Then the
    bounded loss starts from the given map and errors.
    """
    errors, start = graph.errors, graph.start()
    wide, shown = _alternate(graph, replace(errors, loss=wider(errors.loss)), start)
    seen, reached = (
        errors.noise_of_estimated(graph.residuals_m(state)).log_likelihood for state in (start, wide.state)
    )
    state = wide.state if reached >= seen else start
    errors = replace(shown, loss=errors.loss).seen_by_bending_map(graph.residuals_m(state), wide.num_absorbed)
    bounded, errors = _alternate(graph, errors, state)
    settled = _solve_precisely(replace(graph, errors=errors), bounded.state)
    return replace(settled, num_steps=wide.num_steps + bounded.num_steps + settled.num_steps), errors


def _alternate(graph: KeyframeGraph, errors: RangeErrors, start: GraphState) -> tuple[GraphSolution, RangeErrors]:
    """Alternate between solving the graph and estimating the errors; the solution counts the steps of all rounds."""
    num_steps = 0

    def fit(errors: RangeErrors, before: GraphSolution | None) -> GraphSolution:
        nonlocal num_steps
        state = start if before is None else before.state
        solution = solve_graph(
            replace(graph, errors=errors), state, tolerance_m=_tolerance_m(errors, NEGLIGIBLE_STDDEVS)
        )
        num_steps += solution.num_steps
        return solution

    solution, _, seen = fit_with_own_errors(
        fit,
        lambda errors, found: errors.seen_by_bending_map(graph.residuals_m(found.state), found.num_absorbed),
        errors,
        max_num_rounds=MAX_NUM_ROUNDS,
        is_last=lambda used, shown, _: used.change(shown) < SAME_ERRORS,
    )
    return replace(solution, num_steps=num_steps), seen


def _solve_precisely(graph: KeyframeGraph, start: GraphState) -> GraphSolution:
    return solve_graph(graph, start, tolerance_m=_tolerance_m(graph.errors))


def _tolerance_m(errors: RangeErrors, share: float = _TOLERANCE) -> float:
    return share * float(errors.stddev_m.min())


def _bend(before: Array, after: Array) -> float:
    """Return the root mean square distance that no similarity explains; 0 for fewer than three keyframes."""
    return rmse(align_points(before, after).apply(before) - after) if len(before) > 2 else 0.0


def carry_model(
    metric: pycolmap.Reconstruction,
    frame_ids: Indices,
    observations: Observations,
    before: Poses,
    after: Poses,
    local_scale: Array,
) -> None:
    """Move frames and points of a model in place, so that a solver that uses their arrays sees the change.

    Args:
        frame_ids: (n,) ids of the frames. observations: of the model's points in these frames.
        before, after: current and new poses of the frames.
        local_scale: (n,) growth of the map around each frame.
    """
    points = _triangulated(observations, after, _carried(observations, before, after, local_scale))
    quaternions = Rotation.from_matrix(np.swapaxes(after.world_from_rig, 1, 2)).as_quat()
    translations = -np.einsum("nji,nj->ni", after.world_from_rig, after.centers)
    moved = np.any(after.centers != before.centers, axis=1) | np.any(
        after.world_from_rig != before.world_from_rig, axis=(1, 2)
    )
    for k in np.flatnonzero(moved):
        pose_of(metric.frame(int(frame_ids[k]))).params[:] = [*quaternions[k], *translations[k]]
    for point_id, point in zip(observations.point_ids, points, strict=True):
        metric.point3D(int(point_id)).xyz[:] = point


def _carried(observations: Observations, before: Poses, after: Poses, local_scale: Array) -> Array:
    """Return the (p, 3) points, each moved rigidly with the first keyframe that sees it and scaled about it."""
    points = observations.points.copy()
    seen, first = np.unique(observations.point, return_index=True)
    frame = observations.frame[first]
    in_rig = np.einsum("nji,nj->ni", before.world_from_rig[frame], points[seen] - before.centers[frame])
    in_rig *= local_scale[frame][:, None]
    points[seen] = after.centers[frame] + np.einsum("nij,nj->ni", after.world_from_rig[frame], in_rig)
    return points


def _triangulated(observations: Observations, poses: Poses, start: Array) -> Array:
    """Return the (p, 3) points that fit the rays best, by Gauss-Newton steps that are kept where they help."""
    points, cost = start, costs_of_points(observations, poses, start)
    for _ in range(_NUM_TRIANGULATIONS):
        _, in_cam, derivative = project(observations, poses, points)
        residuals = np.nan_to_num(ray_residuals(observations, in_cam), posinf=0.0)
        root = robust_root_weights(residuals)[:, None]
        to_rig = np.nan_to_num(derivative) @ observations.cam_from_rig_rotation
        to_point = to_rig @ np.swapaxes(poses.world_from_rig[observations.frame], 1, 2)
        trial = points + steps_of_points(observations, root[:, :, None] * to_point, root * residuals)
        trial_cost = costs_of_points(observations, poses, trial)
        points = np.where((trial_cost < cost)[:, None], trial, points)
        cost = np.fmin(trial_cost, cost)  # a point without any cost keeps its place
    return points

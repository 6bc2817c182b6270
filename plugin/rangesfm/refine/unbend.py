"""Unbends a drifted map before the full problem is solved, and finds what the ranges are worth on the way."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pycolmap
from scipy.spatial.transform import Rotation

from rangesfm.arrays import Array, Mask
from rangesfm.colmap.transform import transform
from rangesfm.geometry.similarity import Similarity, align_points, are_apart, rmse
from rangesfm.geometry.trajectory import pose_of
from rangesfm.ranging.anchors.anchor import AnchorEstimate
from rangesfm.ranging.errors.range_errors import RangeErrors, fit_with_own_errors
from rangesfm.ranging.errors.robust_loss import wider
from rangesfm.refine.carry import carry_model
from rangesfm.refine.keyframe_graph import (
    GraphSolution,
    GraphState,
    KeyframeGraph,
    local_scales,
    moved_anchors,
    solve_graph,
)
from rangesfm.refine.problem import RefinementProblem
from rangesfm.refine.vision_information import Observations, Poses, model_poses, vision_information

_MAX_NUM_ROUNDS = 12
# Relative; the noise itself is not known better from some hundred ranges.
SAME_ERRORS = 0.05
# Of the ranges' stddev. A turn of the whole world by centimetres takes the full problem, of which all points have to
# follow it, tens of iterations; here it takes one step.
_TOLERANCE = 0.001
# Likewise. The same goes for a part of the map that turns about a weak link.
_MIN_BEND = 0.05


@dataclass(frozen=True)
class Unbent:
    """What was found.

    Attributes:
        errors: of the ranges. num_absorbed: degrees of freedom that the map takes from them.
        anchors: where they are now.
        bend_m: root mean square distance of keyframes from where one similarity would have put them.
        num_steps: of the keyframe graph's solver.
    """

    errors: RangeErrors
    num_absorbed: float
    anchors: tuple[AnchorEstimate, ...]
    bend_m: float
    num_steps: int


def unbend(problem: RefinementProblem, rays: Observations, misplaced: Mask, errors: RangeErrors) -> Unbent:
    """Solve the keyframe graph and move the model after it, in place: as a whole, to which the photos are indifferent,
    or, where it bends, keyframe by keyframe.

    The errors are estimated anew with every solution. While drift is large, so are residuals and with them the
    stddevs: the robust loss, which counts in stddevs, tightens as the map straightens and takes no drift for an
    outlier. From there a bounded loss, which is that of the scale and of the full problem, sets aside what is one.

    Args:
        rays: all that the photos see, in the problem's frames. misplaced: the points that hold nothing together.
        errors: of the ranges that take part.
    """
    metric, frame_ids, ranges = problem.metric, problem.frame_ids, problem.ranges
    if not len(ranges.rows):  # a few lengths bend no map
        return Unbent(errors, 0.0, problem.anchors, 0.0, 0)
    before = model_poses(metric, frame_ids)
    graph = KeyframeGraph(
        vision=vision_information(rays.of_points(~misplaced), before),
        antennas=ranges.antennas.subset(ranges.rows),
        range_m=ranges.observations.log.range_m[ranges.rows],
        errors=errors,
        anchors=problem.anchors,
        held_frame=0 if problem.first_pose_is_fixed else None,
        gravity=problem.gravity,
    )
    fit = _solve_with_own_errors(graph)
    after = fit.state.poses
    whole = _as_a_whole(before, after, graph.held_frame)
    if rmse(after.centers - whole.apply(before.centers)) > _MIN_BEND * float(np.median(fit.errors.stddev_m)):
        carry_model(metric, frame_ids, rays, before, after, local_scales(graph.vision, after))
    else:
        _move(metric, whole, None if graph.held_frame is None else int(frame_ids[graph.held_frame]))
    return Unbent(
        errors=fit.errors,
        num_absorbed=fit.num_absorbed,
        anchors=moved_anchors(problem.anchors, fit.state),
        bend_m=_bend(before.centers, after.centers),
        num_steps=fit.num_steps,
    )


def _as_a_whole(before: Poses, after: Poses, held_frame: int | None) -> Similarity:
    """Most of the way that the keyframes went: turned as they are in the mean; one that is held stays."""
    if held_frame is None:
        turn = Rotation.from_matrix(after.world_from_rig @ np.swapaxes(before.world_from_rig, 1, 2)).mean().as_matrix()
        start, end = before.centers.mean(axis=0), after.centers.mean(axis=0)
    else:
        turn, start, end = np.eye(3), before.centers[held_frame], after.centers[held_frame]
    turned = (before.centers - start) @ turn.T
    likeness = float(np.sum(turned * (after.centers - end)))
    # Of a point, or turned inside out, there is none.
    scale = likeness / float(np.sum(turned**2)) if likeness > 0 and are_apart(before.centers) else 1.0
    return Similarity(scale, turn, end - scale * turn @ start)


@dataclass(frozen=True)
class _Fit:
    """A map, the errors that its residuals show, and what it took to find them."""

    state: GraphState
    errors: RangeErrors
    num_absorbed: float
    num_steps: int


def _solve_with_own_errors(graph: KeyframeGraph) -> _Fit:
    """With the wide loss, then with the bounded.

    Where so many ranges are wrong that the wide loss follows them, the map as it came is likelier, and the bounded one
    starts from there, with the errors as they came.
    """
    errors, start = graph.errors, graph.start()
    wide = _alternate(graph, replace(errors, loss=wider(errors.loss)), start)
    seen, reached = (
        errors.noise_of_estimated(graph.residuals_m(state)).log_likelihood for state in (start, wide.state)
    )
    if reached >= seen:
        state, residuals_m = wide.state, graph.residuals_m(wide.state)
        errors = replace(wide.errors, loss=errors.loss).seen_by_bending_map(residuals_m, wide.num_absorbed)
    else:
        state, errors = start, replace(errors, log_likelihood=seen)
    bounded = _alternate(graph, errors, state)
    return replace(bounded, num_steps=wide.num_steps + bounded.num_steps)


def _alternate(graph: KeyframeGraph, errors: RangeErrors, start: GraphState) -> _Fit:
    """Between the map and the errors that its residuals show."""
    num_steps = 0

    def fit(errors: RangeErrors, before: GraphSolution | None) -> GraphSolution:
        nonlocal num_steps
        state, tolerance_m = start if before is None else before.state, _TOLERANCE * float(errors.stddev_m.min())
        solution = solve_graph(replace(graph, errors=errors), state, tolerance_m=tolerance_m)
        num_steps += solution.num_steps
        return solution

    solution, _, seen = fit_with_own_errors(
        fit,
        lambda errors, found: errors.seen_by_bending_map(graph.residuals_m(found.state), found.num_absorbed),
        errors,
        max_num_rounds=_MAX_NUM_ROUNDS,
        is_last=lambda used, shown, _: used.change(shown) < SAME_ERRORS,
    )
    return _Fit(solution.state, seen, solution.num_absorbed, num_steps)


def _move(metric: pycolmap.Reconstruction, whole: Similarity, held_frame_id: int | None) -> None:
    held = None if held_frame_id is None else pose_of(metric.frame(held_frame_id)).params
    kept = None if held is None else held.copy()
    transform(metric, whole)
    if held is not None:
        held[:] = kept  # which rounding may have changed


def _bend(before: Array, after: Array) -> float:
    """RMS distance that no similarity explains; of a path too short for one, nothing does not."""
    return rmse(align_points(before, after).apply(before) - after) if len(before) > 2 else 0.0

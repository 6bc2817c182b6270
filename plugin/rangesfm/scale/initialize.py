"""Scale initialisation: ranges and an unscaled path to metres per SfM unit, with its error."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rangesfm.arrays import Array
from rangesfm.distances.ends import LocatedDistances
from rangesfm.errors import GeometryError
from rangesfm.geometry.gravity import gravity_of
from rangesfm.geometry.similarity import Similarity
from rangesfm.geometry.trajectory import Trajectory
from rangesfm.options import RangeModelOptions, ScaleOptions
from rangesfm.ranging.anchors.anchor import Anchor
from rangesfm.ranging.observations import RangeObservations, RangeStatus, status_by_weight
from rangesfm.scale.anchor_by_anchor import anchor_estimates, scale_per_anchor
from rangesfm.scale.cutoff import cutoff_test
from rangesfm.scale.estimate import ScaleEstimate
from rangesfm.scale.levelled_places import levelled_places
from rangesfm.scale.problem import ScaleProblem, scale_problem
from rangesfm.scale.sensitivity import scale_sensitivity
from rangesfm.scale.solution import Solution, solve_scale
from rangesfm.scale.two_candidate import TwoCandidate, two_candidate
from rangesfm.scale.uncertainty import learned_errors, parameter_covariance, scale_uncertainty
from rangesfm.scale.verdict import judge


def initialize_scale(
    observations: RangeObservations,
    trajectory: Trajectory,
    anchors: Sequence[Anchor],
    *,
    anchor_frame: str,
    options: ScaleOptions | None = None,
    range_model: RangeModelOptions | None = None,
    distances: LocatedDistances | None = None,
    seed: int = 0,
) -> ScaleEstimate:
    """Estimate scale and frame of an unscaled path from ranges.

    Args:
        observations: ranges on ``trajectory``.
        trajectory: the unscaled path.
        anchors: every anchor of the log, with what is known of it.
        anchor_frame: "site" (positions in a site frame: the map is carried there),
            "first_camera" (positions in the first keyframe's camera frame, metres) or
            "unknown" (positions are ignored; the map stays in the first camera's frame).
        distances: taped ones in the model of ``trajectory``; its checks have no say.

    Raises:
        InputError: the log has an anchor that is not given.
        GeometryError: the scale, or the place in the site frame, is not determined.
    """
    options, range_model = options or ScaleOptions(), range_model or RangeModelOptions()
    gravity = gravity_of(options.up_in_first_camera)
    problem = scale_problem(observations, trajectory, anchors, anchor_frame, range_model, distances, gravity)
    solution = solve_scale(problem, camera_side=options.camera_side, seed=seed)
    table = _paper_table(solution)
    rotations = model_from_cam(observations, trajectory, problem)
    learned = learned_errors(problem, solution, observations, rotations)
    uncertainty = scale_uncertainty(problem, solution, learned)
    per_anchor = scale_per_anchor(solution, observations.log.anchor_ids)
    covariance = parameter_covariance(solution, learned)
    found = anchor_estimates(solution, observations.log.anchor_ids, covariance)
    tests = cutoff_test(solution)
    judged = judge(problem, solution, uncertainty, per_anchor, found, tests, options)
    verdict, reasons = judged.verdict, judged.reasons
    if gravity is not None and problem.frame == "first_camera" and anchor_frame == "site":
        reasons = (*reasons, *levelled_places(gravity, anchors, found))
    if options.method == "two-candidate":
        robust = solution.fit.state.metric_from_model.scale
        verdict = "doubtful"
        reasons = (f"two-candidate, as asked for; the stddevs are of the robust scale, {robust:.6g}", *reasons)
    status = observations.status.copy()
    status[observations.has_place] = RangeStatus.UNKNOWN_ANCHOR
    status[problem.rows] = status_by_weight(solution.fit.weights)
    return ScaleEstimate(
        metric_from_sfm=_by_method(options.method, solution, table) @ problem.first_camera_from_sfm,
        frame=problem.frame,
        method=options.method,
        uncertainty=uncertainty,
        verdict=verdict,
        reasons=reasons,
        advice=judged.advice,
        cutoff_test=tests,
        sensitivity=scale_sensitivity(solution, rotations, observations.log.anchor_ids),
        per_anchor=per_anchor,
        two_candidate=table,
        anchors=found,
        observations=replace(observations, status=status),
        errors=replace(solution.errors, learned=learned).spread(problem.rows, len(observations.log)),
        noise_stddev_m=solution.noise_stddev_m,
        problem=problem,
        solution=solution,
        placement=placement_covariance(solution, covariance),
    )


def placement_covariance(solution: Solution, covariance: Array) -> Array | None:
    """As ``ScaleEstimate.placement``."""
    columns = solution.fit.columns[0]
    if columns.frame < 0:
        return None
    of_map = [columns.scale, *range(columns.frame, columns.frame + 6)]
    return np.asarray(covariance[np.ix_(of_map, of_map)])


def model_from_cam(observations: RangeObservations, trajectory: Trajectory, problem: ScaleProblem) -> Array:
    """(k, 3, 3) rotation at the keyframe nearest to each range, into the first camera's frame."""
    nearest = np.where(observations.weight < 0.5, observations.before, observations.after)[problem.rows]
    turned: Array = problem.first_camera_from_sfm.rotation @ trajectory.world_from_cam[nearest]
    return turned


def _paper_table(solution: Solution) -> TwoCandidate | None:
    """The paper's duplets, with the anchors carried into the first camera's frame."""
    state, problem = solution.fit.state, solution.problem
    placed = state.metric_from_model
    anchors = (state.anchors_m - placed.translation) @ placed.rotation
    return two_candidate(problem.centers, problem.tag_from_center, anchors[problem.anchor_index], problem.range_m)


def _by_method(method: str, solution: Solution, table: TwoCandidate | None) -> Similarity:
    """metric_from_first_camera, its scale by the method asked for."""
    robust = solution.fit.state.metric_from_model
    if method == "robust":
        return robust
    if table is None or not table.scale > 0:
        raise GeometryError("two-candidate found no positive scale: use the robust method")
    return replace(robust, scale=table.scale)

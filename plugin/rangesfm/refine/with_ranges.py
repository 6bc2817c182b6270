"""Bundle adjustment by COLMAP with ranges, which fixes the scale and removes drift."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import pycolmap

from rangesfm.arrays import Array, Indices
from rangesfm.ceres.covariance import JointCovariance, joint_covariance
from rangesfm.ceres.normal_equations import NormalEquations
from rangesfm.colmap.pieces import frames_of_largest_part
from rangesfm.distances.locate_lengths import LocatedDistances, distances_by_radio
from rangesfm.distances.tape import Tape
from rangesfm.errors import GeometryError, InputError
from rangesfm.geometry.gravity import Gravity
from rangesfm.geometry.similarity import Similarity, align_points
from rangesfm.geometry.trajectory import Trajectory
from rangesfm.options import CameraOptions, RefineOptions
from rangesfm.processes.threads import at_most, with_one_blas_thread
from rangesfm.ranging.anchors.anchor import AnchorEstimate
from rangesfm.ranging.errors.learned import LearnedErrors
from rangesfm.ranging.errors.range_errors import Misfit, RangeErrors, fit_with_own_errors, misfits
from rangesfm.ranging.errors.robust_loss import RobustLoss
from rangesfm.ranging.range_observations import RangeObservations, status_by_weight
from rangesfm.refine.bundle_adjustment import (
    BundleAdjustment,
    SolverRun,
    pixel_stddev_of,
    solve_bundle_adjustment,
    solve_until_still,
)
from rangesfm.refine.distances import MeasuredDistances, add_marker_points, remove_marker_points
from rangesfm.refine.graph_presolve import SAME_ERRORS, Presolved, presolve, presolve_again, presolve_with_loops
from rangesfm.refine.positions import HeldPositions
from rangesfm.refine.radio import AddedRadio, RadioEstimate, radio_as_given
from rangesfm.refine.refinement_problem import RefinementProblem
from rangesfm.refine.vision_information import (
    LoopPoses,
    Observations,
    Poses,
    misplaced_points,
    model_observations,
    model_poses,
    project,
)

# Largest number of solutions of the full problem, between which the errors of ranges and pixels are estimated again.
_MAX_NUM_ROUNDS = 3
# Largest movement of a keyframe left at the end, as a share of the smallest standard deviation of a range.
_MAX_LAST_MOVEMENT = 0.01


@dataclass(frozen=True)
class RefineSummary:
    """Result of the refinement.

    Attributes:
        num_iterations: of the solver on the full problem, successful and unsuccessful.
        num_graph_steps: of the solver on the keyframe graph before.
        bend_m: root mean square bending of the map in the keyframe graph, beyond any similarity.
        initial_cost, final_cost: half the sum of squares, in pixels at unit weight: at the start with the weights at
            that time, and at the end.
        reprojection_rms_px: root mean square length of the final reprojection errors.
        pixel_stddev: standard deviation of a feature's coordinate, from the residuals before.
        errors: of all n ranges of the log, as weighted at the end.
        seconds: time of the solver.
        converged: whether the keyframes came to rest.
        message: of the solver.
        misfits: reasons why the ranges fit worse than their noise suggests; empty if they do not.
        anchors: refined positions and biases, with standard deviations if there is a covariance.
        tags_in_cam_m: (num_tags, 3) lever arms, as given or estimated.
        time_shift_s: how much later than assumed the ranges were taken; None if not estimated.
        short_range_error_m: amplitude of the excess of short ranges, which decays with a length of 1 m; None if not
            estimated.
        covariance: of poses, anchors and scale; None if not asked for, if the model is too large, or if ranges and
            photos leave something undetermined.
        bending_factor: learnt bending over the bending that the photos' residuals suggest; 1 if unknown.
        antenna_in_cam_m: (3,) lever arm of the antenna whose positions are known; None without any.
        position_time_shift_s: how much later than assumed its positions were taken; None if not estimated.
        observations: with status by the final weight of each range.
        predicted_m: (n,) ranges predicted by the refined model; NaN without a place.
        weights: (n,) robust weights in [0, 1]; NaN without a place.
    """

    num_iterations: int
    num_graph_steps: int
    bend_m: float
    initial_cost: float
    final_cost: float
    reprojection_rms_px: float
    pixel_stddev: float
    errors: RangeErrors
    seconds: float
    converged: bool
    message: str
    misfits: tuple[Misfit, ...]
    anchors: tuple[AnchorEstimate, ...]
    tags_in_cam_m: Array
    time_shift_s: float | None
    short_range_error_m: float | None
    covariance: JointCovariance | None
    bending_factor: float
    antenna_in_cam_m: Array | None
    position_time_shift_s: float | None
    observations: RangeObservations
    predicted_m: Array
    weights: Array

    def moved(self, change: Similarity, anchors_m: Array, rows: Indices, longer_m: Array) -> RefineSummary:
        """Return the summary of the same map moved as a whole.

        Args:
            change: from the world of this map to that of the moved one. anchors_m: (m, 3) positions of anchors there.
            rows: (k,) ranges that took part. longer_m: (k,) by how much longer they are there.
        """
        predicted_m, weights, status = self.predicted_m.copy(), self.weights.copy(), self.observations.status.copy()
        predicted_m[rows] += longer_m
        weights[rows] = self.errors.subset(rows).robust_weights((predicted_m - self.observations.log.range_m)[rows])
        status[rows] = status_by_weight(weights[rows])
        mirrors_m = [
            None if each.mirror_position_m is None else change.apply(each.mirror_position_m) for each in self.anchors
        ]
        places = zip(self.anchors, anchors_m, mirrors_m, strict=True)
        return replace(
            self,
            anchors=tuple(replace(a, position_m=at_m, mirror_position_m=mirror_m) for a, at_m, mirror_m in places),
            observations=replace(self.observations, status=status),
            predicted_m=predicted_m,
            weights=weights,
        )

    def __repr__(self) -> str:
        """Return what the refinement did on one line."""
        ended = "converged" if self.converged else "not converged"
        return f"<refinement of {self.num_iterations} iterations, {ended}, {self.reprojection_rms_px:.2f} px>"


@dataclass(frozen=True)
class AtRest:
    """A refined map that has come to rest, and the k ranges that took part.

    Attributes:
        trajectory_m: of its keyframes. scale: metres per unit of the unscaled model.
        tags_m, centers_m: (k, 3) positions of tag and camera at each range.
        anchors: with their biases. errors: as weighted.
        shared_m: (k,) by how much the map takes the ranges to be too long because of shared errors.
        metric: the map.
        equations: of photos and all other measurements; None if the photos are too many.
        firm_frame_ids: of the frames that the photos hold together, which are the map as a whole.
        pixel_stddev: standard deviation of a reprojection error's coordinate.
    """

    trajectory_m: Trajectory
    scale: float
    tags_m: Array
    centers_m: Array
    anchors: tuple[AnchorEstimate, ...]
    errors: RangeErrors
    shared_m: Array
    metric: pycolmap.Reconstruction
    equations: NormalEquations | None
    firm_frame_ids: Indices
    pixel_stddev: float


@dataclass(frozen=True)
class Learnt:
    """The errors learnt at a refined map.

    Attributes:
        errors: of the ranges; None if nothing was learnt.
        bending_factor: learnt bending over the bending that the photos' residuals suggest.
    """

    errors: LearnedErrors | None
    bending_factor: float


Learn = Callable[[AtRest], Learnt]


@dataclass(frozen=True)
class LoopClosing:
    """Means that close the loops of a map.

    Attributes:
        loops: measured relative poses, by ids of frames in place of indices.
        errors: of all ranges of the log, as the map was refined with.
        merge_tracks: merges the points that are one, in place, once the poses have moved.
    """

    loops: LoopPoses
    errors: RangeErrors
    merge_tracks: Callable[[pycolmap.Reconstruction], None]


@with_one_blas_thread
def refine_with_ranges(
    reconstruction: pycolmap.Reconstruction,
    trajectory: Trajectory,
    observations: RangeObservations,
    metric_from_sfm: Similarity,
    anchors: Sequence[AnchorEstimate],
    errors: RangeErrors,
    *,
    tag_in_cam_m: npt.ArrayLike,
    first_pose_is_fixed: bool,
    gravity: Gravity | None = None,
    camera: CameraOptions | None = None,
    options: RefineOptions | None = None,
    tape: Tape | None = None,
    positions: HeldPositions | None = None,
    shared_errors_m: Array | None = None,
    learn: Learn | None = None,
    closing: LoopClosing | None = None,
    is_refined: bool = False,
    num_threads: int = -1,
) -> tuple[pycolmap.Reconstruction, RefineSummary]:
    """Refine a scaled model by bundle adjustment with range residuals.

    Misplaced points (see ``misplaced_points``), as wrong matches make them, do not take part.

    Args:
        reconstruction: in the metric world; it is copied, not changed.
        trajectory, observations: of the unscaled model, as the scale stage had them.
        metric_from_sfm: from the world of ``observations`` to that of ``reconstruction``.
        anchors: in the order of the log, in the metric world. Prior standard deviation 0 fixes an anchor, a finite one
            adds a prior, an infinite one leaves it free.
        errors: of all ranges of the log, from the scale stage. Unless the noise is given, it is estimated again for
            each anchor, together with shares and inflation.
        tag_in_cam_m: (3,) antenna in the camera (rig) frame; or (num_tags, 3), in the order of the log's tags.
        first_pose_is_fixed: the gauge: True in the first camera's frame, False where surveyed anchors determine the
            frame.
        gravity: the upward direction in the first camera; used if its pose is not fixed.
        tape: taped distances, of which the control ones are fitted; ranges between anchors in the log are fitted too.
        positions: known positions in the metric world, which are fitted; None without any.
        shared_errors_m: (n, k) errors that the log's ranges share, for k independent standard deviations, which all
            other measurements may correct; None without any.
        learn: estimates the ranges' errors at the refined map, for its covariance; None: those in ``errors`` are used.
        closing: loops of a refined map, to be closed before; None without any.
        is_refined: whether the model was refined with these ranges before, as one whose loops
            are closed was. It stays where it is if nothing is new.

    Returns:
        the refined model and the summary.

    Raises:
        SolverError: the solver failed.
        InputError: an option passed through to COLMAP is unknown, a clock offset is to be estimated without times, or
            the end of a distance is not in the model.
    """
    options = options or RefineOptions()
    if options.time_offset_stddev_s and trajectory.timestamps_s is None:
        raise InputError("[refine] time_offset_stddev_s needs a log with times, this one names photos")
    metric = pycolmap.Reconstruction(reconstruction)
    tape, positions = (tape or Tape()).control(), positions or HeldPositions()
    ranges, radio = radio_as_given(trajectory, observations, metric_from_sfm, tag_in_cam_m, anchors)
    if shared_errors_m is not None:
        ranges = replace(ranges, shared_errors_m=shared_errors_m)
        radio = replace(radio, shared=np.zeros(shared_errors_m.shape[1]))
    problem = RefinementProblem(
        metric,
        ranges,
        radio,
        MeasuredDistances(_between_anchors(observations, anchors, errors), tape, {}),
        positions,
        camera or CameraOptions(),
        options,
        first_pose_is_fixed,
        None if first_pose_is_fixed else gravity,
        num_threads,
        is_refined or closing is not None,
    )
    with at_most(num_threads):
        errors, start = _errors_to_begin_with(problem, errors, metric_from_sfm.scale), None
        if closing is not None:
            problem, start = _close_loops(problem, errors, closing)
        with _markers_in_map(problem) as with_markers:
            with_markers, bundle, rays = _without_misplaced(with_markers)
            summary = _adjust(with_markers, bundle, start or presolve(with_markers, rays, errors), learn)
    return metric, summary


@contextmanager
def _markers_in_map(problem: RefinementProblem) -> Iterator[RefinementProblem]:
    """Add the markers to the map as points inside the block."""
    metric, distances = problem.metric, problem.distances
    marker_ids = add_marker_points(metric, distances.tape, problem.positions.markers)
    yield replace(problem, distances=replace(distances, marker_ids=marker_ids))
    remove_marker_points(metric, marker_ids)


def _errors_to_begin_with(problem: RefinementProblem, errors: RangeErrors, metres_per_unit: float) -> RangeErrors:
    """Return the errors of the ranges that take part, on the map as it was given."""
    ranges, options = problem.ranges, problem.options
    path = ranges.trajectory.as_in(problem.metric)
    tags_m = ranges.antennas.positions(path.centers, path.world_from_cam)
    placing_m = ranges.observations.placing_stddev_m(metres_per_unit)
    placed = errors.subset(ranges.rows).at(tags_m[ranges.rows], placing_m[ranges.rows])
    if options.short_range_stddev_m > 0:
        placed = placed.without_shared()
    return placed.for_bending_map(RobustLoss(options.range_loss_scale, is_bounded=True))


def _between_anchors(
    observations: RangeObservations, anchors: Sequence[AnchorEstimate], errors: RangeErrors
) -> LocatedDistances:
    used_m = errors.stddev_m[observations.has_place]
    return distances_by_radio(
        observations.log,
        float(np.median(used_m)) if len(used_m) else 0.0,
        np.array([anchor.prior_bias_m for anchor in anchors]),
        np.array([anchor.prior_bias_stddev_m for anchor in anchors]),
        common_bias_stddev_m=0.0,
    )


def _without_misplaced(problem: RefinementProblem) -> tuple[RefinementProblem, BundleAdjustment, Observations]:
    """Return the problem without the misplaced points, its bundle adjustment, and the observations of all points."""
    frame_ids = problem.frame_ids
    rays = model_observations(problem.metric, frame_ids)
    misplaced = misplaced_points(rays, model_poses(problem.metric, frame_ids))
    problem = replace(problem, left_out_ids=frozenset(rays.point_ids[misplaced].tolist()))
    bundle = problem.of_photos(problem.options.max_num_iterations)
    return problem, bundle, rays.with_pixel_stddev(bundle.pixel_stddev)


def _close_loops(
    problem: RefinementProblem, errors: RangeErrors, closing: LoopClosing
) -> tuple[RefinementProblem, Presolved | None]:
    """Move a refined model so that its loops close, and merge its tracks, in place.

    Args:
        errors: of the ranges that take part, to begin with.

    Returns:
        The problem with its anchors moved along, and the start of the full problem; None where the map had to bend
        visibly, so that its drift has to be removed again.
    """
    place = {frame_id: k for k, frame_id in enumerate(problem.frame_ids.tolist())}
    reference, frame = (
        np.array([place[frame_id] for frame_id in ids.tolist()], dtype=np.int64)
        for ids in (closing.loops.reference, closing.loops.frame)
    )
    loops = replace(closing.loops, reference=reference, frame=frame)
    seen, _, rays = _without_misplaced(problem)
    visible_m = _just_visible_m(rays, model_poses(problem.metric, problem.frame_ids))
    known_errors = closing.errors.subset(problem.ranges.rows)
    moved, is_near = presolve_with_loops(seen, rays, errors, known_errors, loops, visible_m)
    closing.merge_tracks(problem.metric)
    if is_near:
        return problem, moved
    # Tracks become one only where their points agree to some pixels. In a map that was bent by metres, all of them do
    # so only when those that have merged have straightened it.
    anchors = _settled(problem, errors, moved.anchors)
    closing.merge_tracks(problem.metric)
    return replace(problem, radio=replace(problem.radio, anchors=anchors)), None


def _just_visible_m(rays: Observations, poses: Poses) -> float:
    """Return the movement of a camera that moves a feature at median depth by its standard deviation."""
    _, in_cam, _ = project(rays, poses, rays.points)
    return float(np.median(np.abs(in_cam[:, 2]) / rays.root_information))


def _settled(
    problem: RefinementProblem, errors: RangeErrors, anchors: tuple[AnchorEstimate, ...]
) -> tuple[AnchorEstimate, ...]:
    """Solve the full problem once, with known errors, and return the moved anchors."""
    radio = replace(problem.radio, anchors=anchors)
    with _markers_in_map(problem) as with_markers:
        with_markers, bundle, _ = _without_misplaced(with_markers)
        added = with_markers.add_to(bundle, errors, radio)
        solve_bundle_adjustment(bundle, _tolerance_m(problem, errors))
        return added.estimate(radio).anchors


@dataclass(frozen=True)
class _Round:
    """Result of one solution of the full problem, all solutions so far, and the number of iterations that are left."""

    radio: RadioEstimate
    solutions: tuple[SolverRun, ...]
    num_left: int


def _adjust(
    problem: RefinementProblem, bundle: BundleAdjustment, start: Presolved, learn: Learn | None
) -> RefineSummary:
    """Alternate between solving the full problem and estimating the errors from its residuals."""
    added: AddedRadio

    def fit(errors: RangeErrors, before: _Round | None) -> _Round:
        nonlocal bundle, added
        if before is None:
            before = _Round(replace(problem.radio, anchors=start.anchors), (), problem.options.max_num_iterations)
        else:
            rays = model_observations(problem.metric, problem.frame_ids).with_pixel_stddev(bundle.pixel_stddev)
            moved = presolve_again(problem, rays, errors, before.radio.anchors)
            before = replace(before, radio=replace(before.radio, anchors=moved.anchors))
            bundle = problem.of_photos(before.num_left)
        added = problem.add_to(bundle, errors, before.radio)
        solution = solve_bundle_adjustment(bundle, _tolerance_m(problem, errors))
        num_left = before.num_left - solution.num_iterations
        return _Round(added.estimate(before.radio), (*before.solutions, solution), num_left)

    def is_last(errors: RangeErrors, seen: RangeErrors, done: _Round) -> bool:
        return errors.change(seen) < SAME_ERRORS or not done.solutions[-1].converged or done.num_left <= 0

    last, errors, _ = fit_with_own_errors(
        fit,
        lambda errors, done: errors.seen_by_bending_map(
            problem.residuals_m(done.radio)[problem.ranges.rows], start.num_absorbed
        ),
        start.errors,
        max_num_rounds=_MAX_NUM_ROUNDS,
        is_last=is_last,
    )
    more, is_still = solve_until_still(bundle, last.solutions[-1], _tolerance_m(problem, errors), last.num_left)
    last = replace(last, radio=added.estimate(last.radio), solutions=(*last.solutions, *more))
    equations = _equations(problem, bundle, added) if bundle.has_covariance else None
    rest = _at_rest(problem, bundle, last.radio, errors, equations)
    learnt = Learnt(errors.learned, 1.0) if learn is None else learn(rest)
    errors = replace(errors, learned=learnt.errors)
    covariance = None
    if problem.options.covariance:
        # Ranges that are too coarse to see any bending do not make it smaller than the noise of the features does.
        covariance = _covariance(problem, bundle, added, errors, rest, max(learnt.bending_factor, 1.0))
    problem.metric.update_point_3d_errors()
    return _summary(problem, start, bundle, last, errors, covariance, learnt.bending_factor, is_still=is_still)


def _equations(problem: RefinementProblem, bundle: BundleAdjustment, added: AddedRadio) -> NormalEquations:
    return NormalEquations.of(
        bundle.adjuster.problem,
        problem.metric,
        bundle.num_reprojections,
        added.blocks.anchors,
        added.all_but_anchors,
    )


def _at_rest(
    problem: RefinementProblem,
    bundle: BundleAdjustment,
    radio: RadioEstimate,
    errors: RangeErrors,
    equations: NormalEquations | None,
) -> AtRest:
    ranges = problem.ranges
    path = ranges.trajectory.as_in(problem.metric)
    tags_m, centers_m = (places[ranges.rows] for places in ranges.places(path, radio))
    firm_ids = frames_of_largest_part(problem.metric)
    is_firm = np.isin(path.frame_ids, firm_ids)
    scale = align_points(ranges.trajectory.centers[is_firm], path.centers[is_firm]).scale
    shared_m = ranges.shared_m(radio)[ranges.rows]
    pixel_stddev = pixel_stddev_of(bundle.adjuster, bundle.num_reprojections)
    return AtRest(
        path,
        scale,
        tags_m,
        centers_m,
        radio.anchors,
        errors,
        shared_m,
        problem.metric,
        equations,
        firm_ids,
        pixel_stddev,
    )


def _tolerance_m(problem: RefinementProblem, errors: RangeErrors) -> float:
    of_others = [*(taped.stddev_m for taped in problem.distances.tape.distances), *problem.positions.stddevs_m]
    return _MAX_LAST_MOVEMENT * float(np.min(errors.stddev_m if len(errors.stddev_m) else of_others))


def _covariance(
    problem: RefinementProblem,
    bundle: BundleAdjustment,
    added: AddedRadio,
    errors: RangeErrors,
    rest: AtRest,
    bending_factor: float,
) -> JointCovariance | None:
    if rest.equations is None:
        return None
    try:
        return joint_covariance(
            rest.equations,
            anchors=added.blocks.anchors,
            others=added.all_but_anchors,
            residual_stddev=bending_factor * bundle.pixel_stddev,
            errors=problem.residual_errors(added, errors, bending_factor),
            anchor_ids=problem.ranges.observations.log.anchor_ids,
            refined_params=bundle.refined_params,
            firm_frame_ids=rest.firm_frame_ids,
        )
    except GeometryError as error:
        logging.getLogger(__name__).info("%s", error)
        return None


def _summary(
    problem: RefinementProblem,
    start: Presolved,
    bundle: BundleAdjustment,
    done: _Round,
    errors: RangeErrors,
    covariance: JointCovariance | None,
    bending_factor: float,
    *,
    is_still: bool,
) -> RefineSummary:
    """Summarise the refinement; ``is_still``: whether the keyframes came to rest."""
    observations, rows = problem.ranges.observations, problem.ranges.rows
    log, radio, options = observations.log, done.radio, problem.options
    residuals_m, weights, status = problem.residuals_m(radio), np.full(len(log), np.nan), observations.status.copy()
    weights[rows] = errors.robust_weights(residuals_m[rows])
    status[rows] = status_by_weight(weights[rows])
    times = observations.before + observations.fraction if log.timestamp_s is None else log.timestamp_s
    last, antenna = done.solutions[-1], problem.positions.antenna
    return RefineSummary(
        num_iterations=sum(solution.num_iterations for solution in done.solutions),
        num_graph_steps=start.num_steps,
        bend_m=start.bend_m,
        initial_cost=done.solutions[0].initial_cost,
        final_cost=last.final_cost,
        reprojection_rms_px=bundle.reprojection_rms_px,
        pixel_stddev=bundle.pixel_stddev,
        errors=errors.spread(rows, len(log)),
        seconds=sum(solution.seconds for solution in done.solutions),
        converged=last.converged and is_still,
        message=last.message,
        misfits=misfits(errors, residuals_m[rows], times[rows]),
        anchors=_with_stddevs(radio.anchors, covariance),
        tags_in_cam_m=radio.tags_in_cam_m,
        time_shift_s=radio.time_shift_s if options.time_offset_stddev_s else None,
        short_range_error_m=radio.short_range_error_m if options.short_range_stddev_m else None,
        covariance=covariance,
        bending_factor=bending_factor,
        antenna_in_cam_m=None if antenna is None else antenna.antenna_in_cam_m[1],
        position_time_shift_s=float(antenna.time_shift_s[0]) if antenna and antenna.time_shift_stddev_s else None,
        observations=replace(observations, status=status),
        predicted_m=residuals_m + log.range_m,
        weights=weights,
    )


def _with_stddevs(
    anchors: tuple[AnchorEstimate, ...], covariance: JointCovariance | None
) -> tuple[AnchorEstimate, ...]:
    if covariance is None:
        return anchors
    variances = np.trace(covariance.anchors, axis1=1, axis2=2) / 3
    # Rounding leaves a negative variance where the joint equations hardly determine an anchor: then it is not known.
    variances[variances < 0] = np.nan
    return tuple(
        replace(anchor, position_stddev_m=float(np.sqrt(variance))) if np.isfinite(anchor.position_m).all() else anchor
        for anchor, variance in zip(anchors, variances, strict=True)
    )

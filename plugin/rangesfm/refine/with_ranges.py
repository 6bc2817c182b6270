"""COLMAP's bundle adjustment with ranges: fixes the scale and bends drift back."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import pycolmap

from rangesfm.ceres.covariance import JointCovariance, ResidualErrors, joint_covariance
from rangesfm.ceres.linear_solver import inverse_is_affordable, overlaps_in
from rangesfm.distances.by_radio import distances_by_radio
from rangesfm.distances.ends import LocatedDistances
from rangesfm.distances.tape import Tape
from rangesfm.errors import GeometryError, InputError
from rangesfm.geometry.gravity import Gravity
from rangesfm.geometry.similarity import Similarity
from rangesfm.geometry.trajectory import Trajectory
from rangesfm.options import CameraOptions, RangeModelOptions, RefineOptions
from rangesfm.ranging.anchors.anchor import AnchorEstimate
from rangesfm.ranging.errors.shared_errors import CURVE_STDDEV_M
from rangesfm.ranging.observations import RangeObservations, status_by_weight
from rangesfm.refine.antennas import antenna_positions, antennas, predicted_ranges, tags_in_cam
from rangesfm.refine.bundle_adjustment import (
    BundleAdjustment,
    Solution,
    bundle_adjustment,
    solve,
    solve_until_still,
)
from rangesfm.refine.distances import (
    MeasuredDistances,
    add_distances,
    add_marker_points,
    remove_marker_points,
)
from rangesfm.refine.points_in_cameras import points_in_cameras
from rangesfm.refine.radio import RadioBlocks, RadioEstimate, RadioRanges, add_radio_priors, add_ranges
from rangesfm.refine.range_errors import range_errors
from rangesfm.refine.unbend import SAME_WEIGHTS, Unbent, unbend
from rangesfm.refine.upright import add_gravity
from rangesfm.refine.vision_information import model_observations, model_poses
from rangesfm.refine.weights import RangeWeights, misfits, range_weights

__all__ = ["RefineSummary", "predicted_ranges", "refine_with_ranges"]

Array = npt.NDArray[np.float64]

# Solutions of the full problem, with the weights of ranges and pixels estimated anew in between.
_MAX_NUM_ROUNDS = 3
# What is still to be gained at the end, as a share of the smallest range stddev.
_MAX_LAST_MOVEMENT = 0.01
# Covariances of so many photos that all see the same take a minute, of twice as many ten.
_MAX_NUM_IMAGES_FOR_COVARIANCE = 1500


@dataclass(frozen=True)
class RefineSummary:
    """What the refinement did.

    Attributes:
        num_iterations: of the solver on the full problem, successful and not.
        num_graph_steps: of the solver on the keyframe graph before.
        bend_m: by how much (root mean square) the keyframe graph saw the map bend, beyond any similarity.
        initial_cost, final_cost: half the sum of squares, pixels at unit weight; at the start, with the weights of
            then, and at the end.
        reprojection_rms_px: root mean square length of the final reprojection errors.
        pixel_stddev: of one coordinate of a feature, estimated from the residuals before.
        range_stddev_m: (n,) of each range, as weighted at the end; NaN without a place.
        correlation_inflation: of these, by which ranges whose errors go together weigh less.
        seconds: of the solver.
        converged: whether it stopped because nothing was left to gain.
        message: the solver's own words.
        misfits: why the ranges do not fit as their noise lets expect; empty if they do.
        anchors: with refined positions and biases, and their stddevs by the covariance, if there is one.
        tags_in_cam_m: (num_tags, 3) lever arms, as given or estimated.
        time_shift_s: how much later than thought the ranges were taken; None if that was not estimated.
        short_range_error_m: of very short ranges, what they read too long, which dies out with a length of 1 m; None
            if it was not estimated.
        covariance: of poses, anchors and scale; None if it was not asked for, the model is too large or ranges and
            photos leave something undetermined.
        observations: with status by the final weight of each range.
        predicted_m: (n,) ranges by the refined model; NaN without a place.
        weights: (n,) robust weights in [0, 1]; NaN without a place.
    """

    num_iterations: int
    num_graph_steps: int
    bend_m: float
    initial_cost: float
    final_cost: float
    reprojection_rms_px: float
    pixel_stddev: float
    range_stddev_m: Array
    correlation_inflation: float
    seconds: float
    converged: bool
    message: str
    misfits: tuple[str, ...]
    anchors: tuple[AnchorEstimate, ...]
    tags_in_cam_m: Array
    time_shift_s: float | None
    short_range_error_m: float | None
    covariance: JointCovariance | None
    observations: RangeObservations
    predicted_m: Array
    weights: Array


def refine_with_ranges(
    reconstruction: pycolmap.Reconstruction,
    trajectory: Trajectory,
    observations: RangeObservations,
    metric_from_sfm: Similarity,
    anchors: Sequence[AnchorEstimate],
    *,
    tag_in_cam_m: npt.ArrayLike,
    range_stddev_m: Array,
    range_share: Array | None = None,
    stddev_is_estimated: npt.NDArray[np.bool_] | None = None,
    correlation_inflation: float = 1.0,
    common_bias_stddev_m: float = RangeModelOptions().common_bias_stddev_m,
    first_pose_is_fixed: bool,
    gravity: Gravity | None = None,
    camera: CameraOptions | None = None,
    options: RefineOptions | None = None,
    tape: Tape | None = None,
    num_threads: int = -1,
) -> tuple[pycolmap.Reconstruction, RefineSummary]:
    """Bundle adjustment of a scaled model with range residuals.

    Points that lie in a camera which sees them take no part.

    Args:
        reconstruction: in the metric world; it is copied, not changed.
        trajectory, observations: of the unscaled model, as the scale stage had them.
        metric_from_sfm: from the world of ``observations`` to that of ``reconstruction``.
        anchors: in the order of the log, in the metric world. One with a prior stddev of 0 is
            held, one with a finite prior is drawn to it, others are free.
        tag_in_cam_m: (3,) antenna in the camera (rig) frame; or (num_tags, 3), in the order of the log's tags.
        range_stddev_m: (n,) of each range.
        range_share: (n,) by how much each counts beside its stddev, as ranges from one place err alike; None: all 1.
        stddev_is_estimated: (n,) which of these come from residuals of the scaled map, which drift makes too large:
            they are estimated anew, each anchor's for itself, and shares and inflation with them. None: all are known.
        correlation_inflation: how much the ranges' correlation in time reduces their say.
        common_bias_stddev_m: of the bias that all anchors share (mean 0), of which their priors say nothing.
        first_pose_is_fixed: the gauge: True in the first camera's frame, False where
            surveyed anchors hold the map.
        gravity: which way is up in the first camera; counts where its pose is not fixed.
        tape: taped distances, of which the map keeps to the control ones; as it does to the ranges between anchors
            that the log holds.

    Returns:
        the refined model and the summary.

    Raises:
        SolverError: the solver failed.
        InputError: an unknown key among the options passed through, a clock offset to estimate without times, or a
            distance's end that is not in the model.
    """
    options = options or RefineOptions()
    if options.time_offset_stddev_s and trajectory.timestamps_s is None:
        raise InputError("[refine] time_offset_stddev_s needs a log with times, this one names photos")
    metric = pycolmap.Reconstruction(reconstruction)
    tape = (tape or Tape()).control()
    distances = MeasuredDistances(
        _between_anchors(observations, anchors, range_stddev_m),
        common_bias_stddev_m,
        tape,
        add_marker_points(metric, tape),
    )
    tags_in_cam_m = tags_in_cam(observations.log, tag_in_cam_m)
    placed = antennas(trajectory, observations, metric_from_sfm, tags_in_cam_m)
    ranges = RadioRanges(observations, trajectory, placed, observations.placed_rows)
    survey = _Survey(
        metric,
        tuple(anchors),
        ranges,
        tags_in_cam_m,
        common_bias_stddev_m,
        distances,
        camera or CameraOptions(),
        options,
        first_pose_is_fixed,
        None if first_pose_is_fixed else gravity,
        num_threads,
    )
    weights = range_weights(
        observations,
        antenna_positions(metric, trajectory, placed),
        range_stddev_m,
        range_share,
        correlation_inflation,
        stddev_is_estimated,
        metric_from_sfm.scale,
        options.range_loss_scale,
        short_range_error_is_estimated=options.short_range_stddev_m > 0,
    )
    summary = _refine(survey, weights)
    remove_marker_points(metric, distances.marker_ids)
    return metric, summary


def _between_anchors(
    observations: RangeObservations, anchors: Sequence[AnchorEstimate], range_stddev_m: Array
) -> LocatedDistances:
    return distances_by_radio(
        observations.log,
        float(np.median(range_stddev_m[observations.has_place])),
        np.array([anchor.prior_bias_m for anchor in anchors]),
        np.array([anchor.prior_bias_stddev_m for anchor in anchors]),
        common_bias_stddev_m=0.0,
    )


@dataclass(frozen=True)
class _Added:
    """What came into a problem of the photos: parameter blocks, and where the residuals of the ranges are."""

    blocks: RadioBlocks
    residual_rows: npt.NDArray[np.int64]


@dataclass(frozen=True)
class _Survey:
    """What stays the same from one solution to the next; only the model changes, in place."""

    metric: pycolmap.Reconstruction
    anchors: tuple[AnchorEstimate, ...]
    ranges: RadioRanges
    tags_in_cam_m: Array
    common_bias_stddev_m: float
    distances: MeasuredDistances
    camera: CameraOptions
    options: RefineOptions
    first_pose_is_fixed: bool
    gravity: Gravity | None
    num_threads: int
    left_out_ids: frozenset[int] = frozenset()

    @property
    def frame_ids(self) -> npt.NDArray[np.int64]:
        """Those of the trajectory, then those without a time."""
        timed = self.ranges.trajectory.frame_ids
        return np.concatenate([timed, np.setdiff1d(np.array(self.metric.reg_frame_ids(), dtype=np.int64), timed)])

    @property
    def first_frame_id(self) -> int:
        return int(self.ranges.trajectory.frame_ids[0])

    def problem(self, max_num_iterations: int) -> BundleAdjustment:
        """Of the photos alone."""
        return bundle_adjustment(
            self.metric,
            self.camera,
            self.options,
            fixed_frame_id=self.first_frame_id if self.first_pose_is_fixed else None,
            max_num_iterations=max_num_iterations,
            num_threads=self.num_threads,
            marker_ids=self.distances.marker_ids.values(),
            left_out_ids=self.left_out_ids - set(self.distances.marker_ids.values()),
        )

    def add_to(self, problem: BundleAdjustment, weights: RangeWeights, radio: RadioEstimate) -> _Added:
        """All else that was measured."""
        blocks = RadioBlocks.at(radio, self.options)
        residual_rows = add_ranges(problem, self.ranges, weights, blocks, self.options)
        blocks.others.extend(
            add_distances(problem, self.distances, radio.anchors, blocks.positions, weights.loss.width)
        )
        add_radio_priors(problem, radio, self.tags_in_cam_m, self.common_bias_stddev_m, blocks, self.options)
        if self.gravity is not None:
            add_gravity(problem, self.gravity, self.first_frame_id)
        return _Added(blocks, residual_rows)

    def range_errors(self, added: _Added, weights: RangeWeights, num_absorbed: float) -> ResidualErrors:
        """How the residuals of the ranges err."""
        rows, log = self.ranges.rows, self.ranges.observations.log
        radio = added.blocks.estimate(RadioEstimate(self.anchors, self.tags_in_cam_m))
        curve = np.full(len(log), CURVE_STDDEV_M) if log.shared_stddev_m is None else log.shared_stddev_m
        return range_errors(
            weights.subset(rows),
            added.residual_rows,
            self.residuals_m(radio)[rows],
            self.ranges.from_anchor_m(self.metric, radio)[rows],
            curve[rows],
            num_absorbed,
        )

    def residuals_m(self, radio: RadioEstimate) -> Array:
        """(n,) predicted minus measured; NaN without a place."""
        return self.ranges.predicted_m(self.metric, radio) - self.ranges.observations.log.range_m


@dataclass(frozen=True)
class _Adjusted:
    """What the full problem came to.

    Attributes:
        solutions: one for each time that it was solved.
        is_still: whether nothing was left to gain.
    """

    solutions: tuple[Solution, ...]
    is_still: bool
    weights: RangeWeights
    radio: RadioEstimate
    covariance: JointCovariance | None
    pixel_stddev: float
    reprojection_rms_px: float


def _refine(survey: _Survey, weights: RangeWeights) -> RefineSummary:
    """Unbend the map, then solve the full problem, both without the points that lie in a camera."""
    frame_ids = survey.frame_ids
    rays = model_observations(survey.metric, frame_ids)
    in_camera = points_in_cameras(rays, model_poses(survey.metric, frame_ids))
    survey = replace(survey, left_out_ids=frozenset(rays.point_ids[in_camera].tolist()))
    problem = survey.problem(survey.options.max_num_iterations)
    start = unbend(
        survey.metric,
        frame_ids,
        rays.with_pixel_stddev(problem.pixel_stddev),
        in_camera,
        survey.ranges.observations,
        survey.ranges.antennas,
        weights,
        survey.anchors,
        common_bias_stddev_m=survey.common_bias_stddev_m,
        first_pose_is_fixed=survey.first_pose_is_fixed,
        gravity=survey.gravity,
    )
    adjusted = _adjust(survey, problem, start)
    survey.metric.update_point_3d_errors()
    return _summary(survey, start, adjusted)


def _adjust(survey: _Survey, problem: BundleAdjustment, start: Unbent) -> _Adjusted:
    """Alternate between the full problem and the weights that its residuals show."""
    weights, radio = start.weights, RadioEstimate(start.anchors, survey.tags_in_cam_m)
    solutions: list[Solution] = []
    while True:
        added = survey.add_to(problem, weights, radio)
        finest_m = float(np.min(weights.stddev_m[survey.ranges.rows]))
        solutions.append(solve(problem, _MAX_LAST_MOVEMENT * finest_m))
        radio = added.blocks.estimate(radio)
        better = _estimated(weights, survey.ranges, survey.residuals_m(radio), start.num_absorbed)
        num_left = survey.options.max_num_iterations - sum(solution.num_iterations for solution in solutions)
        is_last = weights.change(better) < SAME_WEIGHTS or len(solutions) == _MAX_NUM_ROUNDS
        if is_last or not solutions[-1].converged or num_left <= 0:
            break
        weights, problem = better, survey.problem(num_left)
    more, is_still = solve_until_still(problem, solutions[-1], _MAX_LAST_MOVEMENT * finest_m, num_left)
    return _Adjusted(
        (*solutions, *more),
        is_still,
        weights,
        added.blocks.estimate(radio),
        _covariance(survey, problem, added, weights, start.num_absorbed),
        problem.pixel_stddev,
        problem.reprojection_rms_px,
    )


def _covariance(
    survey: _Survey, problem: BundleAdjustment, added: _Added, weights: RangeWeights, num_absorbed: float
) -> JointCovariance | None:
    metric, limit = survey.metric, _MAX_NUM_IMAGES_FOR_COVARIANCE
    if not survey.options.covariance:
        return None
    if metric.num_reg_images() > limit and not inverse_is_affordable(overlaps_in(metric), limit):
        return None
    try:
        return joint_covariance(
            problem.adjuster.problem,
            metric,
            anchors=added.blocks.positions,
            others=added.blocks.all_but_positions,
            residual_stddev=problem.pixel_stddev,
            errors=survey.range_errors(added, weights, num_absorbed),
        )
    except GeometryError as error:
        logging.getLogger(__name__).info("%s", error)
        return None


def _estimated(weights: RangeWeights, ranges: RadioRanges, residuals_m: Array, num_absorbed: float) -> RangeWeights:
    """The weights that the residuals of the ranges that took part show."""
    return weights.with_rows(ranges.rows, weights.subset(ranges.rows).estimated(residuals_m[ranges.rows], num_absorbed))


def _summary(survey: _Survey, start: Unbent, adjusted: _Adjusted) -> RefineSummary:
    observations, rows, weights = survey.ranges.observations, survey.ranges.rows, adjusted.weights
    log, radio, options = observations.log, adjusted.radio, survey.options
    residuals_m = survey.residuals_m(radio)
    robust = weights.loss.weights(residuals_m / weights.stddev_m)
    status = observations.status.copy()
    status[rows] = status_by_weight(robust[rows])
    times = observations.before + observations.weight if log.timestamp_s is None else log.timestamp_s
    last = adjusted.solutions[-1]
    return RefineSummary(
        num_iterations=sum(solution.num_iterations for solution in adjusted.solutions),
        num_graph_steps=start.num_steps,
        bend_m=start.bend_m,
        initial_cost=adjusted.solutions[0].initial_cost,
        final_cost=last.final_cost,
        reprojection_rms_px=adjusted.reprojection_rms_px,
        pixel_stddev=adjusted.pixel_stddev,
        range_stddev_m=weights.stddev_m,
        correlation_inflation=weights.inflation,
        seconds=sum(solution.seconds for solution in adjusted.solutions),
        converged=last.converged and adjusted.is_still,
        message=last.message,
        misfits=misfits(weights.subset(rows), residuals_m[rows], times[rows]),
        anchors=_with_stddevs(radio.anchors, adjusted.covariance),
        tags_in_cam_m=radio.tags_in_cam_m,
        time_shift_s=radio.time_shift_s if options.time_offset_stddev_s else None,
        short_range_error_m=radio.short_range_error_m if options.short_range_stddev_m else None,
        covariance=adjusted.covariance,
        observations=replace(observations, status=status),
        predicted_m=residuals_m + log.range_m,
        weights=robust,
    )


def _with_stddevs(
    anchors: tuple[AnchorEstimate, ...], covariance: JointCovariance | None
) -> tuple[AnchorEstimate, ...]:
    if covariance is None:
        return anchors
    variances = np.trace(covariance.anchors, axis1=1, axis2=2) / 3
    return tuple(
        replace(anchor, position_stddev_m=float(np.sqrt(variance))) if np.isfinite(anchor.position_m).all() else anchor
        for anchor, variance in zip(anchors, variances, strict=True)
    )

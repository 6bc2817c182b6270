"""COLMAP's bundle adjustment with ranges: fixes the scale and bends drift back."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import pycolmap

from rangesfm.distances.by_radio import distances_by_radio
from rangesfm.distances.ends import LocatedDistances
from rangesfm.distances.tape import Tape
from rangesfm.geometry import Similarity
from rangesfm.options import CameraOptions, RefineOptions
from rangesfm.ranging.anchors import AnchorEstimate
from rangesfm.ranging.observations import RangeObservations, robust_weights, status_by_weight
from rangesfm.refinement.antennas import Antennas, antennas, predicted_ranges
from rangesfm.refinement.bundle_adjustment import Adjustment, BundleAdjustment, adjust_with_ranges, bundle_adjustment
from rangesfm.refinement.distances import (
    MeasuredDistances,
    add_distances,
    add_marker_points,
    remove_marker_points,
)
from rangesfm.refinement.unbend import SAME_WEIGHTS, Unbent, unbend
from rangesfm.refinement.weights import RangeWeights, misfits, range_weights
from rangesfm.trajectory import Trajectory

__all__ = ["RefineSummary", "predicted_ranges", "refine_with_ranges"]

Array = npt.NDArray[np.float64]

# Solutions of the full problem, with the weights of ranges and pixels estimated anew in between.
_MAX_NUM_ROUNDS = 3


@dataclass(frozen=True)
class RefineSummary:
    """What the refinement did.

    Attributes:
        num_iterations: of the solver on the full problem, successful and not.
        num_graph_steps: of the solver on the keyframe graph before.
        bend_m: by how much (root mean square) the keyframe graph saw the map bend, beyond any similarity.
        initial_cost, final_cost: half the sum of squares, pixels at unit weight; of the last solution.
        reprojection_rms_px: root mean square length of the final reprojection errors.
        pixel_stddev: of one coordinate of a feature, estimated from the residuals before.
        range_stddev_m: (n,) of each range, as weighted at the end; NaN without a place.
        correlation_inflation: of these, by which ranges whose errors go together weigh less.
        seconds: of the solver.
        converged: whether it stopped because nothing was left to gain.
        message: the solver's own words.
        misfits: why the ranges do not fit as their noise lets expect; empty if they do.
        anchors: with refined positions and biases.
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
    stddev_is_estimated: npt.NDArray[np.bool_] | None = None,
    correlation_inflation: float = 1.0,
    common_bias_stddev_m: float = 0.0,
    first_pose_is_fixed: bool,
    camera: CameraOptions | None = None,
    options: RefineOptions | None = None,
    tape: Tape | None = None,
    num_threads: int = -1,
) -> tuple[pycolmap.Reconstruction, RefineSummary]:
    """Bundle adjustment of a scaled model with range residuals.

    Args:
        reconstruction: in the metric world; it is copied, not changed.
        trajectory, observations: of the unscaled model, as the scale stage had them.
        metric_from_sfm: from the world of ``observations`` to that of ``reconstruction``.
        anchors: in the order of the log, in the metric world. One with a prior stddev of 0 is
            held, one with a finite prior is drawn to it, others are free.
        tag_in_cam_m: (3,) antenna in the camera (rig) frame; or (num_tags, 3), in the order of the log's tags.
        range_stddev_m: (n,) of each range.
        stddev_is_estimated: (n,) which of these come from residuals of the scaled map, which drift makes too large:
            they are estimated anew, each anchor's for itself, and the inflation with them. None: all are known.
        correlation_inflation: how much the ranges' correlation in time reduces their say.
        common_bias_stddev_m: of an error that all biases' priors share, as drift leaves one to the scale stage.
        first_pose_is_fixed: the gauge: True in the first camera's frame, False where
            surveyed anchors hold the map.
        tape: taped distances, of which the map keeps to the control ones; as it does to the ranges between anchors
            that the log holds.

    Returns:
        the refined model and the summary.

    Raises:
        SolverError: the solver failed.
        InputError: an unknown key among the options passed through, or a distance's end that is not in the model.
    """
    options = options or RefineOptions()
    metric = pycolmap.Reconstruction(reconstruction)
    tape = (tape or Tape()).control()
    distances = MeasuredDistances(
        _between_anchors(observations, anchors, range_stddev_m),
        common_bias_stddev_m,
        tape,
        add_marker_points(metric, tape),
    )
    survey = _Survey(
        metric,
        trajectory,
        observations,
        metric_from_sfm,
        np.asarray(tag_in_cam_m, dtype=np.float64),
        camera or CameraOptions(),
        options,
        first_pose_is_fixed,
        num_threads,
        distances,
    )
    weights = range_weights(
        observations,
        range_stddev_m,
        correlation_inflation,
        stddev_is_estimated,
        metric_from_sfm.scale,
        options.range_loss_scale,
    )
    summary = _refine(survey, weights, tuple(anchors), common_bias_stddev_m)
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
class _Survey:
    """What stays the same from one solution to the next; only the model changes, in place."""

    metric: pycolmap.Reconstruction
    trajectory: Trajectory
    observations: RangeObservations
    metric_from_sfm: Similarity
    tag_in_cam_m: Array
    camera: CameraOptions
    options: RefineOptions
    first_pose_is_fixed: bool
    num_threads: int
    distances: MeasuredDistances

    @property
    def antennas(self) -> Antennas:
        return antennas(self.trajectory, self.observations, self.metric_from_sfm, self.tag_in_cam_m)

    def problem(self, max_num_iterations: int) -> BundleAdjustment:
        return bundle_adjustment(
            self.metric,
            self.camera,
            self.options,
            fixed_frame_id=int(self.trajectory.frame_ids[0]) if self.first_pose_is_fixed else None,
            max_num_iterations=max_num_iterations,
            num_threads=self.num_threads,
            marker_ids=self.distances.marker_ids.values(),
        )

    def adjust(
        self, problem: BundleAdjustment, weights: RangeWeights, anchors: tuple[AnchorEstimate, ...]
    ) -> Adjustment:
        """Solve with the ranges and distances."""
        return adjust_with_ranges(
            problem,
            self.trajectory,
            self.observations,
            self.antennas,
            weights,
            anchors,
            lambda blocks: add_distances(problem, self.distances, anchors, blocks.positions, weights.loss_scale),
        )

    def residuals_m(self, anchors: Sequence[AnchorEstimate]) -> Array:
        """(n,) predicted minus measured; NaN without a place."""
        predicted = predicted_ranges(
            self.metric,
            self.trajectory,
            self.observations,
            self.metric_from_sfm,
            self.tag_in_cam_m,
            [anchor.position_m for anchor in anchors],
            [anchor.range_bias_m for anchor in anchors],
        )
        return predicted - self.observations.log.range_m


def _refine(
    survey: _Survey, weights: RangeWeights, anchors: tuple[AnchorEstimate, ...], common_bias_stddev_m: float
) -> RefineSummary:
    """Unbend the map, then alternate between the full problem and the weights that its residuals show."""
    problem = survey.problem(survey.options.max_num_iterations)
    start = unbend(
        survey.metric,
        survey.trajectory,
        survey.observations,
        survey.antennas,
        weights,
        anchors,
        pixel_stddev=problem.pixel_stddev,
        common_bias_stddev_m=common_bias_stddev_m,
        first_pose_is_fixed=survey.first_pose_is_fixed,
    )
    weights, anchors = start.weights, start.anchors
    adjustments: list[Adjustment] = []
    while True:
        adjustments.append(survey.adjust(problem, weights, anchors))
        anchors = adjustments[-1].anchors
        residuals_m = survey.residuals_m(anchors)
        better = _estimated(weights, survey.observations, residuals_m, start.num_absorbed)
        num_left = survey.options.max_num_iterations - sum(a.num_iterations for a in adjustments)
        is_final = weights.change(better) < SAME_WEIGHTS or len(adjustments) == _MAX_NUM_ROUNDS
        if is_final or not adjustments[-1].converged or num_left <= 0:
            survey.metric.update_point_3d_errors()
            return _summary(adjustments, start, problem.pixel_stddev, survey.observations, weights, residuals_m)
        weights, problem = better, survey.problem(num_left)


def _estimated(
    weights: RangeWeights, observations: RangeObservations, residuals_m: Array, num_absorbed: float
) -> RangeWeights:
    """The weights that the residuals of the ranges that took part show."""
    rows = np.flatnonzero(observations.has_place)
    return weights.with_rows(rows, weights.subset(rows).estimated(residuals_m[rows], num_absorbed))


def _summary(
    adjustments: Sequence[Adjustment],
    start: Unbent,
    pixel_stddev: float,
    observations: RangeObservations,
    weights: RangeWeights,
    residuals_m: Array,
) -> RefineSummary:
    last, log = adjustments[-1], observations.log
    robust = robust_weights(residuals_m / weights.stddev_m, weights.loss_scale)
    status, rows = observations.status.copy(), np.flatnonzero(observations.has_place)
    status[rows] = status_by_weight(robust[rows])
    times = observations.before + observations.weight if log.timestamp_s is None else log.timestamp_s
    return RefineSummary(
        num_iterations=sum(adjustment.num_iterations for adjustment in adjustments),
        num_graph_steps=start.num_steps,
        bend_m=start.bend_m,
        initial_cost=last.initial_cost,
        final_cost=last.final_cost,
        reprojection_rms_px=last.reprojection_rms_px,
        pixel_stddev=pixel_stddev,
        range_stddev_m=weights.stddev_m,
        correlation_inflation=weights.inflation,
        seconds=sum(adjustment.seconds for adjustment in adjustments),
        converged=last.converged,
        message=last.message,
        misfits=misfits(weights.subset(rows), residuals_m[rows], times[rows]),
        anchors=last.anchors,
        observations=replace(observations, status=status),
        predicted_m=residuals_m + log.range_m,
        weights=robust,
    )

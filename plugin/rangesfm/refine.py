"""COLMAP's bundle adjustment with ranges: fixes the scale and bends drift back."""

from __future__ import annotations

import heapq
import itertools
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import cast

import numpy as np
import numpy.typing as npt
import pycolmap

from rangesfm import _ceres
from rangesfm.errors import SolverError
from rangesfm.geometry import Similarity
from rangesfm.options import CameraOptions, RefineOptions
from rangesfm.passthrough import apply_options
from rangesfm.ranging.anchors import AnchorEstimate
from rangesfm.ranging.log import RangeLog
from rangesfm.ranging.observations import RangeObservations, robust_weights, status_by_weight
from rangesfm.trajectory import Trajectory, pose_of, trajectory_from_reconstruction

Array = npt.NDArray[np.float64]

# Ceres' default of 1e4 damps the scale, which all poses share, so strongly that it creeps
# and is then taken for converged.
_INITIAL_TRUST_REGION_RADIUS = 1e8
_TOLERANCE = 1e-10
# No feature is located better; weighed against a smaller one, ranges lose all say in a model without noise.
_MIN_PIXEL_STDDEV = 0.05


@dataclass(frozen=True)
class RefineSummary:
    """What the refinement did.

    Attributes:
        num_iterations: of the solver, successful and not.
        initial_cost, final_cost: half the sum of squares, pixels at unit weight.
        reprojection_rms_px: root mean square length of the final reprojection errors.
        pixel_stddev: of one coordinate of a feature, estimated from the residuals before.
        seconds: of the solver.
        converged: whether it stopped because nothing was left to gain.
        message: the solver's own words.
        anchors: with refined positions and biases.
        observations: with status by the final weight of each range.
        predicted_m: (n,) ranges by the refined model; NaN without a place.
        weights: (n,) robust weights in [0, 1]; NaN without a place.
    """

    num_iterations: int
    initial_cost: float
    final_cost: float
    reprojection_rms_px: float
    pixel_stddev: float
    seconds: float
    converged: bool
    message: str
    anchors: tuple[AnchorEstimate, ...]
    observations: RangeObservations
    predicted_m: Array
    weights: Array


@dataclass(frozen=True)
class _Blocks:
    """Parameter blocks that the solver changes in place."""

    anchors: list[Array]
    biases: list[Array]


def refine_with_ranges(
    reconstruction: pycolmap.Reconstruction,
    trajectory: Trajectory,
    observations: RangeObservations,
    metric_from_sfm: Similarity,
    anchors: Sequence[AnchorEstimate],
    *,
    tag_in_cam_m: npt.ArrayLike,
    range_stddev_m: Array,
    correlation_inflation: float = 1.0,
    first_pose_is_fixed: bool,
    camera: CameraOptions | None = None,
    options: RefineOptions | None = None,
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
        correlation_inflation: how much the ranges' correlation in time reduces their say.
        first_pose_is_fixed: the gauge: True in the first camera's frame, False where
            surveyed anchors hold the map.

    Returns:
        the refined model and the summary.

    Raises:
        SolverError: the solver failed.
        InputError: an unknown key among the options passed through.
    """
    options, camera = options or RefineOptions(), camera or CameraOptions()
    metric = pycolmap.Reconstruction(reconstruction)
    adjuster = _bundle_adjuster(metric, trajectory, camera, options, first_pose_is_fixed, num_threads)
    num_reprojections = adjuster.problem.num_residuals()
    if num_reprojections == 0:
        raise SolverError("no point of the model takes part in the bundle adjustment")
    pixel_stddev = _pixel_stddev(adjuster, num_reprojections)
    blocks = _Blocks([a.position_m.copy() for a in anchors], [np.array([a.range_bias_m]) for a in anchors])
    # Ranges in units of pixels: one stddev of either weighs the same, and correlated ranges less.
    range_unit = correlation_inflation / pixel_stddev
    _add_ranges(
        adjuster,
        metric,
        trajectory,
        observations,
        metric_from_sfm,
        tags_in_cam_of_ranges(observations.log, tag_in_cam_m),
        range_stddev_m * range_unit,
        _ceres.cauchy_loss(options.range_loss_scale / range_unit),
        blocks,
    )
    _add_anchor_priors(adjuster, metric, anchors, blocks, pixel_stddev)

    start = time.monotonic()
    summary = cast(pycolmap.CeresBundleAdjustmentSummary, adjuster.solve()).ceres_summary
    seconds = time.monotonic() - start
    if not summary.IsSolutionUsable():
        raise SolverError(f"the bundle adjustment with ranges failed: {summary.message}")
    reprojections = np.asarray(adjuster.problem.evaluate_residuals())[:num_reprojections]
    metric.update_point_3d_errors()

    predicted = predicted_ranges(
        metric,
        trajectory,
        observations,
        metric_from_sfm,
        tag_in_cam_m,
        blocks.anchors,
        [float(bias[0]) for bias in blocks.biases],
    )
    scaled = (predicted - observations.log.range_m) / range_stddev_m
    weights = robust_weights(scaled, options.range_loss_scale)
    status = observations.status.copy()
    placed = observations.has_place
    status[placed] = status_by_weight(weights[placed])
    return metric, RefineSummary(
        num_iterations=summary.num_successful_steps + summary.num_unsuccessful_steps,
        initial_cost=summary.initial_cost,
        final_cost=summary.final_cost,
        reprojection_rms_px=float(np.sqrt(2 * np.mean(reprojections**2))),
        pixel_stddev=pixel_stddev,
        seconds=seconds,
        converged=summary.termination_type.name == "CONVERGENCE",
        message=summary.message,
        anchors=tuple(
            replace(anchor, position_m=position, range_bias_m=float(bias[0]))
            for anchor, position, bias in zip(anchors, blocks.anchors, blocks.biases, strict=True)
        ),
        observations=replace(observations, status=status),
        predicted_m=predicted,
        weights=weights,
    )


def _bundle_adjuster(
    metric: pycolmap.Reconstruction,
    trajectory: Trajectory,
    camera: CameraOptions,
    options: RefineOptions,
    first_pose_is_fixed: bool,
    num_threads: int,
) -> pycolmap.CeresBundleAdjuster:
    """COLMAP's own problem over all photos, with a gauge that leaves the scale to the ranges."""
    ba = pycolmap.BundleAdjustmentOptions(print_summary=False)
    ba.refine_focal_length = ba.refine_extra_params = camera.refine_intrinsics is True
    solver = ba.ceres.solver_options
    solver.initial_trust_region_radius = _INITIAL_TRUST_REGION_RADIUS
    solver.function_tolerance = solver.gradient_tolerance = solver.parameter_tolerance = _TOLERANCE
    solver.max_num_iterations = options.max_num_iterations
    solver.num_threads = num_threads
    ba.ceres.solver_options = solver
    apply_options(ba, options.bundle_adjustment, "refine.bundle_adjustment")

    config = pycolmap.BundleAdjustmentConfig()
    for image_id in metric.reg_image_ids():
        config.add_image(image_id)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.UNSPECIFIED)
    if first_pose_is_fixed:
        config.set_constant_rig_from_world_pose(int(trajectory.frame_ids[0]))
    return pycolmap.create_default_ceres_bundle_adjuster(ba, config, metric)


def _pixel_stddev(adjuster: pycolmap.CeresBundleAdjuster, num_residuals: int) -> float:
    """Stddev of a feature's coordinate from the residuals, which the parameters have already absorbed in part."""
    residuals = np.asarray(adjuster.problem.evaluate_residuals())
    spread = 1.4826 * float(np.median(np.abs(residuals)))
    degrees_of_freedom = max(num_residuals - adjuster.problem.num_parameters(), 1)
    return max(spread * float(np.sqrt(num_residuals / degrees_of_freedom)), _MIN_PIXEL_STDDEV)


def _add_ranges(
    adjuster: pycolmap.CeresBundleAdjuster,
    metric: pycolmap.Reconstruction,
    trajectory: Trajectory,
    observations: RangeObservations,
    metric_from_sfm: Similarity,
    tags_in_cam_m: Array,
    stddev_m: Array,
    loss: _ceres.LossFunction,
    blocks: _Blocks,
) -> None:
    log = observations.log
    poses = [pose_of(metric.frame(int(frame_id))).params for frame_id in trajectory.frame_ids]
    offsets = _offsets_beyond_line(trajectory, observations, metric_from_sfm, tags_in_cam_m)
    for i in np.flatnonzero(observations.has_place):
        k, before, after = log.anchor_index[i], observations.before[i], observations.after[i]
        end_blocks = [blocks.anchors[k], blocks.biases[k]]
        if before == after:
            cost = _ceres.range_cost(range_m=log.range_m[i], tag_in_cam_m=tags_in_cam_m[i], stddev_m=stddev_m[i])
            _ceres.add_residual_block(adjuster, cost, loss, [poses[before], *end_blocks])
        else:
            cost = _ceres.interpolated_range_cost(
                range_m=log.range_m[i],
                tag_in_cam_m=tags_in_cam_m[i],
                weight=observations.weight[i],
                offset_in_world_m=offsets[i],
                stddev_m=stddev_m[i],
            )
            _ceres.add_residual_block(adjuster, cost, loss, [poses[before], poses[after], *end_blocks])


def tags_in_cam_of_ranges(log: RangeLog, tag_in_cam_m: npt.ArrayLike) -> Array:
    """(n, 3) antenna that took each range, in the camera frame: of one tag (3,), or of each of the log's (num_tags, 3).

    Raises:
        ValueError: of another shape.
    """
    tags = np.asarray(tag_in_cam_m, dtype=np.float64)
    if tags.shape == (3,):
        return np.broadcast_to(tags, (len(log), 3))
    if tags.shape != (len(log.tag_ids), 3):
        raise ValueError(f"tag_in_cam_m is {tags.shape}, expected (3,) or ({len(log.tag_ids)}, 3): one for each tag")
    return tags[log.tag_index]


def _offsets_beyond_line(
    trajectory: Trajectory, observations: RangeObservations, metric_from_sfm: Similarity, tags_in_cam_m: Array
) -> Array:
    """(n, 3) what the antenna's curved path has beyond the straight line between two keyframes, metric world."""
    turns, weight = trajectory.world_from_cam, observations.weight[:, None]
    before, after = (
        np.einsum("nij,nj->ni", turns[ends], tags_in_cam_m) for ends in (observations.before, observations.after)
    )
    on_line = (1 - weight) * before + weight * after
    beyond = metric_from_sfm.scale * observations.center_offsets + observations.tag_from_center - on_line
    turned: Array = beyond @ metric_from_sfm.rotation.T
    return turned


def _add_anchor_priors(
    adjuster: pycolmap.CeresBundleAdjuster,
    metric: pycolmap.Reconstruction,
    anchors: Sequence[AnchorEstimate],
    blocks: _Blocks,
    pixel_stddev: float,
) -> None:
    """Hold, draw or free each anchor and bias that has ranges; stddevs in the unit of pixels."""
    problem = adjuster.problem
    # A point of few images for each block: one that held many ties would itself have many neighbours.
    by_track_length = heapq.nsmallest(
        2 * len(anchors), metric.points3D.items(), key=lambda item: (item[1].track.length(), item[0])
    )
    tie_points = itertools.cycle([point.xyz for _, point in by_track_length])
    for anchor, position, bias in zip(anchors, blocks.anchors, blocks.biases, strict=True):
        if not problem.has_parameter_block(position):
            continue
        priors = [
            (position, anchor.prior_position_m, np.full(3, anchor.prior_position_stddev_m)),
            (bias, np.array([anchor.prior_bias_m]), np.array([anchor.prior_bias_stddev_m])),
        ]
        for block, mean, stddev in priors:
            if stddev[0] == 0:
                problem.set_parameter_block_constant(block)
                continue
            if mean is not None:
                cost = _ceres.normal_prior_cost(mean=mean, stddev=stddev / pixel_stddev)
                _ceres.add_residual_block(adjuster, cost, None, [block])
            tie_point = next(tie_points)
            if problem.has_parameter_block(tie_point):
                tie = _ceres.zero_tie_cost(size_a=len(block), size_b=3)
                _ceres.add_residual_block(adjuster, tie, None, [block, tie_point])


def predicted_ranges(
    metric: pycolmap.Reconstruction,
    trajectory: Trajectory,
    observations: RangeObservations,
    metric_from_sfm: Similarity,
    tag_in_cam_m: npt.ArrayLike,
    anchors: Sequence[Array],
    biases: Sequence[float],
) -> Array:
    """(n,) ranges that a metric model predicts, interpolated as the residuals are; NaN without a place.

    Arguments as for ``refine_with_ranges``.
    """
    tags_in_cam = tags_in_cam_of_ranges(observations.log, tag_in_cam_m)
    times = (
        None
        if trajectory.timestamps_s is None
        else dict(zip(trajectory.image_names, trajectory.timestamps_s, strict=True))
    )
    now = trajectory_from_reconstruction(metric, times)
    weight = observations.weight[:, None]
    before, after = (
        now.centers[ends] + np.einsum("nij,nj->ni", now.world_from_cam[ends], tags_in_cam)
        for ends in (observations.before, observations.after)
    )
    at = (1 - weight) * before + weight * after
    at = at + _offsets_beyond_line(trajectory, observations, metric_from_sfm, tags_in_cam)
    index = observations.log.anchor_index
    predicted = np.linalg.norm(at - np.array(anchors)[index], axis=1) + np.array(biases)[index]
    return np.where(observations.before >= 0, predicted, np.nan)

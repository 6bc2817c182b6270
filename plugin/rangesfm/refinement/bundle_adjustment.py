"""The full problem: COLMAP's bundle adjustment, with ranges."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
import numpy.typing as npt
import pycolmap

from rangesfm import _ceres
from rangesfm.errors import SolverError
from rangesfm.options import CameraOptions, RefineOptions
from rangesfm.passthrough import apply_options
from rangesfm.ranging.anchors import AnchorEstimate
from rangesfm.ranging.observations import RangeObservations
from rangesfm.refinement.antennas import Antennas
from rangesfm.refinement.weights import RangeWeights
from rangesfm.trajectory import Trajectory, pose_of

Array = npt.NDArray[np.float64]

# Ceres' default of 1e4 damps the scale, which all poses share, so strongly that it creeps
# and is then taken for converged.
_INITIAL_TRUST_REGION_RADIUS = 1e8
_TOLERANCE = 1e-8
# No feature is located better; weighed against a smaller one, ranges lose all say in a model without noise.
_MIN_PIXEL_STDDEV = 0.05
# What is still to be gained when it stops, as a share of the smallest range stddev.
_MAX_LAST_MOVEMENT = 0.01
_MAX_NUM_TIE_POINTS = 500


@dataclass(frozen=True)
class Adjustment:
    """What one solution of the full problem did.

    Attributes:
        num_iterations: successful and not. initial_cost, final_cost: half the sum of squares, in pixels.
        reprojection_rms_px: root mean square length of the final reprojection errors.
        seconds: of the solver.
        converged: whether nothing was left to gain: started again where it had stopped, the solver moved no keyframe.
        message: the solver's own words.
        anchors: with adjusted positions and biases.
    """

    num_iterations: int
    initial_cost: float
    final_cost: float
    reprojection_rms_px: float
    seconds: float
    converged: bool
    message: str
    anchors: tuple[AnchorEstimate, ...]


@dataclass(frozen=True)
class AnchorBlocks:
    """Parameter blocks that the solver changes in place."""

    positions: list[Array]
    biases: list[Array]


@dataclass(frozen=True)
class BundleAdjustment:
    """COLMAP's own problem over all photos of a model, to which ranges can be added once.

    Attributes:
        metric: the model, adjusted in place.
        adjuster: COLMAP's.
        num_reprojections: residuals of features.
        pixel_stddev: of one coordinate of a feature, estimated from the residuals before.
        max_num_iterations: of the solver, in all.
        tie_points: blocks of 3-D points that few images see, for ``keep_from_elimination``.
    """

    metric: pycolmap.Reconstruction
    adjuster: pycolmap.CeresBundleAdjuster
    num_reprojections: int
    pixel_stddev: float
    max_num_iterations: int
    tie_points: Iterator[Array]

    def keep_from_elimination(self, block: Array) -> None:
        """Have Ceres eliminate the map's points only: its kernels are made for them, and their residuals are alike.

        It eliminates what shares residuals with few other blocks, and not two blocks that share one.
        """
        tie_point = next(self.tie_points, None)
        if tie_point is not None:
            tie = _ceres.zero_tie_cost(size_a=len(block), size_b=3)
            _ceres.add_residual_block(self.adjuster, tie, None, [block, tie_point])


def bundle_adjustment(
    metric: pycolmap.Reconstruction,
    camera: CameraOptions,
    options: RefineOptions,
    *,
    fixed_frame_id: int | None,
    max_num_iterations: int,
    num_threads: int,
    marker_ids: Collection[int] = (),
) -> BundleAdjustment:
    """Set it up, with a gauge that leaves the scale to the ranges.

    Args:
        marker_ids: 3-D points that will have other residuals than their reprojections.

    Raises:
        SolverError: nothing takes part.
        InputError: an unknown key among the options passed through.
    """
    adjuster = _bundle_adjuster(metric, camera, options, fixed_frame_id, max_num_iterations, num_threads)
    num_reprojections = adjuster.problem.num_residuals()
    if num_reprojections == 0:
        raise SolverError("no point of the model takes part in the bundle adjustment")
    pixel_stddev = _pixel_stddev(adjuster, num_reprojections)
    tie_points = _tie_points(metric, adjuster, marker_ids)
    return BundleAdjustment(metric, adjuster, num_reprojections, pixel_stddev, max_num_iterations, tie_points)


def _tie_points(
    metric: pycolmap.Reconstruction, adjuster: pycolmap.CeresBundleAdjuster, marker_ids: Collection[int]
) -> Iterator[Array]:
    """Points in turn, those of few images first: one that held many ties would itself have many neighbours."""
    by_track_length = sorted(metric.points3D.items(), key=lambda item: (item[1].track.length(), item[0]))
    own = (point.xyz for point_id, point in by_track_length if point_id not in marker_ids)
    return itertools.cycle(itertools.islice(filter(adjuster.problem.has_parameter_block, own), _MAX_NUM_TIE_POINTS))


def adjust_with_ranges(
    problem: BundleAdjustment,
    trajectory: Trajectory,
    observations: RangeObservations,
    antennas: Antennas,
    weights: RangeWeights,
    anchors: Sequence[AnchorEstimate],
    add_more: Callable[[AnchorBlocks], object],
) -> Adjustment:
    """Add the ranges and solve, in place.

    Args:
        add_more: adds further residuals, which may act on the anchors' blocks.

    Raises:
        SolverError: the solver failed.
    """
    blocks = AnchorBlocks([a.position_m.copy() for a in anchors], [np.array([a.range_bias_m]) for a in anchors])
    _add_ranges(problem, trajectory, observations, antennas, weights, blocks)
    add_more(blocks)
    _add_anchor_priors(problem, anchors, blocks)
    finest = float(np.nanmin(weights.stddev_m[observations.has_place], initial=np.inf))
    start = time.monotonic()
    summaries, is_still = _solve_until_still(problem, _MAX_LAST_MOVEMENT * finest)
    seconds = time.monotonic() - start
    reprojections = np.asarray(problem.adjuster.problem.evaluate_residuals())[: problem.num_reprojections]
    last = summaries[-1]
    return Adjustment(
        num_iterations=sum(s.num_successful_steps + s.num_unsuccessful_steps for s in summaries),
        initial_cost=summaries[0].initial_cost,
        final_cost=last.final_cost,
        reprojection_rms_px=float(np.sqrt(2 * np.mean(reprojections**2))),
        seconds=seconds,
        converged=is_still and last.termination_type.name == "CONVERGENCE",
        message=last.message,
        anchors=tuple(
            replace(anchor, position_m=position, range_bias_m=float(bias[0]))
            for anchor, position, bias in zip(anchors, blocks.positions, blocks.biases, strict=True)
        ),
    )


def _solve_until_still(problem: BundleAdjustment, tolerance_m: float) -> tuple[list[Any], bool]:
    """Solve again from where the solver stopped, with its trust region opened, until keyframes stay where they are.

    A solver whose steps have become small says that it has converged; whether it has, a free step tells.
    """
    summaries: list[Any] = []
    num_iterations, centers = 0, _centers(problem.metric)
    while True:
        summary = cast(pycolmap.CeresBundleAdjustmentSummary, problem.adjuster.solve()).ceres_summary
        if not summary.IsSolutionUsable():
            raise SolverError(f"the bundle adjustment with ranges failed: {summary.message}")
        summaries.append(summary)
        num_iterations += summary.num_successful_steps + summary.num_unsuccessful_steps
        before, centers = centers, _centers(problem.metric)
        # The first solve moves keyframes in any case, and what it moved says nothing of what is left.
        is_still = len(summaries) > 1 and bool(np.linalg.norm(centers - before, axis=1).max() <= tolerance_m)
        if is_still or num_iterations >= problem.max_num_iterations:
            return summaries, is_still


def _centers(metric: pycolmap.Reconstruction) -> Array:
    poses = [pose_of(metric.frame(frame_id)) for frame_id in metric.reg_frame_ids()]
    return np.array([-pose.rotation.matrix().T @ pose.translation for pose in poses])


def _bundle_adjuster(
    metric: pycolmap.Reconstruction,
    camera: CameraOptions,
    options: RefineOptions,
    fixed_frame_id: int | None,
    max_num_iterations: int,
    num_threads: int,
) -> pycolmap.CeresBundleAdjuster:
    ba = pycolmap.BundleAdjustmentOptions(print_summary=False)
    ba.refine_focal_length = ba.refine_extra_params = camera.refine_intrinsics is True
    solver = ba.ceres.solver_options
    solver.initial_trust_region_radius = _INITIAL_TRUST_REGION_RADIUS
    solver.function_tolerance = solver.gradient_tolerance = solver.parameter_tolerance = _TOLERANCE
    solver.max_num_iterations = max_num_iterations
    solver.num_threads = num_threads
    ba.ceres.solver_options = solver
    apply_options(ba, options.bundle_adjustment, "refine.bundle_adjustment")

    config = pycolmap.BundleAdjustmentConfig()
    for image_id in metric.reg_image_ids():
        config.add_image(image_id)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.UNSPECIFIED)
    if fixed_frame_id is not None:
        config.set_constant_rig_from_world_pose(fixed_frame_id)
    return pycolmap.create_default_ceres_bundle_adjuster(ba, config, metric)


def _pixel_stddev(adjuster: pycolmap.CeresBundleAdjuster, num_residuals: int) -> float:
    """Stddev of a feature's coordinate from the residuals, which the parameters have already absorbed in part."""
    residuals = np.asarray(adjuster.problem.evaluate_residuals())
    spread = 1.4826 * float(np.median(np.abs(residuals)))
    degrees_of_freedom = max(num_residuals - adjuster.problem.num_parameters(), 1)
    return max(spread * float(np.sqrt(num_residuals / degrees_of_freedom)), _MIN_PIXEL_STDDEV)


def _add_ranges(
    problem: BundleAdjustment,
    trajectory: Trajectory,
    observations: RangeObservations,
    antennas: Antennas,
    weights: RangeWeights,
    blocks: AnchorBlocks,
) -> None:
    """Ranges in units of pixels: one stddev of either weighs the same."""
    log, adjuster = observations.log, problem.adjuster
    stddev = weights.weighted_m / problem.pixel_stddev
    loss = _ceres.cauchy_loss(weights.loss_scale * problem.pixel_stddev / weights.inflation)
    poses = [pose_of(problem.metric.frame(int(frame_id))).params for frame_id in trajectory.frame_ids]
    for i in np.flatnonzero(observations.has_place):
        k, before, after = log.anchor_index[i], antennas.before[i], antennas.after[i]
        end_blocks = [blocks.positions[k], blocks.biases[k]]
        if before == after:
            cost = _ceres.range_cost(range_m=log.range_m[i], tag_in_cam_m=antennas.tag_in_cam_m[i], stddev_m=stddev[i])
            _ceres.add_residual_block(adjuster, cost, loss, [poses[before], *end_blocks])
        else:
            cost = _ceres.interpolated_range_cost(
                range_m=log.range_m[i],
                tag_in_cam_m=antennas.tag_in_cam_m[i],
                weight=antennas.weight[i],
                offset_in_world_m=antennas.offset_in_world_m[i],
                stddev_m=stddev[i],
            )
            _ceres.add_residual_block(adjuster, cost, loss, [poses[before], poses[after], *end_blocks])


def _add_anchor_priors(
    bundle: BundleAdjustment,
    anchors: Sequence[AnchorEstimate],
    blocks: AnchorBlocks,
) -> None:
    """Hold, draw or free each anchor and bias that has ranges; stddevs in the unit of pixels."""
    problem, adjuster = bundle.adjuster.problem, bundle.adjuster
    for anchor, position, bias in zip(anchors, blocks.positions, blocks.biases, strict=True):
        priors = [
            (position, anchor.prior_position_m, np.full(3, anchor.prior_position_stddev_m)),
            (bias, np.array([anchor.prior_bias_m]), np.array([anchor.prior_bias_stddev_m])),
        ]
        for block, mean, stddev in priors:
            if not problem.has_parameter_block(block):
                continue
            if stddev[0] == 0:
                problem.set_parameter_block_constant(block)
                continue
            if mean is not None:
                cost = _ceres.normal_prior_cost(mean=mean, stddev=stddev / bundle.pixel_stddev)
                _ceres.add_residual_block(adjuster, cost, None, [block])
            bundle.keep_from_elimination(block)

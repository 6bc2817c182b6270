"""Bundle adjustment of all photos by COLMAP, to which ranges can be added, and the test for its convergence."""

from __future__ import annotations

import itertools
import time
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from copy import copy
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pycolmap

from rangesfm import solver
from rangesfm.arrays import Array
from rangesfm.colmap.passthrough import apply_options
from rangesfm.colmap.pieces import overlaps_in
from rangesfm.errors import SolverError
from rangesfm.options import CameraOptions, RefineOptions
from rangesfm.solver.linear_solver import dense_is_faster, inverse_is_affordable, max_num_images_direct
from rangesfm.util.geometry.numerics import NEGLIGIBLE_STDDEVS, ROUNDING
from rangesfm.util.geometry.poses import model_poses
from rangesfm.util.geometry.robust_statistics import cost_of_deviation, robust_stddev
from rangesfm.util.geometry.trajectory import pose_of

# Ceres' default of 1e4 damps the scale, which all poses share, so strongly that it changes slowly and seems converged.
# 1e8 does the same to the bending of a path of 2000 keyframes.
_INITIAL_TRUST_REGION_RADIUS = 1e10
# One thread is used for any number of residuals. Several threads would add them in the order in which they finish, so
# that the same command gives other last digits each time; with a million residuals they save hardly any time.
_MIN_NUM_RESIDUALS_FOR_THREADS = np.iinfo(np.int32).max
# No feature is located more precisely. With a smaller value, ranges would have no weight in a model without noise.
_MIN_PIXEL_STDDEV = 0.05
_MAX_NUM_TIE_POINTS = 500
# A step with a trust region of at least this radius counts as free, that is not damped.
_FREE_TRUST_REGION_RADIUS = 1e8
# Expected decrease of half the sum of squares (in standard deviations) below which the minimum is reached: then no
# quantity of the map differs noticeably from its value there.
_MAX_GAIN_LEFT = cost_of_deviation(NEGLIGIBLE_STDDEVS)
# In the same unit: decrease that a free step promised and that no step achieved.
_MAX_PROMISE_LEFT = 0.5
# Largest relative decrease of the cost by the last step; with more, the cost is still falling by orders of magnitude.
_MAX_LAST_GAIN = 1e-4
# Smallest and largest sum of the steps to come, in units of the last one.
_NUM_STEPS_LEFT = (0.1, 10.0)
# Largest number of photos, all overlapping, with a covariance: it takes a minute, that of twice as many ten minutes.
_MAX_NUM_IMAGES_FOR_COVARIANCE = 1500


@dataclass(frozen=True)
class SolverRun:
    """Result of a run of the solver, or of several one after the other.

    Attributes:
        num_iterations: successful and unsuccessful ones.
        initial_cost, final_cost: half the sum of squares, in pixels at unit weight: at the start with the weights at
            that time, and at the end.
        seconds: time of the solver.
        converged: whether it stopped by itself at the end, and of a whole refinement with the keyframes at rest.
        is_still: whether the keyframes came to rest in free steps.
        is_stuck: whether free steps still promise a decrease that matters, but none of them succeeds.
        message: of the solver.
        pixel_stddev: as of the bundle adjustment.
        reprojection_rms_px: root mean square length of the reprojection errors at the end.
    """

    num_iterations: int
    initial_cost: float
    final_cost: float
    seconds: float
    converged: bool
    is_still: bool
    is_stuck: bool
    message: str
    pixel_stddev: float
    reprojection_rms_px: float

    def then(self, later: SolverRun) -> SolverRun:
        """Return this run and a later one as one."""
        return replace(
            later,
            num_iterations=self.num_iterations + later.num_iterations,
            initial_cost=self.initial_cost,
            seconds=self.seconds + later.seconds,
        )


@dataclass(frozen=True)
class BundleAdjustment:
    """COLMAP's problem of all photos of a model. Ranges can be added to it once.

    Attributes:
        metric: the model, adjusted in place.
        adjuster: COLMAP's own.
        num_reprojections: number of residuals of features, two per observation.
        pixel_stddev: standard deviation of a feature's coordinate, pixels, from the residuals before the solution.
        tie_points: parameter blocks of 3-D points with short tracks, for ``keep_from_elimination``.
    """

    metric: pycolmap.Reconstruction
    adjuster: pycolmap.CeresBundleAdjuster
    num_reprojections: int
    pixel_stddev: float
    tie_points: Iterator[Array]

    @property
    def reprojection_rms_px(self) -> float:
        """Root mean square of the current lengths of reprojection errors, in pixels."""
        residuals = np.asarray(self.adjuster.problem.evaluate_residuals())[: self.num_reprojections]
        return float(np.sqrt(2 * np.mean(residuals**2)))

    @property
    def has_covariance(self) -> bool:
        """Return whether the photos are few enough, or overlap little enough, for a covariance of all."""
        limit = _MAX_NUM_IMAGES_FOR_COVARIANCE
        return self.metric.num_reg_images() <= limit or inverse_is_affordable(overlaps_in(self.metric), limit)

    @property
    def refined_params(self) -> dict[int, list[int]]:
        """Return which parameters of each camera are adjusted, where they are not constant, by the camera's id."""
        options = self.adjuster.options
        return {
            camera_id: sorted(
                [
                    *(camera.focal_length_idxs() if options.refine_focal_length else ()),
                    *(camera.principal_point_idxs() if options.refine_principal_point else ()),
                    *(camera.extra_params_idxs() if options.refine_extra_params else ()),
                ]
            )
            for camera_id, camera in self.metric.cameras.items()
        }

    def keep_from_elimination(self, block: Array) -> None:
        """Make Ceres eliminate only the map's points; see ``solver.keep_from_elimination``."""
        tie_point = next(self.tie_points, None)
        if tie_point is not None:
            solver.keep_from_elimination(self.adjuster, block, tie_point)


def bundle_adjustment(
    metric: pycolmap.Reconstruction,
    camera: CameraOptions,
    options: RefineOptions,
    *,
    num_threads: int,
    fixed_frame_ids: Collection[int] = (),
    marker_ids: Collection[int] = (),
    left_out_ids: Collection[int] = (),
) -> BundleAdjustment:
    """Set up the bundle adjustment, with a gauge that leaves the scale free for the ranges.

    Args:
        fixed_frame_ids: of the frames whose poses are held.
        marker_ids: 3-D points that must not serve as tie points, as other residuals are added to them.
        left_out_ids: 3-D points that do not take part and keep their positions.

    Raises:
        SolverError: no point takes part.
        InputError: an option passed through to COLMAP is unknown.
    """
    with _without_points(metric, left_out_ids):
        adjuster = _bundle_adjuster(metric, camera, options, fixed_frame_ids, num_threads)
    num_reprojections = adjuster.problem.num_residuals()
    if num_reprojections == 0:
        raise SolverError("no point of the model takes part in the bundle adjustment")
    pixel_stddev = pixel_stddev_of(adjuster, num_reprojections)
    tie_points = _tie_points(metric, adjuster, marker_ids)
    return BundleAdjustment(metric, adjuster, num_reprojections, pixel_stddev, tie_points)


@contextmanager
def _without_points(metric: pycolmap.Reconstruction, point_ids: Collection[int]) -> Iterator[None]:
    """Take some points out of a model inside the block.

    To remove a point from a finished problem takes Ceres as long as to go through the whole problem.
    """
    points = {point_id: copy(metric.point3D(point_id)) for point_id in point_ids}
    for point_id in points:
        metric.delete_point3D(point_id)
    try:
        yield
    finally:
        for point_id, point in points.items():
            metric.add_point3D_with_id(point_id, point)
            for element in point.track.elements:
                metric.image(element.image_id).set_point3D_for_point2D(element.point2D_idx, point_id)


def _tie_points(
    metric: pycolmap.Reconstruction, adjuster: pycolmap.CeresBundleAdjuster, marker_ids: Collection[int]
) -> Iterator[Array]:
    """Yield points in turn, those with short tracks first: a point with many ties would have many neighbours itself."""
    by_track_length = sorted(metric.points3D.items(), key=lambda item: (item[1].track.length(), item[0]))
    own = (point.xyz for point_id, point in by_track_length if point_id not in marker_ids)
    return itertools.cycle(itertools.islice(filter(adjuster.problem.has_parameter_block, own), _MAX_NUM_TIE_POINTS))


def solve_bundle_adjustment(problem: BundleAdjustment, tolerance_m: float) -> SolverRun:
    """Solve in place until the keyframes come to rest.

    The cost alone is no measure of this. A millionth of it may still move a map by metres, while points near the
    horizon may move on forever without any other change.

    Args:
        tolerance_m: largest movement that a keyframe may still have to go.

    Raises:
        SolverError: the solver failed.
    """
    start = time.monotonic()
    monitor = ConvergenceMonitor(problem.metric, problem.pixel_stddev, tolerance_m)
    summary = solver.solve_adjuster(problem.adjuster, monitor.is_over)
    if not summary.IsSolutionUsable():
        raise SolverError(f"the bundle adjustment with ranges failed: {summary.message}")
    return SolverRun(
        num_iterations=summary.num_successful_steps + summary.num_unsuccessful_steps,
        initial_cost=summary.initial_cost,
        final_cost=summary.final_cost,
        seconds=time.monotonic() - start,
        converged=summary.termination_type.name in ("CONVERGENCE", "USER_SUCCESS"),
        is_still=monitor.is_still,
        is_stuck=monitor.is_stuck,
        message=_message(monitor, tolerance_m, summary),
        pixel_stddev=problem.pixel_stddev,
        reprojection_rms_px=problem.reprojection_rms_px,
    )


def _message(monitor: ConvergenceMonitor, tolerance_m: float, summary: Any) -> str:
    if monitor.is_still:
        return f"Converged: further steps would move the keyframes by less than {tolerance_m:.2g} m."
    if monitor.is_stuck:
        return "Some points or the lens allow only small steps, too small to reach the best map."
    if summary.termination_type.name == "USER_SUCCESS":
        return "The last steps were kept small, so that the keyframes may have farther to go."
    return str(summary.message)


def solve_until_still(problem: BundleAdjustment, before: SolverRun, tolerance_m: float, num_left: int) -> SolverRun:
    """Solve again from where the solver stopped, with a wide trust region, until the keyframes come to rest.

    A solver whose steps have become small reports convergence; only a free step shows whether that is true. Steps are
    often kept small by an unknown anchor far from where the ranges put it, so the radio's parameters are solved for
    first, with the map held fixed.

    Args:
        before: the run so far. num_left: largest number of further iterations.

    Returns:
        the whole run, which has converged if the keyframes came to rest at a minimum.
    """
    run, is_over, centers = before, before.is_still, keyframe_centers(problem.metric)
    while not is_over and num_left > 0:
        _settle_radio(problem)
        found = solve_bundle_adjustment(problem, tolerance_m)
        num_left -= max(found.num_iterations, 1)
        last, centers = centers, keyframe_centers(problem.metric)
        is_at_rest = farthest(last, centers) <= tolerance_m
        is_over = found.is_still or is_at_rest
        run = run.then(replace(found, is_still=is_over and (found.is_still or not found.is_stuck)))
    return replace(run, converged=run.converged and run.is_still)


def _settle_radio(problem: BundleAdjustment) -> None:
    """Solve for the parameters that are not of the map, with the map held fixed."""
    metric, ceres_problem = problem.metric, problem.adjuster.problem
    blocks = [pose_of(metric.frame(frame_id)).params for frame_id in metric.reg_frame_ids()]
    blocks += [pose.params for rig in metric.rigs.values() for pose in rig.non_ref_sensors.values() if pose is not None]
    blocks += [camera.params for camera in metric.cameras.values()]
    blocks += [point.xyz for point in metric.points3D.values()]
    held = [
        b for b in blocks if ceres_problem.has_parameter_block(b) and not ceres_problem.is_parameter_block_constant(b)
    ]
    for block in held:
        ceres_problem.set_parameter_block_constant(block)
    solver.solve_adjuster(problem.adjuster, lambda _: False)
    for block in held:
        ceres_problem.set_parameter_block_variable(block)


def _bundle_adjuster(
    metric: pycolmap.Reconstruction,
    camera: CameraOptions,
    options: RefineOptions,
    fixed_frame_ids: Collection[int],
    num_threads: int,
) -> pycolmap.CeresBundleAdjuster:
    ba = pycolmap.BundleAdjustmentOptions(print_summary=False)
    refines = [table.refinement_refines_intrinsics for table in camera.tables]
    ba.refine_focal_length = ba.refine_extra_params = any(refines)
    solver = ba.ceres.solver_options
    solver.initial_trust_region_radius = _INITIAL_TRUST_REGION_RADIUS
    solver.function_tolerance = ROUNDING  # convergence is judged by the keyframes, not by the cost
    # These tolerances compare steps with all parameters, and points near the horizon may be millions of metres away.
    solver.gradient_tolerance = solver.parameter_tolerance = 0.0
    solver.max_num_iterations = options.max_num_iterations
    solver.num_threads = num_threads
    ba.ceres.solver_options = solver
    ba.ceres.min_num_residuals_for_cpu_multi_threading = int(_MIN_NUM_RESIDUALS_FOR_THREADS)
    num = metric.num_reg_images()
    if num > ba.ceres.max_num_images_direct_dense_cpu_solver:
        overlaps, limit = overlaps_in(metric), ba.ceres.max_num_images_direct_sparse_cpu_solver
        ba.ceres.max_num_images_direct_sparse_cpu_solver = limit = max_num_images_direct(overlaps, limit)
        if num < limit and dense_is_faster(overlaps):  # COLMAP requires this order of the limits
            ba.ceres.max_num_images_direct_dense_cpu_solver = num
    apply_options(ba, options.bundle_adjustment, "refine.bundle_adjustment")

    config = pycolmap.BundleAdjustmentConfig()
    for image_id in metric.reg_image_ids():
        config.add_image(image_id)
        image = metric.image(image_id)
        if any(refines) and not camera.of_photo(image.name).refinement_refines_intrinsics:
            config.set_constant_cam_intrinsics(image.camera_id)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.UNSPECIFIED)
    for frame_id in fixed_frame_ids:
        config.set_constant_rig_from_world_pose(frame_id)
    return pycolmap.create_default_ceres_bundle_adjuster(ba, config, metric)


def pixel_stddev_of(adjuster: pycolmap.CeresBundleAdjuster, num_reprojections: int) -> float:
    """Estimate the standard deviation of a feature's coordinate; parameters have absorbed a part of the residuals."""
    residuals = np.asarray(adjuster.problem.evaluate_residuals())[:num_reprojections]
    degrees_of_freedom = max(num_reprojections - adjuster.problem.num_parameters(), 1)
    return max(robust_stddev(residuals) * float(np.sqrt(num_reprojections / degrees_of_freedom)), _MIN_PIXEL_STDDEV)


class ConvergenceMonitor:
    """Test for convergence by the movement of the keyframes and the decrease of the cost.

    Attributes:
        is_still: whether the keyframes have come to rest in free steps.
    """

    def __init__(self, metric: pycolmap.Reconstruction, residual_stddev: float, tolerance_m: float) -> None:
        self.is_still = False
        self._metric, self._residual_stddev, self._tolerance_m = metric, residual_stddev, tolerance_m
        self._centers = keyframe_centers(metric)
        self._last_m = self._last_gain = self._promise = 0.0

    @property
    def is_stuck(self) -> bool:
        """True if a free step promised, to first order, a decrease that matters, and later steps did not achieve it."""
        return self._promise > _MAX_PROMISE_LEFT

    def is_over(self, step: solver.Step) -> bool:
        """Return True if the solver should stop: the keyframes or the cost have come to rest.

        The steps to come are taken to shrink by the same factor as this one did, as Gauss-Newton steps finally do. Rest
        of one of the two is enough: a long path may bend by metres at almost no cost, and a weak map may sway by
        centimetres at as little.
        """
        if step.trust_region_radius >= _FREE_TRUST_REGION_RADIUS:
            self._promise = step.expected_gain / self._residual_stddev**2
        if not step.is_successful:
            self._last_m = self._last_gain = 0.0
            return False
        before, self._centers = self._centers, keyframe_centers(self._metric)
        moved_m, gain = farthest(before, self._centers), step.gain / self._residual_stddev**2
        is_still = still_to_come(moved_m, self._last_m) <= self._tolerance_m
        is_near = is_still or still_to_come(gain, self._last_gain) <= _MAX_GAIN_LEFT
        self._last_m, self._last_gain = moved_m, gain
        self._promise -= gain
        is_over = is_near and step.gain <= _MAX_LAST_GAIN * step.cost
        self.is_still = is_over and step.trust_region_radius >= _FREE_TRUST_REGION_RADIUS
        return is_over


def still_to_come(now: float, last: float) -> float:
    """Return the sum of the remaining steps if they shrink geometrically by the ratio of the last two."""
    num = now / (last - now) if now < last else np.inf
    return now * float(np.clip(num, *_NUM_STEPS_LEFT))


def farthest(before: Array, after: Array) -> float:
    """Return the distance of the point that moved most."""
    return float(np.linalg.norm(after - before, axis=1).max())


def keyframe_centers(metric: pycolmap.Reconstruction) -> Array:
    """Return the (n, 3) origins of the rig frames in the world."""
    return model_poses(metric, metric.reg_frame_ids()).centers

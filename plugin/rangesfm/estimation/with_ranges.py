"""Bundle adjustment by COLMAP with ranges, which fixes the scale and removes drift: the stage as one function."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy.typing as npt
import pycolmap

from rangesfm.arrays import Array
from rangesfm.distances.tape import Tape
from rangesfm.estimation.map_problem import map_problem
from rangesfm.estimation.refine_summary import RefineSummary, summarize
from rangesfm.estimation.refinement import joint_errors, refine
from rangesfm.geometry.gravity import Gravity
from rangesfm.geometry.similarity import Similarity
from rangesfm.geometry.trajectory import Trajectory
from rangesfm.measurements.table import Measured, TapedLengths, Upwards, ranges_of_map
from rangesfm.options import CameraOptions, RefineOptions
from rangesfm.processes.threads import at_most, with_one_blas_thread
from rangesfm.ranging.anchors.anchor import AnchorEstimate
from rangesfm.ranging.errors.range_errors import RangeErrors
from rangesfm.ranging.range_observations import RangeObservations


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
    shared_errors_m: Array | None = None,
    is_refined: bool = False,
    num_threads: int = -1,
) -> tuple[pycolmap.Reconstruction, RefineSummary]:
    """Refine a scaled model by bundle adjustment with range residuals.

    Misplaced points, as wrong matches make them, do not take part.

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
        shared_errors_m: (n, k) errors that the log's ranges share, for k independent standard deviations, which all
            other measurements may correct; None without any.
        is_refined: whether the model was refined with these ranges before. It stays where it is if nothing is new.

    Returns:
        the refined model and the summary.

    Raises:
        SolverError: the solver failed.
        InputError: an option passed through to COLMAP is unknown, a clock offset is to be estimated without times, or
            the end of a distance is not in the model.
    """
    options = options or RefineOptions()
    metric = pycolmap.Reconstruction(reconstruction)
    ranges = ranges_of_map(trajectory, observations, metric_from_sfm, tag_in_cam_m, anchors, errors, options)
    if shared_errors_m is not None:
        ranges = replace(ranges, shared_errors_m=shared_errors_m)
    upwards = () if first_pose_is_fixed or gravity is None else (Upwards(gravity),)
    measured = Measured(ranges, (TapedLengths(tape or Tape()), *upwards))
    with at_most(num_threads):
        problem = map_problem(
            metric,
            measured,
            trajectory,
            camera=camera or CameraOptions(),
            options=options,
            first_pose_is_fixed=first_pose_is_fixed,
            is_refined=is_refined,
            num_threads=num_threads,
        )
        rest = refine(problem, measured.markers)
        covariance = joint_errors(rest, 1.0) if options.covariance else None
    return metric, summarize(rest, ranges, covariance, 1.0)

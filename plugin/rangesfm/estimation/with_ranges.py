"""Bundle adjustment by COLMAP with ranges, which fixes the scale and removes drift, as one function, with a summary."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import pycolmap

from rangesfm.arrays import Array
from rangesfm.estimation.map_problem import map_problem
from rangesfm.estimation.refinement import MapAtRest, joint_errors, refine
from rangesfm.measurements.gravity import UpwardDirection
from rangesfm.measurements.kind import Doubt, MapState
from rangesfm.measurements.lengths.cost import taped_lengths
from rangesfm.measurements.lengths.tape import Tape
from rangesfm.measurements.points import NamedPoints
from rangesfm.measurements.ranges.anchors.anchor import AnchorEstimate
from rangesfm.measurements.ranges.cost import CLOCK, SHORT, anchors_at
from rangesfm.measurements.ranges.errors.range_errors import RangeErrors
from rangesfm.measurements.ranges.radio import measured_by_radio, ranges_of, ranges_of_map
from rangesfm.measurements.ranges.range_observations import RangeObservations, status_by_weight
from rangesfm.options import CameraOptions, RefineOptions
from rangesfm.solver.bundle_adjustment import SolverRun
from rangesfm.util.geometry.gravity import Gravity
from rangesfm.util.geometry.map_errors import UNKNOWN_ERRORS, MapErrors
from rangesfm.util.geometry.similarity import IDENTITY, Similarity
from rangesfm.util.geometry.trajectory import Trajectory
from rangesfm.util.processes.threads import at_most, with_one_blas_thread

if TYPE_CHECKING:
    from typing_extensions import Self


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
    camera: CameraOptions = CameraOptions(),
    options: RefineOptions = RefineOptions(),
    tape: Tape = Tape(),
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
    metric = pycolmap.Reconstruction(reconstruction)
    ranges = ranges_of_map(trajectory, observations, metric_from_sfm, tag_in_cam_m, anchors, errors, options)
    if shared_errors_m is not None:
        ranges = replace(ranges, shared_errors_m=shared_errors_m)
    markers = tape.control().end_markers
    points = NamedPoints.in_model(metric, markers, ranges.placed_anchors, trajectory.frame_ids)
    upward = () if first_pose_is_fixed or gravity is None else (UpwardDirection(gravity),)
    with at_most(num_threads):
        problem = map_problem(
            metric,
            (*measured_by_radio(ranges, points), *taped_lengths(tape, points), *upward),
            trajectory,
            camera=camera,
            options=options,
            first_pose_is_fixed=first_pose_is_fixed,
            is_refined=is_refined,
            num_threads=num_threads,
        )
        rest = refine(problem)
        covariance = joint_errors(rest, 1.0) if options.covariance else UNKNOWN_ERRORS
    return metric, summarize(rest, covariance)


@dataclass(frozen=True)
class RangesInMap:
    """The n ranges of a log as a metric map has them, scaled or refined.

    Attributes:
        observations: with status by the weight of each range.
        errors: of all ranges, as weighted.
        anchors: positions and biases, with standard deviations; of a refined map these need its covariance.
        predicted_m: (n,) ranges predicted by the map; NaN without a place.
        tags_in_cam_m: (num_tags, 3) lever arms, as given or estimated.
        time_shift_s: how much later than assumed the ranges were taken; None if not estimated.
        short_range_error_m: amplitude of the excess of short ranges, which decays with a length of 1 m; None if not
            estimated.
    """

    observations: RangeObservations
    errors: RangeErrors
    anchors: tuple[AnchorEstimate, ...]
    predicted_m: Array
    tags_in_cam_m: Array
    time_shift_s: float | None = None
    short_range_error_m: float | None = None

    @property
    def residuals_m(self) -> Array:
        """(n,) predicted minus measured ranges, metres; NaN without a place."""
        return self.predicted_m - self.observations.log.range_m

    @property
    def weights(self) -> Array:
        """(n,) robust weights in [0, 1]; NaN without a place."""
        return self.errors.robust_weights(self.residuals_m)


@dataclass(frozen=True, kw_only=True)
class RefineSummary(SolverRun):
    """Result of the refinement: the whole run of the solver on the full problem, and what it led to.

    Attributes:
        num_graph_steps: of the solver on the keyframe graph before.
        bend_m: root mean square bending of the map in the keyframe graph, beyond any similarity.
        misfits: reasons why the ranges fit worse than their noise suggests; empty if they do not.
        ranges: as the refined map has them.
        covariance: how poses, cameras and anchors err together; not known if not asked for, if the model is too large,
            or if ranges and photos leave something undetermined.
    """

    num_graph_steps: int
    bend_m: float
    misfits: tuple[Doubt, ...]
    ranges: RangesInMap
    covariance: MapErrors

    def with_anchors(self, anchors: tuple[AnchorEstimate, ...]) -> Self:
        """Return the summary with others of the anchors."""
        return replace(self, ranges=replace(self.ranges, anchors=anchors))

    def __repr__(self) -> str:
        """Return what the refinement did on one line."""
        ended = "converged" if self.converged else "not converged"
        return f"<refinement of {self.num_iterations} iterations, {ended}, {self.reprojection_rms_px:.2f} px>"


def summarize(rest: MapAtRest, covariance: MapErrors) -> RefineSummary:
    """Summarise a refinement, given the map at rest and its covariance."""
    return RefineSummary(
        **vars(rest.run),
        num_graph_steps=rest.num_graph_steps,
        bend_m=rest.bend_m,
        misfits=ranges_of(rest.problem.measured).misfits(rest.state),
        ranges=refined_ranges(rest, rest.state, covariance),
        covariance=covariance,
    )


def refined_ranges(
    rest: MapAtRest, state: MapState, covariance: MapErrors, moved: Similarity = IDENTITY
) -> RangesInMap:
    """Return the ranges of a log as a map has them that was at rest.

    Args:
        rest: the map at rest. state: of the map. covariance: as in the summary.
        moved: from the world of the map at rest to that of the map.
    """
    ranges = ranges_of(rest.problem.measured)
    anchors = tuple(anchor.mirror_moved(moved) for anchor in ranges.anchors)
    rows, log = ranges.rows, ranges.observations.log
    state = replace(state, blocks={**ranges.blocks, **state.blocks})
    predicted_m, status = ranges.predicted_m(state), ranges.observations.status.copy()
    status[rows] = status_by_weight(ranges.errors.robust_weights((predicted_m - log.range_m)[rows]))
    return RangesInMap(
        observations=replace(ranges.observations, status=status),
        errors=ranges.errors.spread(rows, len(log)),
        anchors=_with_stddevs(anchors_at(anchors, state.blocks), covariance),
        predicted_m=predicted_m,
        tags_in_cam_m=ranges.arms_m(state),
        time_shift_s=ranges.estimated(state, CLOCK),
        short_range_error_m=ranges.estimated(state, SHORT),
    )


def _with_stddevs(anchors: tuple[AnchorEstimate, ...], covariance: MapErrors) -> tuple[AnchorEstimate, ...]:
    if "anchor" not in covariance.parts:
        return anchors
    variances = np.trace(covariance.covariances("anchor"), axis1=1, axis2=2) / 3
    variance_of = dict(zip(covariance.parts["anchor"].ids, variances.tolist(), strict=True))
    return tuple(
        replace(anchor, position_stddev_m=float(np.sqrt(variance_of[anchor.anchor_id])))
        if anchor.anchor_id in variance_of and np.isfinite(anchor.position_m).all()
        else anchor
        for anchor in anchors
    )

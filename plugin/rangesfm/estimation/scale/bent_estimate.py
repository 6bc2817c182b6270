"""The estimate of a drifting path of poses where its ranges bend it."""

from __future__ import annotations

from dataclasses import replace

from rangesfm.estimation.scale.scale_estimate import ScaleEstimate
from rangesfm.estimation.scale.scale_verdict import judge
from rangesfm.measurements.ranges.mistakes.bent_path import bends_m, drifts
from rangesfm.measurements.ranges.mistakes.linearized import RangesOnMap, linearized
from rangesfm.measurements.ranges.range_observations import status_by_weight
from rangesfm.measurements.ranges.scale.doubts import doubts_of_ranges, remarks_on_anchors
from rangesfm.measurements.ranges.scale.range_scale import RangeScale
from rangesfm.options import ScaleOptions
from rangesfm.solver.posterior import Posterior
from rangesfm.util.geometry.similarity import rmse


def estimate_by_bent(estimate: ScaleEstimate, on_map: RangesOnMap, options: ScaleOptions) -> ScaleEstimate:
    """Return the estimate with the similarity that brings the path nearest to where the ranges bend it.

    The estimate is returned unchanged if the bending is smaller than the scatter of the ranges, as a rigid path then
    fits as well.

    Args:
        estimate: of the path as one piece. on_map: the path bent to the ranges.

    Raises:
        GeometryError: refused, because the scale is less certain than ``options.max_relative_stddev`` allows.
    """
    ranges, bent_by_m = estimate.find(RangeScale), bends_m(on_map)
    if ranges is None or not len(bent_by_m):
        return estimate
    posed, solution = ranges.posed, ranges.solution
    problem = linearized(on_map).with_learnt_errors()
    if not drifts(problem):
        return estimate
    known = Posterior.best(problem, problem.errors, estimate.uncertainty.formal)
    uncertainty, state = known.uncertainty, on_map.state
    fit = replace(solution.fit, state=state, weights=problem.bins.robust_weight)
    bent = replace(solution, fit=fit)
    doubts, remarks = doubts_of_ranges(posed, bent, uncertainty, {}), remarks_on_anchors(bent, estimate.anchors)
    judged = judge(doubts, remarks, uncertainty, options)
    positions = zip(estimate.anchors, state.anchors_m, strict=True)
    drift = f"the path drifts by {rmse(bent_by_m[:, None]):.2g} m (root mean square) from where the ranges have it"
    status, stddev_m = estimate.observations.status.copy(), estimate.errors.stddev_m.copy()
    status[posed.rows] = status_by_weight(problem.bins.robust_weight)
    stddev_m[posed.rows] = problem.scatter_m
    return estimate.judged(
        replace(judged, reasons=(*judged.reasons, drift)),
        metric_from_sfm=state.metric_from_model @ posed.first_camera_from_sfm,
        uncertainty=uncertainty,
        placement=known.placement,
        ranges=replace(
            estimate.ranges,
            observations=replace(estimate.observations, status=status),
            errors=replace(estimate.errors, stddev_m=stddev_m),
            anchors=tuple(replace(anchor, position_m=at) for anchor, at in positions),
        ),
    )

"""Adoption of the likeliest mistake: the survey is solved again with this mistake corrected."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rangesfm.arrays import Array, Indices
from rangesfm.errors import GeometryError, number_text
from rangesfm.measurements.ranges.range_observations import RangeObservations, RangeStatus
from rangesfm.pipeline.make_metric_map import metric_map
from rangesfm.pipeline.metric_result import MetricResult
from rangesfm.survey.survey_run import PathOfModel, SurveyRun


def with_likeliest_cause(run: SurveyRun, path: PathOfModel, metric: MetricResult) -> tuple[SurveyRun, MetricResult]:
    """Correct the likeliest mistake and make the map again; return the run and the map unchanged if none was found.

    The verdict on the new map is doubtful, with the change as a reason. Of two mistakes that the ranges hardly tell
    apart the likelier one is corrected, too; the user has asked for it and is told.
    """
    if not metric.diagnosis.causes:
        return run, metric
    if metric.models:
        run.journal.warn("no mistake is corrected: the map is joined from several models")
        return run, metric
    cause = metric.diagnosis.causes[0]
    inputs, log, correction = run.inputs, run.inputs.log, cause.correction
    known = {anchor.anchor_id: anchor.position_m for anchor in inputs.anchors} | {**correction.anchors_m}
    anchors = tuple(replace(anchor, position_m=known[anchor.anchor_id]) for anchor in inputs.anchors)
    moves = np.array([correction.tag_moves_m.get(tag, np.zeros(3)) for tag in log.tag_ids]).reshape(-1, 3)
    if correction.longer_m is not None:
        log = replace(log, range_m=log.range_m - _spread(correction.longer_m, metric.diagnosis.rows, len(log)))
    inputs = replace(inputs, anchors=anchors, tag_in_cam_m=inputs.tag_in_cam_m + moves, log=log)
    corrected = replace(run, inputs=inputs)
    try:
        moved = replace(path, observations=_observations(corrected, path, metric))
        is_refined = metric.refined is not None
        adopted = metric_map(corrected, moved, refine=is_refined)
    except GeometryError as error:
        run.journal.warn(f"no mistake is corrected, because the corrected survey fails: {error}")
        return run, metric
    change = number_text(100 * (adopted.estimate.value / metric.estimate.value - 1), "+.2f")
    said = f"adopted: {cause.words}; the scale changed by {change} %, from {metric.estimate.value:.6g}"
    run.journal.warn(said)
    return corrected, adopted.doubted((said,))


def _observations(run: SurveyRun, path: PathOfModel, metric: MetricResult) -> RangeObservations:
    """Return the corrected ranges on the path. Ranges that the correction leaves out get the status of check ranges."""
    correction, rows = metric.diagnosis.causes[0].correction, metric.diagnosis.rows
    log, offset, known_s = run.inputs.log, metric.time_offset, metric.time_offset_s or 0.0
    shift_s = _spread(np.broadcast_to(correction.time_shift_s, len(rows)), rows, len(log))
    offset_s = shift_s + (known_s if offset is None or log.timestamp_s is None else offset.at(log.timestamp_s))
    observations = run.ranges_on(path.trajectory, offset_s)
    if correction.left_out is None:
        return observations
    status = observations.status.copy()
    status[rows[correction.left_out]] = RangeStatus.CHECK
    return replace(observations, status=status)


def _spread(values: Array, rows: Indices, num: int) -> Array:
    """Return an array (num,) with the values (k,) at the given rows (k,), and 0 elsewhere."""
    spread = np.zeros(num)
    spread[rows] = values
    return spread

"""Adaptation: a survey run again as if the likeliest cause of what does not fit were so."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rangesfm.arrays import Array, Indices
from rangesfm.errors import GeometryError
from rangesfm.join.models import PathOfModel
from rangesfm.progress import Journal
from rangesfm.ranging.observations import RangeObservations, RangeStatus
from rangesfm.result.metric_result import MetricResult
from rangesfm.survey.inputs import RangingInputs
from rangesfm.survey.settings import Survey
from rangesfm.trust.hypothesis import Correction
from rangesfm.trust.verdict import TrustVerdict
from rangesfm.workflows.metric_map import metric_map, ranges_on_path


def with_likeliest_cause(
    survey: Survey, inputs: RangingInputs, path: PathOfModel, metric: MetricResult, journal: Journal
) -> tuple[RangingInputs, MetricResult]:
    """The map again from corrected inputs, with what changed as a reason to doubt it; the same if nothing was found.

    What is told apart no better than by the likelier of two is adopted all the same: who asks for it has been told.
    """
    if metric.trust is None or not metric.trust.causes:
        return inputs, metric
    if metric.models:
        journal.warn("nothing is adopted: the map is joined from several models")
        return inputs, metric
    cause = metric.trust.causes[0]
    corrected = _corrected_inputs(inputs, cause.correction, metric.trust.rows)
    try:
        moved = replace(path, observations=_observations(survey, corrected, path, metric, metric.trust))
        is_refined = metric.refined is not None
        adopted = metric_map(survey, corrected, moved, metric.time_offset, journal, refine=is_refined)
    except GeometryError as error:
        journal.warn(f"nothing is adopted, as with that {error}")
        return inputs, metric
    change = 100 * (adopted.estimate.value / metric.estimate.value - 1)
    said = f"adopted: {cause.words}; the scale changed by {change:+.2f} %, from {metric.estimate.value:.6g}"
    journal.warn(said)
    return corrected, adopted.doubted((said,))


def _corrected_inputs(inputs: RangingInputs, correction: Correction, rows: Indices) -> RangingInputs:
    """Anchors, lever arms and ranges as they would be; the correction is of some rows of the log."""
    known = {anchor.anchor_id: anchor.position_m for anchor in inputs.anchors} | {**correction.anchors_m}
    anchors = tuple(replace(anchor, position_m=known[anchor.anchor_id]) for anchor in inputs.anchors)
    moves = np.array([correction.tag_moves_m.get(tag, np.zeros(3)) for tag in inputs.log.tag_ids]).reshape(-1, 3)
    log = inputs.log
    if correction.longer_m is not None:
        log = replace(log, range_m=log.range_m - _spread(correction.longer_m, rows, len(log)))
    return replace(inputs, anchors=anchors, tag_in_cam_m=inputs.tag_in_cam_m + moves, log=log)


def _observations(
    survey: Survey, inputs: RangingInputs, path: PathOfModel, metric: MetricResult, trust: TrustVerdict
) -> RangeObservations:
    """On the path anew; what is left out counts as held out."""
    correction, rows = trust.causes[0].correction, trust.rows
    offset, times, known_s = metric.time_offset, inputs.log.timestamp_s, metric.time_offset_s or 0.0
    shift_s = _spread(np.broadcast_to(correction.time_shift_s, len(rows)), rows, len(inputs.log))
    offset_s = shift_s + (known_s if offset is None or times is None else offset.at(times))
    observations = ranges_on_path(survey, inputs, path.trajectory, offset_s)
    if correction.left_out is None:
        return observations
    status = observations.status.copy()
    status[rows[correction.left_out]] = RangeStatus.CHECK
    return replace(observations, status=status)


def _spread(values: Array, rows: Indices, num: int) -> Array:
    spread = np.zeros(num)
    spread[rows] = values
    return spread

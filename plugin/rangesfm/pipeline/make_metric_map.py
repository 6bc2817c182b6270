"""Making of the metric map from unscaled models by the options of a survey (section 5 of ``model.md``)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rangesfm.arrays import Array, Indices
from rangesfm.colmap.pieces import loose_pieces
from rangesfm.colmap.transform import rescale
from rangesfm.diagnostics.finished_map import doubts_of_pieces
from rangesfm.errors import GeometryError, number_text
from rangesfm.estimation.map_posterior import bending_of_firm_parts
from rangesfm.estimation.photo_bending import bending_of_model
from rangesfm.measurements.kind import Doubt
from rangesfm.measurements.ranges.range_observations import RangeStatus
from rangesfm.pipeline.clock_rivals import by_rivals
from rangesfm.pipeline.close_loops import close_loops_of_survey
from rangesfm.pipeline.judge_map import judge_map, with_cause
from rangesfm.pipeline.metric_result import MetricResult
from rangesfm.pipeline.refine_map import refine_map, with_anchors_on_likelier_sides
from rangesfm.solver.bending import MapBending
from rangesfm.survey.kinds_in_map import without_contradicted
from rangesfm.survey.settings import Survey
from rangesfm.survey.survey_run import PathOfModel, SurveyRun
from rangesfm.util.geometry.numerics import NOTHING_KNOWN

_ANY_STDDEV = 1e3  # a relative stddev of the scale that never leads to a refusal


def metric_map(run: SurveyRun, path: PathOfModel, *, refine: bool) -> MetricResult:
    """Scale a map, refine it if asked for, and judge the final map.

    Raises:
        GeometryError: the scale is not determined, or is less certain than asked for.
        SolverError: the refinement broke the map, and the scaled map does not fit the photos either.
    """
    with run.journal.stage("scale"):
        # What parts of the map are known of, and which measurements contradict the others, depends on how photos bend.
        depends = loose_pieces(path.sfm) or run.inputs.may_be_left_out or not refine
        bending = bending_by_survey(run.survey, path) if depends else path.as_walk
        metric = scale_by_survey(run, path, bending, is_a_start=refine)
        if (of_firm := bending_of_firm_parts(metric.estimate.on_map)) is not None:
            metric = scale_by_survey(run, path, of_firm, is_a_start=refine)
    if refine:
        with run.journal.stage("refinement"):
            metric = with_anchors_on_likelier_sides(run, metric, refine_map(run, metric))
        metric = close_loops_of_survey(run, metric)
    of_pieces = tuple(doubts_of_pieces(loose_pieces(metric.final), metric.all_measured, path.sfm.num_reg_images()))
    run.journal.warn(*(doubt.reason for doubt in of_pieces))
    with run.journal.stage("judgement"):
        return judge_map(run, metric, of_pieces)


def scale_by_survey(run: SurveyRun, path: PathOfModel, bending: MapBending, *, is_a_start: bool) -> MetricResult:
    """Estimate the scale and return the rescaled map.

    Args:
        run: the survey.
        path: model with the ranges on its path.
        bending: of the model.
        is_a_start: whether a refinement follows. Then the refined map is judged, and not this one.

    Raises:
        GeometryError: the scale is not determined.
    """
    survey, inputs, offset = run.survey, run.inputs, path.time_offset
    if offset.offset_matters:
        path = replace(path, observations=replace(path.observations, time_offset_stddev_s=offset.stddev_s))
    limit = max(survey.scale.max_relative_stddev, NOTHING_KNOWN)  # a refinement can start from less certain scales
    try:
        estimate = run.changed({"scale.max_relative_stddev": limit}).estimate_scale(path, bending)
    except GeometryError as error:
        if run.doubts:
            raise GeometryError("; ".join([str(error), *(doubt.reason for doubt in run.doubts)])) from None
        raise _refused_with_cause(error, run, path, bending) from None
    if not is_a_start:
        estimate = estimate.where_bent(survey.scale)
    scaled, kept = rescale(path.sfm, estimate.metric_from_sfm), without_contradicted(inputs, estimate.on_map.kinds)
    return MetricResult(path, kept, estimate, scaled, by_rivals(run, path, estimate))


def bending_by_survey(survey: Survey, path: PathOfModel) -> MapBending:
    """Return how an unscaled model may be bent: by the bundle adjustment of its photos, or as a path without points."""
    return bending_of_model(path.sfm, path.trajectory, survey.camera, survey.refine, survey.mapper.num_threads)


def _refused_with_cause(error: GeometryError, run: SurveyRun, path: PathOfModel, bending: MapBending) -> GeometryError:
    """Return the refusal, with the likeliest mistake added if the ranges show one on a map with any uncertainty."""
    try:
        estimate = run.changed({"scale.max_relative_stddev": _ANY_STDDEV}).estimate_scale(path, bending)
    except (GeometryError, np.linalg.LinAlgError):
        return error
    return with_cause(error, estimate.on_map)


def with_likeliest_cause(run: SurveyRun, metric: MetricResult) -> MetricResult:
    """Correct the likeliest mistake and make the map again; return the map unchanged if none was found.

    The verdict on the new map is doubtful, with the change as a reason. Of two mistakes that the ranges hardly tell
    apart the likelier one is corrected, too; the user has asked for it and is told.
    """
    cause = next(iter(metric.diagnosis.causes), None)
    if cause is None or (correction := cause.correction) is None:
        return metric
    if metric.models:
        run.journal.warn("no mistake is corrected: the map is joined from several models")
        return metric
    inputs, log, rows = run.inputs, run.inputs.log, correction.rows
    known = {anchor.anchor_id: anchor.position_m for anchor in inputs.anchors} | {**correction.anchors_m}
    anchors = tuple(replace(anchor, position_m=known[anchor.anchor_id]) for anchor in inputs.anchors)
    moves = np.array([correction.tag_moves_m.get(tag, np.zeros(3)) for tag in log.tag_ids]).reshape(-1, 3)
    log = replace(log, range_m=log.range_m - _spread(correction.longer_m, rows, len(log)))
    inputs = replace(inputs, anchors=anchors, tag_in_cam_m=inputs.tag_in_cam_m + moves, log=log)
    corrected = replace(run, inputs=inputs)
    try:
        shift_s = _spread(correction.time_shift_s, rows, len(log))
        observations = corrected.ranges_on(metric.trajectory, shift_s + metric.path.offset_s)
        status = observations.status.copy()
        status[rows[correction.left_out]] = RangeStatus.CHECK
        path = replace(metric.path, observations=replace(observations, status=status))
        adopted = metric_map(corrected, path, refine=metric.refined is not None)
    except GeometryError as error:
        run.journal.warn(f"no mistake is corrected, because the corrected survey fails: {error}")
        return metric
    change = number_text(100 * (adopted.estimate.value / metric.estimate.value - 1), "+.2f")
    said = f"adopted: {cause.words}; the scale changed by {change} %, from {metric.estimate.value:.6g}"
    run.journal.warn(said)
    return adopted.doubted(Doubt(said))


def _spread(values: float | Array, rows: Indices, num: int) -> Array:
    """Return an array (num,) with one value or (k,) values at the given rows (k,), and 0 elsewhere."""
    spread = np.zeros(num)
    spread[rows] = values
    return spread

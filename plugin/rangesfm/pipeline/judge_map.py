"""The final estimate, the tests and the verdict of a metric map (sections 6 to 9 of ``model.md``)."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pycolmap

from rangesfm.arrays import Array
from rangesfm.colmap.reprojection import point_errors
from rangesfm.colmap.transform import rescale
from rangesfm.diagnostics.finished_map import doubts_of_map, place_of_map
from rangesfm.diagnostics.lens import doubt_of_lens, fit_lens
from rangesfm.diagnostics.point_tests import Placed, diagnose_points
from rangesfm.errors import GeometryError
from rangesfm.estimation.drift import bend
from rangesfm.estimation.photo_bending import likely_bend
from rangesfm.estimation.scale.scale_verdict import refuse_unknown
from rangesfm.measurements.joint_map import Doubt, JointMap
from rangesfm.measurements.ranges.errors.components import CLOCKS
from rangesfm.measurements.ranges.mistakes.diagnosis import Diagnosis
from rangesfm.pipeline.metric_result import MetricResult
from rangesfm.survey.settings import Survey
from rangesfm.survey.survey_run import SurveyRun
from rangesfm.util.geometry.numerics import DOUBTFUL_ABOVE


def judge_map(run: SurveyRun, metric: MetricResult, known_doubts: Sequence[Doubt]) -> MetricResult:
    """Judge the final map: add the final estimate of the scale, the tests of mistakes, all doubts and the place.

    The doubts also go to the journal as warnings, except for those that were known before.

    Raises:
        GeometryError: the scale is less certain than asked for.
    """
    survey, journal = run.survey, run.journal
    metric, on_map = _estimated(survey, metric), metric.all_measured
    path, bends_m = metric.trajectory.as_in(metric.final), [each.bends_m(on_map) for each in on_map.kinds]
    bent_by_m = next((each for each in bends_m if len(each)), np.zeros(0))
    diagnosis = _tested(run, metric, path.centers, bent_by_m)
    journal.warn(*(metric.estimate.reasons if metric.estimate.verdict != "good" else ()), *diagnosis.reasons)
    doubts: list[Doubt] = []
    if metric.why_broken:
        reason = f"the refinement broke the map, so the scaled map is the result: {'; '.join(metric.why_broken)}"
        doubts.append(Doubt(reason, "check the model's points and cameras, clocks, lever arm and anchors"))
    doubts += doubts_of_map(metric.kept_refinement, point_errors(metric.final))
    advice = "let the offset be searched for ([positions] time_offset)"
    doubts += [Doubt(reason, advice) for reason in metric.positions.doubts_of_clock()]
    of_lens = _doubts_of_lens(metric)
    of_clocks = (*metric.positions.doubts_of_found_clock(), *metric.rivals.doubts)
    journal.warn(*(doubt.reason for doubt in (*of_lens, *doubts)), *of_clocks)
    doubts += known_doubts
    against = (
        *(doubt.reason for doubt in of_lens),
        *diagnosis.of_place,
        *of_clocks,
        *(doubt.reason for doubt in doubts),
    )
    place = place_of_map(metric.estimate, metric.kept_refinement, path, against, bent_by_m)
    judged = replace(metric, place=place, diagnosis=diagnosis).doubted(metric.rivals.doubts)
    judged = judged.doubted([doubt.reason for doubt in doubts], [doubt.advice for doubt in doubts])
    # A lens that does not fit comes first, because it may look like other mistakes.
    judged = judged.doubted(diagnosis.reasons)
    return judged.doubted([doubt.reason for doubt in of_lens], [doubt.advice for doubt in of_lens])


def _doubts_of_lens(metric: MetricResult) -> tuple[Doubt, ...]:
    """Return a doubt if the photos fit far better with another camera model, and lengths change with it."""
    if not metric.final.num_points3D():
        return ()
    estimate, refinement = metric.estimate, metric.kept_refinement
    is_learnt = any(each.shows_bending for each in metric.kinds)
    factor = refinement.bending_factor if refinement is not None and is_learnt else None
    half_width_95 = estimate.uncertainty.half_width_95
    doubt = doubt_of_lens(fit_lens(metric.final, min(half_width_95, DOUBTFUL_ABOVE)), factor, half_width_95)
    return () if doubt is None else (doubt,)


def _tested(run: SurveyRun, metric: MetricResult, centers_m: Array, bent_by_m: Array) -> Diagnosis:
    """Return the tests of all kinds, first of those that place the map.

    Points are tested once more against a map that others hold, too.

    Args:
        centers_m: (n, 3) keyframe centres in the final map. bent_by_m: (n,) as for ``place_of_map``.
    """
    estimate, on_map, diagnosis = metric.estimate, metric.all_measured, Diagnosis()
    for is_placing in (True, False):
        kinds = [each for each in on_map.kinds if each.places_map is is_placing]
        for each in kinds:
            try:
                diagnosis = diagnosis.with_more(each.tests(on_map, estimate.by_kind))
            except np.linalg.LinAlgError as error:
                run.journal.warn(f"mistakes were not tested, because the {each.words} determine too little: {error}")
        if is_placing and estimate.placement is not None and any(each.is_solved for each in kinds):
            by_antenna = metric.positions.antenna is not None and len(kinds) > 1
            placed = Placed(estimate.placement, centers_m[0], float(bent_by_m.max(initial=0.0)), by_antenna=by_antenna)
            stddev = estimate.uncertainty.empirical
            of_points = diagnose_points(metric.positions.points, metric.final, metric.map_errors, stddev, placed)
            diagnosis = diagnosis.with_more(of_points)
    return diagnosis


def moved_to_estimate(metric: MetricResult, at: JointMap) -> MetricResult:
    """Return the result with the refined map bent and moved as a whole to its best estimate."""
    refinement, bent = metric.kept_refinement, likely_bend(at, metric.trajectory)
    assert metric.refined is not None, "a refined map"
    assert refinement is not None, "a refined map"
    for moved in (moved for each in at.kinds for moved in each.moved_ranges(at.posterior, bent)):
        refinement = refinement.moved(at.estimate, *moved)
    refined = pycolmap.Reconstruction(metric.refined)
    if len(bent.frame_ids):
        bend(refined, bent)
    return replace(metric, refined=rescale(refined, at.estimate), refinement=refinement)


def _estimated(survey: Survey, metric: MetricResult) -> MetricResult:
    """Return the result with the estimate of the final map's scale, to which a refined map is moved.

    Raises:
        GeometryError: the scale is less certain than asked for.
    """
    start, at = metric.estimate, metric.all_measured
    try:
        if at.is_at_rest:
            estimate, metric = start.at_rest(at, survey.scale), moved_to_estimate(metric, at)
        else:
            if start.method != "two-candidate":  # which has no interval
                refuse_unknown(start.uncertainty.half_width_95, start.reasons, start.advice, survey.scale)
            estimate = start
            if metric.kept_refinement is not None and metric.refined_scale is not None:
                estimate = replace(start, value=metric.refined_scale)
    except GeometryError as error:
        raise with_cause(error, at) from None
    if metric.rivals.doubts:
        estimate = replace(estimate, uncertainty=estimate.uncertainty.beside(CLOCKS, metric.rivals.stddev))
    return replace(metric, estimate=estimate)


def with_cause(error: GeometryError, on_map: JointMap) -> GeometryError:
    """Return a refusal with the likeliest mistakes that the measurements on its map show."""
    causes = []
    for each in on_map.kinds:
        with contextlib.suppress(np.linalg.LinAlgError):  # they determine too little for tests
            causes.append(each.tests(on_map, {}).likeliest)
    return GeometryError("; ".join([str(error), *filter(None, causes)])) if any(causes) else error

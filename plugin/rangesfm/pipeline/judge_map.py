"""The final estimate, the tests and the verdict of a metric map (sections 6 to 9 of ``model.md``)."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rangesfm.colmap.reprojection import point_errors
from rangesfm.diagnostics.finished_map import doubts_of_points, doubts_of_refinement, place_of_map
from rangesfm.diagnostics.lens import doubts_of_lens
from rangesfm.errors import GeometryError
from rangesfm.estimation.photo_bending import LARGEST_FACTOR
from rangesfm.estimation.scale.scale_estimate import refuse_unknown
from rangesfm.measurements.joint_map import JointMap, KindOnMap
from rangesfm.measurements.kind import Doubt
from rangesfm.measurements.mistakes import MistakeTests
from rangesfm.measurements.ranges.errors.components import CLOCKS
from rangesfm.pipeline.metric_result import MetricResult
from rangesfm.pipeline.result_records import disagreements, distance_rows
from rangesfm.survey.settings import Survey
from rangesfm.survey.survey_run import SurveyRun


def judge_map(run: SurveyRun, metric: MetricResult, known_doubts: Sequence[Doubt]) -> MetricResult:
    """Judge the final map: add the final estimate of the scale, the tests of mistakes, all doubts and the place.

    The doubts also go to the journal as warnings, except for those that were known before.

    Raises:
        GeometryError: the scale is less certain than asked for.
    """
    journal, metric = run.journal, _estimated(run.survey, metric)
    on_map, path = metric.all_measured, metric.trajectory.as_in(metric.final)
    bends_m = [each.bends_m(on_map) for each in on_map.kinds]
    bent_by_m = next((each for each in bends_m if len(each)), np.zeros(0))
    diagnosis = _tested(run, metric)
    journal.warn(*(metric.estimate.reasons if metric.estimate.verdict != "good" else ()), *diagnosis.reasons)
    doubts: list[Doubt] = []
    if metric.refined is not None and metric.refined.why_broken:
        reason = (
            f"the refinement broke the map, so the scaled map is the result: {'; '.join(metric.refined.why_broken)}"
        )
        doubts.append(Doubt(reason, "check the model's points and cameras, clocks, lever arm and anchors"))
    doubts += doubts_of_points(point_errors(metric.final))
    doubts += () if metric.kept is None else doubts_of_refinement(metric.kept)
    doubts += run.doubts
    # A lens that does not fit comes first, because it may look like other mistakes.
    of_lens = _doubts_of_lens(metric)
    of_lengths = tuple(disagreements(distance_rows(metric), metric.estimate.uncertainty.empirical))
    journal.warn(
        *(doubt.reason for doubt in (*of_lens, *doubts)), *metric.rivals.doubts, *(doubt.reason for doubt in of_lengths)
    )
    doubts += known_doubts
    of_map = [doubt.reason for doubt in doubts]
    against = (*(doubt.reason for doubt in of_lens), *diagnosis.of_place, *metric.rivals.doubts, *of_map)
    place = place_of_map(metric.estimate, metric.map_errors, path, against, bent_by_m)
    judged = replace(metric, place=place, diagnosis=diagnosis)
    return judged.doubted(
        *of_lens, *map(Doubt, diagnosis.reasons), *doubts, *map(Doubt, metric.rivals.doubts), *of_lengths
    )


def _doubts_of_lens(metric: MetricResult) -> tuple[Doubt, ...]:
    """Return a doubt if the photos fit far better with another camera model, and lengths change with it."""
    if not metric.final.num_points3D():
        return ()
    is_learnt = any(each.shows_bending and each.is_used for each in metric.kinds)
    factor = metric.kept.bending_factor if metric.kept is not None and is_learnt else LARGEST_FACTOR
    return doubts_of_lens(metric.final, factor, metric.estimate.uncertainty.half_width_95)


def _tested(run: SurveyRun, metric: MetricResult) -> MistakeTests:
    """Return the tests of all kinds, first of those that contradict others, and then of those that place the map.

    On a map by the one of two kinds that is wrong, the other seems to have mistakes that nobody made.
    """
    on_map, by_kind, diagnosis = metric.all_measured, metric.estimate.by_kind, MistakeTests()

    def comes_later(kind: KindOnMap) -> tuple[bool, bool]:
        return not any(row.rejected for row in kind.against_others(on_map, by_kind)), not kind.places_map

    for each in sorted(on_map.kinds, key=comes_later):
        try:
            diagnosis = diagnosis.with_more(each.tests(on_map, by_kind))
        except np.linalg.LinAlgError as error:
            run.journal.warn(f"mistakes were not tested, because the {each.words} determine too little: {error}")
    return diagnosis


def _estimated(survey: Survey, metric: MetricResult) -> MetricResult:
    """Return the result with the estimate of the final map's scale.

    Raises:
        GeometryError: the scale is less certain than asked for.
    """
    estimate, at = metric.estimate, metric.all_measured
    try:
        if at.is_at_rest:
            estimate = estimate.at_rest(at, survey.scale)
        elif estimate.method != "two-candidate":  # which has no interval
            refuse_unknown(estimate.uncertainty.half_width_95, estimate.reasons, estimate.advice, survey.scale)
    except GeometryError as error:
        raise with_cause(error, at) from None
    if metric.kept is not None and not at.is_at_rest:
        estimate = replace(estimate, value=metric.kept.scale)
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

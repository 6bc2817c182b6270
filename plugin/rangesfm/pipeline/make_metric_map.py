"""Making of the metric map from unscaled models by the options of a survey (section 5 of ``model.md``)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rangesfm.colmap.pieces import LoosePiece, loose_pieces
from rangesfm.colmap.transform import rescale
from rangesfm.diagnostics.finished_map import doubts_of_pieces
from rangesfm.errors import GeometryError
from rangesfm.estimation.photo_bending import PhotoBending, bending_of_model
from rangesfm.measurements.kind import MapState
from rangesfm.pipeline.clock_rivals import by_rivals
from rangesfm.pipeline.close_loops import close_loops_of_survey
from rangesfm.pipeline.join_models import ModelVerdict, join_models
from rangesfm.pipeline.judge_map import judge_map, with_cause
from rangesfm.pipeline.metric_result import MetricResult
from rangesfm.pipeline.refine_map import refine_closed_map, refine_map, with_anchors_on_likelier_sides
from rangesfm.solver.bending import MapBending
from rangesfm.survey.kinds_in_map import ranges_in_map, without_contradicted
from rangesfm.survey.settings import Survey
from rangesfm.survey.survey_run import PathOfModel, SurveyRun
from rangesfm.util.geometry.numerics import NOTHING_KNOWN
from rangesfm.util.geometry.poses import model_poses

_ANY_STDDEV = 1e3  # a relative stddev of the scale that never leads to a refusal


def join_by_survey(
    run: SurveyRun, paths: Sequence[PathOfModel], *, must_join: bool
) -> tuple[PathOfModel, tuple[ModelVerdict, ...]]:
    """Join the models to the first one; models that cannot be joined are left out with a warning.

    Args:
        run: survey of the models.
        paths: models with the ranges on their paths.
        must_join: whether it is an error if no other model can be joined.

    Returns:
        The joined model, and the verdicts on all models (none where there is only one).

    Raises:
        GeometryError: no other model can be joined, and ``must_join`` is true.
    """
    if len(paths) == 1:
        return paths[0], ()
    joined = join_models(run, paths)
    left_out = [model for model in joined.verdicts if model.joined_from_sfm is None]
    if must_join and len(left_out) == len(paths) - 1:
        reasons = "; ".join(f"{model.name}: {model.reason}" for model in left_out)
        raise GeometryError(f"nothing can be joined to {paths[0].name}: {reasons}")
    whose = (f"{model.name} ({model.num_images} photos) is left out: {model.reason}" for model in left_out)
    run.journal.warn(*joined.notes, *whose)
    return joined.path, joined.verdicts


def metric_map(run: SurveyRun, path: PathOfModel, *, refine: bool) -> MetricResult:
    """Scale a map, refine it if asked for, and judge the final map.

    Raises:
        GeometryError: the scale is not determined, or is less certain than asked for.
        SolverError: the refinement broke the map, and the scaled map does not fit the photos either.
    """
    pieces = _pieces_not_held(run, path)
    with run.journal.stage("scale"):
        metric = scale_by_survey(run, path, is_a_start=refine)
    if refine:
        with run.journal.stage("refinement"):
            refined = with_anchors_on_likelier_sides(run, metric, refine_map(run, metric))
        metric = close_loops_of_survey(run, refined, refine_closed_map)
        if pieces and metric.loops is not None and metric.loops.closed:  # loops hold pieces that neighbours do not
            pieces = _pieces_not_held(
                run, replace(path, sfm=metric.final, trajectory=path.trajectory.as_in(metric.final))
            )
    of_pieces = doubts_of_pieces(pieces, path.sfm.num_reg_images())
    run.journal.warn(*(doubt.reason for doubt in of_pieces))
    with run.journal.stage("judgement"):
        return judge_map(run, metric, of_pieces)


def _pieces_not_held(run: SurveyRun, path: PathOfModel) -> tuple[LoosePiece, ...]:
    """Return the parts of a model that share few points with the rest, which do not determine their scale."""
    pieces = loose_pieces(path.sfm)
    bending = bending_by_survey(run.survey, path) if pieces else None
    if not isinstance(bending, PhotoBending):  # the photos determine nothing, or are too many to tell
        return pieces
    return tuple(piece for piece in pieces if not bending.hold_together(piece.image_names))


def scale_by_survey(run: SurveyRun, path: PathOfModel, *, is_a_start: bool) -> MetricResult:
    """Estimate the scale and return the rescaled map.

    Args:
        run: the survey.
        path: model with the ranges on its path.
        is_a_start: whether a refinement follows. Then the refined map is judged, and not this one.

    Raises:
        GeometryError: the scale is not determined.
    """
    survey, inputs, offset = run.survey, run.inputs, path.time_offset
    if offset is not None and offset.offset_matters:
        path = replace(path, observations=replace(path.observations, time_offset_stddev_s=offset.stddev_s))
    # Which control points and lengths contradict the others depends on how far the photos let the map drift.
    is_judged = not is_a_start or inputs.positions.are_known or len(inputs.tape.control().distances) > 0
    bending = bending_by_survey(survey, path) if is_judged else None
    limit = max(survey.scale.max_relative_stddev, NOTHING_KNOWN)  # a refinement can start from less certain scales
    try:
        estimate = run.changed({"scale.max_relative_stddev": limit}).estimate_scale(path, bending)
    except GeometryError as error:
        if doubts := "; ".join(inputs.positions.doubts_of_clock()):
            raise GeometryError(f"{error}; {doubts}") from None
        raise _refused_with_cause(error, run, path) from None
    if not is_a_start:
        estimate = estimate.where_bent(survey.scale)
    scaled = rescale(path.sfm, estimate.metric_from_sfm)
    ranges = ranges_in_map(inputs, estimate, path.trajectory, survey.refine)
    predicted = ranges.predicted_m(MapState(model_poses(scaled, path.trajectory.frame_ids), ranges.blocks))
    weights = estimate.errors.robust_weights(predicted - inputs.log.range_m)
    offset_s = offset.value_s if offset is not None else survey.ranges.time_offset_s
    kept = without_contradicted(inputs, estimate.kinds)
    return MetricResult(
        path.trajectory, offset, offset_s, estimate, scaled, predicted, weights, tape=kept.tape,
        positions=kept.positions, rivals=by_rivals(run, path, estimate),
    )  # fmt: skip


def bending_by_survey(survey: Survey, path: PathOfModel) -> MapBending:
    """Return how an unscaled model may be bent: by the bundle adjustment of its photos, or as a path without points."""
    return bending_of_model(path.sfm, path.trajectory, survey.camera, survey.refine, survey.mapper.num_threads)


def _refused_with_cause(error: GeometryError, run: SurveyRun, path: PathOfModel) -> GeometryError:
    """Return the refusal, with the likeliest mistake added if the ranges show one on a map with any uncertainty."""
    lenient, bending = run.changed({"scale.max_relative_stddev": _ANY_STDDEV}), bending_by_survey(run.survey, path)
    try:
        estimate = lenient.estimate_scale(path, bending)
    except (GeometryError, np.linalg.LinAlgError):
        return error
    return with_cause(error, estimate.on_map)

"""The stages from ranges on paths to the metric map, by a survey's options."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from rangesfm.colmap.transform import rescale
from rangesfm.distances.ends import locate_distances
from rangesfm.distances.surveyed import surveyed_distances
from rangesfm.distances.tape import Tape
from rangesfm.errors import GeometryError
from rangesfm.join.models import ModelVerdict, PathOfModel, Ranging, join_models
from rangesfm.ranging.clock.estimate import TimeOffset
from rangesfm.refine.radio import predicted_ranges
from rangesfm.result.metric_result import MetricResult
from rangesfm.survey.inputs import RangingInputs
from rangesfm.survey.settings import Survey
from rangesfm.workflows.journal import Journal
from rangesfm.workflows.survey_stages import estimate_scale, refine_by_survey
from rangesfm.workflows.trust_in_map import tested


def join_by_survey(
    survey: Survey, inputs: RangingInputs, paths: Sequence[PathOfModel], journal: Journal, *, must_join: bool
) -> tuple[PathOfModel, tuple[ModelVerdict, ...]]:
    """All models that can be, as one."""
    if len(paths) == 1:
        return paths[0], ()
    ranging = Ranging(inputs.anchors, inputs.anchor_frame, survey.scale, survey.ranges, inputs.tape, survey.output.seed)
    joined = join_models(paths, ranging)
    left_out = [model for model in joined.verdicts if model.joined_from_sfm is None]
    if must_join and len(left_out) == len(paths) - 1:
        reasons = "; ".join(f"{model.name}: {model.reason}" for model in left_out)
        raise GeometryError(f"nothing can be joined to {paths[0].name}: {reasons}")
    for note in joined.notes:
        journal.warn(note)
    for model in left_out:
        journal.warn(f"{model.name} ({model.num_images} photos) is left out: {model.reason}")
    return joined.path, joined.verdicts


def scale_by_survey(
    survey: Survey, inputs: RangingInputs, path: PathOfModel, offset: TimeOffset | None, journal: Journal
) -> MetricResult:
    """The scale of a map, its doubts told, and the map rescaled."""
    sfm, trajectory, observations = path.sfm, path.trajectory, path.observations
    distances = None
    if inputs.tape is not None:
        distances = locate_distances(inputs.tape, sfm, observations.log.anchor_ids)
    estimate = estimate_scale(survey, inputs, observations, trajectory, inputs.anchor_frame, distances)
    for doubt in estimate.reasons if estimate.verdict != "good" else ():
        journal.warn(doubt)
    scaled = rescale(sfm, estimate.metric_from_sfm)
    predicted = predicted_ranges(
        scaled,
        trajectory,
        estimate.observations,
        estimate.metric_from_sfm,
        inputs.tag_in_cam_m,
        estimate.anchors,
    )
    weights = estimate.errors.robust_weights(predicted - inputs.log.range_m)
    offset_s = offset.value_s if offset is not None else survey.ranges.time_offset_s
    metric = MetricResult(trajectory, offset, offset_s, estimate, scaled, predicted, weights)
    return tested(survey, metric, journal)


def refine_map(survey: Survey, inputs: RangingInputs, metric: MetricResult, journal: Journal) -> MetricResult:
    """The map refined with its ranges, and what speaks against the refinement told."""
    refined, summary = refine_by_survey(
        survey, inputs, metric.scaled, metric.trajectory, metric.estimate, _control(inputs, metric)
    )
    if not summary.converged:
        journal.warn(f"the refinement stopped before it converged: {summary.message}")
    if survey.refine.covariance and summary.covariance is None:
        journal.warn("no covariance of the poses: too many keyframes, or photos and ranges leave some of it open")
    for misfit in summary.misfits:
        journal.warn(f"after the refinement {misfit}")
    return replace(metric, refined=refined, refinement=summary)


def _control(inputs: RangingInputs, metric: MetricResult) -> Tape:
    """What was taped, and the distances between surveyed anchors where their positions could not be used."""
    tape = inputs.tape or Tape()
    if inputs.anchor_frame != "site" or metric.estimate.frame == "site":
        return tape
    return replace(tape, distances=tape.distances + surveyed_distances(inputs.anchors))

"""Making of the metric map from unscaled models and ranges by the options of a survey: scale, refinement, judgement."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pycolmap

from rangesfm.arrays import Array
from rangesfm.colmap.pieces import loose_pieces
from rangesfm.colmap.reprojection import point_errors
from rangesfm.colmap.transform import rescale, without_photos
from rangesfm.diagnostics.bent_path import bends_m, bent_to_ranges, estimate_by_bent
from rangesfm.diagnostics.diagnosis import Diagnosis, causes_in_words, diagnose_ranges
from rangesfm.diagnostics.finished_map import Doubt, doubts_of_map, doubts_of_pieces, place_of_map, why_broken
from rangesfm.diagnostics.length_tests import diagnose_lengths
from rangesfm.diagnostics.linearized import RangesOnMap, ranges_on_map
from rangesfm.distances.locate_lengths import surveyed_distances
from rangesfm.distances.tape import Tape
from rangesfm.errors import GeometryError, InputError, SolverError
from rangesfm.geometry.gravity import gravity_of
from rangesfm.geometry.trajectory import Trajectory, in_first_camera, trajectory_from_reconstruction
from rangesfm.join.join_models import ModelVerdict, PathOfModel, estimate_scale, join_models
from rangesfm.progress import Journal
from rangesfm.ranging.association import associate
from rangesfm.ranging.clock.time_offset import REMEDY, TimeOffset, estimate_time_offset
from rangesfm.ranging.errors.bending import MapBending, WalkBending
from rangesfm.ranging.errors.components import CLOCKS
from rangesfm.ranging.range_log import RangeKind
from rangesfm.ranging.range_observations import RangeObservations, RangeStatus, hold_out
from rangesfm.refine.photo_bending import bending_of_model, by_photos
from rangesfm.refine.radio import ranges_predicted_by_model
from rangesfm.refine.with_ranges import AtRest, Learn, Learnt, RefineSummary, refine_with_ranges
from rangesfm.result.metric_result import MetricResult, Rivals
from rangesfm.scale.at_map import MapWithRanges, estimate_at
from rangesfm.scale.scale_estimate import NORMAL_95, ScaleEstimate
from rangesfm.scale.scale_verdict import refuse_unknown
from rangesfm.survey.inputs import RangingInputs
from rangesfm.survey.settings import Survey
from rangesfm.vision.image_times import ImageTimes

# Two likely time offsets whose scales differ by more than this fraction leave the scale undetermined, ...
_MAX_SPREAD = 0.03
# ... unless all offsets with such different scales together have a probability of at most this.
_HARDLY_LIKELY = 0.05
_ANY_STDDEV = 1e3  # a relative stddev of the scale that never leads to a refusal
# Largest relative stddev of a scale from which a refinement can start. At this value the scale may as well be zero.
_NOTHING_KNOWN = 1.0


def path_of_model(model: pycolmap.Reconstruction, times: ImageTimes | None) -> Trajectory:
    """Return the camera's path in a model, with the times of the photos unless ``times`` is None."""
    if times is None:
        return trajectory_from_reconstruction(model)
    return trajectory_from_reconstruction(model, times.by_name(), time_resolution_s=times.resolution_s)


def path_with_times(
    survey: Survey, model: pycolmap.Reconstruction, times: ImageTimes | None, journal: Journal
) -> Trajectory:
    """Return the path of a model's photos; photos without a time are left out with a warning, if times are needed.

    Raises:
        InputError: times are needed, and no photo has one.
    """
    trajectory = path_of_model(model, times)
    if not len(trajectory):
        first = min(image.name for image in model.images.values())
        raise InputError(f"none of the model's photos has a time, the first is {first}", survey.images.times)
    num = model.num_reg_frames()
    if num_without_time := num - len(trajectory):
        journal.warn(f"{num_without_time} of {num} photos of the model have no time and are left out")
    return trajectory


def find_time_offset(
    survey: Survey, inputs: RangingInputs, trajectory: Trajectory, journal: Journal
) -> TimeOffset | None:
    """Search for the time offset between the clocks; None where it is given, or where the log names photos.

    Raises:
        GeometryError: the ranges do not determine it.
    """
    if inputs.log.image_name is not None or survey.ranges.time_offset_s is not None:
        return None
    with journal.stage("time offset"):
        offset = estimate_time_offset(
            inputs.log,
            trajectory,
            inputs.tag_in_cam_m,
            association=survey.ranges,
            seed=survey.output.seed,
            progress=journal.progress,
        )
    journal.warn(*([offset.note] if offset.note else []))
    return offset


def ranges_on_paths(
    survey: Survey,
    inputs: RangingInputs,
    models: Sequence[pycolmap.Reconstruction],
    trajectory: Trajectory,
    times: ImageTimes | None,
    offset: TimeOffset | None,
    journal: Journal,
) -> list[PathOfModel]:
    """Return the models with the ranges on their paths. A photo that several models have is kept in the first of them.

    Args:
        survey: options.
        inputs: of the survey.
        models: unscaled models of its photos.
        trajectory: path of the first model.
        times: of the photos; None where the log names photos.
        offset: estimate of the time offset; None where it is given or not needed.
        journal: for warnings about models that are left out.

    Raises:
        InputError: no range has a place on the first path.
    """
    given_s, radio_times_s = survey.ranges.time_offset_s or 0.0, inputs.log.timestamp_s
    offsets_s = given_s if offset is None or radio_times_s is None else offset.at(radio_times_s)
    paths = [PathOfModel("sparse/0", models[0], trajectory, ranges_on_path(survey, inputs, trajectory, offsets_s))]
    names = set(trajectory.image_names)
    for k, model in enumerate(models[1:], start=1):
        rest = without_photos(model, names)
        path = path_of_model(rest, times)
        if not len(path):
            journal.warn(f"sparse/{k} is left out: its photos have no times, or are also in other models")
            continue
        names.update(path.image_names)
        observations = ranges_on_path(survey, inputs, path, offsets_s, may_be_none=True)
        paths.append(PathOfModel(f"sparse/{k}", rest, path, observations))
    return paths


def ranges_on_path(
    survey: Survey,
    inputs: RangingInputs,
    trajectory: Trajectory,
    offset_s: float | Array,
    *,
    may_be_none: bool = False,
) -> RangeObservations:
    """Place the ranges on a path and hold out the check ranges.

    Args:
        survey: options.
        inputs: of the survey.
        trajectory: of the camera.
        offset_s: image time minus range time, one for all ranges or (n,).
        may_be_none: whether it is fine if no range has a place on the path.

    Raises:
        InputError: no range has a place on the path; the text says why.
    """
    observations = associate(inputs.log, trajectory, inputs.tag_in_cam_m, time_offset_s=offset_s, options=survey.ranges)
    if len(inputs.log) and not may_be_none and not observations.has_place.any():
        why = _why_no_range_has_a_place(observations, trajectory, float(np.mean(offset_s)))
        raise InputError(why, survey.ranges.path)
    return hold_out(observations, survey.ranges, survey.output.seed)


def _why_no_range_has_a_place(observations: RangeObservations, trajectory: Trajectory, offset_s: float) -> str:
    times, photo_times = observations.log.timestamp_s, trajectory.timestamps_s
    if times is None or photo_times is None:
        return "none of the photos that the log names is in the model"
    if np.all(observations.status[observations.log.kind == RangeKind.TAG_ANCHOR] == RangeStatus.OUTSIDE_PATH):
        return (
            f"the log's times ({times.min():.3f} to {times.max():.3f} s, plus an offset of {offset_s:g} s) do not "
            f"overlap the photos' ({photo_times[0]:.3f} to {photo_times[-1]:.3f} s): give another time offset, or auto"
        )
    return "no range is near enough to a keyframe in time: use more photos, or a larger max_interpolation_gap_s"


def refine_by_survey(
    survey: Survey,
    inputs: RangingInputs,
    scaled: pycolmap.Reconstruction,
    trajectory: Trajectory,
    estimate: ScaleEstimate,
    tape: Tape | None,
    learn: Learn | None = None,
) -> tuple[pycolmap.Reconstruction, RefineSummary]:
    """Call ``refine_with_ranges`` with the options of a survey and the results of the scale stage.

    Args:
        survey: options.
        inputs: of the survey.
        scaled: model in the metric world.
        trajectory: path of the unscaled model, as in the scale stage.
        estimate: of the scale.
        tape: measured lengths for the refinement; None without any.
        learn: as in ``refine_with_ranges``.
    """
    return refine_with_ranges(
        scaled,
        trajectory,
        estimate.observations,
        estimate.metric_from_sfm,
        estimate.anchors,
        estimate.errors,
        tag_in_cam_m=inputs.tag_in_cam_m,
        first_pose_is_fixed=estimate.frame != "site",
        gravity=gravity_of(survey.scale.up_in_first_camera),
        camera=survey.camera,
        options=survey.refine,
        tape=tape,
        learn=learn,
        num_threads=survey.mapper.num_threads,
    )


def join_by_survey(
    survey: Survey, inputs: RangingInputs, paths: Sequence[PathOfModel], journal: Journal, *, must_join: bool
) -> tuple[PathOfModel, tuple[ModelVerdict, ...]]:
    """Join the models to the first one; models that cannot be joined are left out with a warning.

    Args:
        survey: options.
        inputs: of the survey.
        paths: models with the ranges on their paths.
        journal: for warnings.
        must_join: whether it is an error if no other model can be joined.

    Returns:
        The joined model, and the verdicts on all models (none where there is only one).

    Raises:
        GeometryError: no other model can be joined, and ``must_join`` is true.
    """
    if len(paths) == 1:
        return paths[0], ()
    joined = join_models(paths, survey, inputs)
    left_out = [model for model in joined.verdicts if model.joined_from_sfm is None]
    if must_join and len(left_out) == len(paths) - 1:
        reasons = "; ".join(f"{model.name}: {model.reason}" for model in left_out)
        raise GeometryError(f"nothing can be joined to {paths[0].name}: {reasons}")
    whose = (f"{model.name} ({model.num_images} photos) is left out: {model.reason}" for model in left_out)
    journal.warn(*joined.notes, *whose)
    return joined.path, joined.verdicts


def metric_map(
    survey: Survey,
    inputs: RangingInputs,
    path: PathOfModel,
    offset: TimeOffset | None,
    journal: Journal,
    *,
    refine: bool,
) -> MetricResult:
    """Scale a map, refine it if asked for, and judge the final map.

    Raises:
        GeometryError: the scale is not determined, or is less certain than asked for.
        SolverError: the refinement broke the map, and the scaled map does not fit the photos either.
    """
    of_pieces = doubts_of_pieces(loose_pieces(path.sfm), path.sfm.num_reg_images())
    journal.warn(*(doubt.reason for doubt in of_pieces))
    with journal.stage("scale"):
        metric = scale_by_survey(survey, inputs, path, offset, journal, is_a_start=refine)
    if refine:
        with journal.stage("refinement"):
            metric = refine_map(survey, inputs, metric, journal)
    with journal.timed("judgement"):
        return judge_map(survey, metric, of_pieces, journal)


def scale_by_survey(
    survey: Survey,
    inputs: RangingInputs,
    path: PathOfModel,
    offset: TimeOffset | None,
    journal: Journal,
    *,
    is_a_start: bool,
) -> MetricResult:
    """Estimate the scale and return the rescaled map.

    Args:
        survey: options.
        inputs: of the survey.
        path: model with the ranges on its path.
        offset: estimate of the time offset; None where it is given or not needed.
        journal: unused where there is nothing to warn of.
        is_a_start: whether a refinement follows. Then the refined map is judged, and not this one.

    Raises:
        GeometryError: the scale is not determined.
    """
    if offset is not None and offset.offset_matters:
        path = replace(path, observations=replace(path.observations, time_offset_stddev_s=offset.stddev_s))
    bending = None if is_a_start else bending_by_survey(survey, path)
    limit = max(survey.scale.max_relative_stddev, _NOTHING_KNOWN)
    try:
        estimate = estimate_scale(survey.changed({"scale.max_relative_stddev": limit}), inputs, path, bending)
    except GeometryError as error:
        raise _refused_with_cause(error, survey, inputs, path) from None
    on_map, rivals = None, None
    if not is_a_start and (on_map := _ranges_on_scaled(estimate, path.trajectory, bending)) is not None:
        estimate = estimate_by_bent(estimate, on_map, survey.scale)
    if offset is not None and offset.rivals:
        rivals = scale_by_rivals(survey, inputs, path, offset, estimate.value)
    scaled = rescale(path.sfm, estimate.metric_from_sfm)
    predicted = ranges_predicted_by_model(
        scaled,
        path.trajectory,
        estimate.observations,
        estimate.metric_from_sfm,
        inputs.tag_in_cam_m,
        estimate.anchors,
    )
    weights = estimate.errors.robust_weights(predicted - inputs.log.range_m)
    offset_s = offset.value_s if offset is not None else survey.ranges.time_offset_s
    tape = inputs.tape
    if tape is not None and (lengths := estimate.lengths) is not None:
        tape = tape.without(lengths.rows[~lengths.is_kept].tolist())
    return MetricResult(
        path.trajectory, offset, offset_s, estimate, scaled, predicted, weights, tape=tape, rivals=rivals,
        on_map=on_map,
    )  # fmt: skip


def bending_by_survey(survey: Survey, path: PathOfModel) -> MapBending:
    """Return how an unscaled model may be bent: by the bundle adjustment of its photos, or as a path without points."""
    return bending_of_model(path.sfm, path.trajectory, survey.camera, survey.refine, survey.mapper.num_threads)


def _refused_with_cause(
    error: GeometryError, survey: Survey, inputs: RangingInputs, path: PathOfModel
) -> GeometryError:
    """Return the refusal, with the likeliest mistake added if the ranges show one on a map with any uncertainty."""
    lenient, bending = survey.changed({"scale.max_relative_stddev": _ANY_STDDEV}), bending_by_survey(survey, path)
    try:
        estimate = estimate_scale(lenient, inputs, path, bending)
    except (GeometryError, np.linalg.LinAlgError):
        return error
    return _with_cause(error, survey, _ranges_on_scaled(estimate, path.trajectory, bending))


def _with_cause(error: GeometryError, survey: Survey, on_map: RangesOnMap | None) -> GeometryError:
    try:
        diagnosis = _diagnose(survey, on_map)
    except np.linalg.LinAlgError:
        return error
    return (
        GeometryError(f"{error}; {causes_in_words(diagnosis.causes)}")
        if diagnosis is not None and diagnosis.causes
        else error
    )


def _ranges_on_scaled(
    estimate: ScaleEstimate, trajectory: Trajectory, bending: MapBending | None
) -> RangesOnMap | None:
    """Return the ranges on the scaled map; a path without points is bent to the ranges. None without ranges."""
    if estimate.problem is None or estimate.solution is None:
        return None
    bending = bending or WalkBending(in_first_camera(trajectory))
    on_map = ranges_on_map(estimate.problem, estimate.solution, estimate.observations, trajectory, bending)
    return bent_to_ranges(on_map)


def _diagnose(survey: Survey, on_map: RangesOnMap | None) -> Diagnosis | None:
    return None if on_map is None else diagnose_ranges(on_map, seed=survey.output.seed)


def scale_by_rivals(
    survey: Survey, inputs: RangingInputs, path: PathOfModel, offset: TimeOffset, scale: float
) -> Rivals:
    """Estimate the scale for every other likely time offset.

    Args:
        survey: options.
        inputs: of the survey; their log has times.
        path: model with the ranges on its path.
        offset: estimate of the time offset, with its rivals.
        scale: at this offset, metres per SfM unit.

    Returns:
        Doubts in words, and the relative stddev of the scale that comes from the choice among the offsets: the larger
        of their stddev by their probabilities, and that whose 95 % interval holds the scales of all. Offsets with very
        different scales are left out of it; they are hardly likely, or there is an error.

    Raises:
        GeometryError: a very different scale follows from other offsets, and they are not unlikely.
    """
    assert inputs.log.timestamp_s is not None, "clocks belong to a log with times"
    doubts, far_apart = [], []
    far_probability, variance, farthest = 0.0, 0.0, 0.0
    for rival in offset.rivals:
        said = f"{rival.value_s:+.2f} s ({rival.probability:.0%})"
        offsets_s = offset.of_rival(rival).at(inputs.log.timestamp_s)
        try:
            observations = ranges_on_path(survey, inputs, path.trajectory, offsets_s)
            other = estimate_scale(survey, inputs, replace(path, observations=observations)).value
        except GeometryError:
            doubts.append(f"the time offset may also be {said}, which gives no scale")
            continue
        change = other / scale - 1
        doubts.append(f"the time offset may also be {said}, which gives a scale of {other:.6g} ({change:+.1%})")
        if abs(change) > _MAX_SPREAD:
            far_apart.append(f"{said} gives {other:.6g} ({change:+.1%})")
            far_probability += rival.probability
        else:
            apart = abs(float(np.log1p(change)))
            variance, farthest = variance + rival.probability * apart**2, max(farthest, apart)
    if far_probability > _HARDLY_LIKELY:
        raise GeometryError(
            "the motion does not determine the time offset, nor the scale that depends on it: "
            f"{offset.value_s:+.2f} s ({offset.probability:.0%}) gives {scale:.6g} m per unit, "
            f"{', '.join(far_apart)}: {REMEDY}"
        )
    return Rivals(tuple(doubts), max(float(np.sqrt(variance)), farthest / NORMAL_95))


def refine_map(survey: Survey, inputs: RangingInputs, metric: MetricResult, journal: Journal) -> MetricResult:
    """Refine a scaled map with its ranges. Where the refinement breaks the map, the scaled map stays the result.

    Raises:
        SolverError: the refinement broke the map, and the scaled map does not fit the photos either.
    """
    offset = metric.time_offset
    if offset is not None and not offset.is_certain and not survey.refine.time_offset_stddev_s:
        survey = survey.changed({"refine.time_offset_stddev_s": offset.stddev_s})
    tape = metric.tape or Tape()
    if inputs.anchor_frame == "site" and metric.estimate.frame != "site":
        # Too few anchors are surveyed to place the map in the site, but the distances between them are known.
        tape = tape.with_more(surveyed_distances(inputs.anchors))
    at_rest: list[MapWithRanges] = []

    def learn(rest: AtRest) -> Learnt:
        at_rest.append(_at_rest(metric, rest))
        learned = at_rest[0].learned()
        factor = at_rest[0].bending_factor(learned)
        return Learnt(learned.without(CLOCKS) if survey.refine.time_offset_stddev_s else learned, factor)

    estimate = metric.estimate
    has_ranges = estimate.problem is not None
    refined, summary = refine_by_survey(
        survey, inputs, metric.scaled, metric.trajectory, estimate, tape, learn if has_ranges else None
    )
    if survey.refine.covariance and summary.covariance is None:
        journal.warn("no covariance of the poses: too many keyframes, or photos and ranges do not determine all poses")
    broken = why_broken(metric.scaled, refined, metric.trajectory, estimate, summary, survey.refine.range_loss_scale)
    if broken and not point_errors(metric.scaled).fit:
        raise SolverError(
            f"the refinement broke the map: {'; '.join(broken)}; nor do the points of the model before it fit the "
            "photos: check that model, photos and camera parameters belong together (rangesfm scale gives the path "
            "alone)"
        )
    return replace(
        metric,
        refined=refined,
        refinement=summary,
        why_broken=broken,
        refined_with_ranges=at_rest[0] if at_rest else None,
    )


def _at_rest(metric: MetricResult, rest: AtRest) -> MapWithRanges:
    try:
        bending: MapBending = by_photos(rest.photos, rest.trajectory_m, rest.scale, is_at_optimum=False)
    except GeometryError:
        bending = WalkBending(in_first_camera(rest.trajectory_m, rest.scale))
    return MapWithRanges.of(
        metric.estimate,
        rest.trajectory_m,
        rest.scale,
        rest.tags_m,
        rest.centers_m,
        np.array([anchor.position_m for anchor in rest.anchors]),
        np.array([anchor.range_bias_m for anchor in rest.anchors]),
        rest.errors,
        bending,
    )


def judge_map(survey: Survey, metric: MetricResult, known_doubts: Sequence[Doubt], journal: Journal) -> MetricResult:
    """Judge the final map: add the final estimate of the scale, the tests of mistakes, all doubts and the place.

    The doubts also go to the journal as warnings, except for those that were known before.

    Raises:
        GeometryError: the scale is less certain than asked for.
    """
    metric, on_map = _estimated(survey, metric)
    diagnosis = diagnose_lengths(metric.estimate, metric.tape)
    try:
        if (of_ranges := _diagnose(survey, on_map)) is not None:
            diagnosis = of_ranges.with_more(diagnosis)
    except np.linalg.LinAlgError as error:
        journal.warn(f"mistakes were not tested, because the ranges determine too little: {error}")
    journal.warn(*(metric.estimate.reasons if metric.estimate.verdict != "good" else ()), *diagnosis.reasons)
    log, by_rivals = metric.observations.log, () if metric.rivals is None else metric.rivals.doubts
    doubts: list[Doubt] = []
    if metric.why_broken:
        reason = f"the refinement broke the map, so the scaled map is the result: {'; '.join(metric.why_broken)}"
        doubts.append(Doubt(reason, "check the model's points and cameras, clocks, lever arm and anchors"))
    doubts += doubts_of_map(
        metric.estimate,
        metric.kept_refinement,
        point_errors(metric.final),
        noise_is_given=survey.ranges.range_stddev_m is not None or bool(np.isfinite(log.range_stddev_m).any()),
    )
    journal.warn(*(doubt.reason for doubt in doubts), *by_rivals)
    doubts += known_doubts
    centers_m = metric.trajectory.as_in(metric.final).centers
    bent_by_m = np.zeros(0) if on_map is None else bends_m(on_map)
    place = place_of_map(metric.estimate, metric.kept_refinement, centers_m, doubts, bent_by_m)
    judged = replace(metric, place=place, diagnosis=diagnosis).doubted(by_rivals)
    judged = judged.doubted([doubt.reason for doubt in doubts], [doubt.advice for doubt in doubts])
    return judged.doubted(diagnosis.reasons)


def _estimated(survey: Survey, metric: MetricResult) -> tuple[MetricResult, RangesOnMap | None]:
    """Return the result with the estimate of the final map's scale, and the ranges on the final map.

    Raises:
        GeometryError: the scale is less certain than asked for.
    """
    start, at, learned = metric.estimate, metric.refined_with_ranges, None
    if at is not None and metric.kept_refinement is not None:
        learned = metric.kept_refinement.errors.learned
        on_map: RangesOnMap | None = ranges_on_map(at.posed, at.solution, at.observations, at.trajectory, at.bending)
    else:
        on_map = metric.on_map or _ranges_on_scaled(start, metric.trajectory, None)
    try:
        if at is not None and learned is not None:
            estimate = estimate_at(at, learned.subset(at.posed.rows), start, survey.scale)
        else:
            refuse_unknown(start.uncertainty.half_width_95, start.reasons, start.advice, survey.scale)
            estimate = replace(start, refined_value=None if metric.kept_refinement is None else metric.refined_scale)
    except GeometryError as error:
        raise _with_cause(error, survey, on_map) from None
    if metric.rivals is not None:
        estimate = replace(estimate, uncertainty=estimate.uncertainty.beside(CLOCKS, metric.rivals.stddev))
    return replace(metric, estimate=estimate), on_map

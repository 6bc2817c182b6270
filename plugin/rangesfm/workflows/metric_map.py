"""From unscaled models and ranges to the metric map, by a survey's options: ranges on paths, scale, refinement."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pycolmap

from rangesfm.arrays import Array
from rangesfm.colmap.reprojection import point_errors
from rangesfm.colmap.transform import rescale, without_photos
from rangesfm.distances.ends import surveyed_distances
from rangesfm.distances.tape import Tape
from rangesfm.errors import GeometryError, InputError, SolverError
from rangesfm.geometry.gravity import gravity_of
from rangesfm.geometry.trajectory import Trajectory, in_first_camera, trajectory_from_reconstruction
from rangesfm.join.models import ModelVerdict, PathOfModel, estimate_scale, join_models
from rangesfm.progress import Journal
from rangesfm.ranging.association import associate
from rangesfm.ranging.clock.estimate import REMEDY, TimeOffset, estimate_time_offset
from rangesfm.ranging.errors.bending import MapBending, WalkBending
from rangesfm.ranging.errors.components import CLOCKS
from rangesfm.ranging.log import RangeKind
from rangesfm.ranging.observations import RangeObservations, RangeStatus, hold_out
from rangesfm.refine.photo_bending import bending_of_model, by_photos
from rangesfm.refine.radio import predicted_ranges
from rangesfm.refine.with_ranges import AtRest, Learn, Learnt, RefineSummary, refine_with_ranges
from rangesfm.result.metric_result import MetricResult, Rivals
from rangesfm.scale.at_map import MapWithRanges, estimate_at
from rangesfm.scale.estimate import NORMAL_95, ScaleEstimate
from rangesfm.scale.verdict import refuse_unknown
from rangesfm.survey.inputs import RangingInputs
from rangesfm.survey.settings import Survey
from rangesfm.trust.bent_path import bends_m, bent_to_ranges, estimate_by_bent
from rangesfm.trust.finished_map import Doubt, doubts_of_map, place_of_map, why_broken
from rangesfm.trust.lengths import trust_in_lengths
from rangesfm.trust.linearized import RangesOnMap, ranges_on_map
from rangesfm.trust.verdict import TrustVerdict, sentence, trust_in
from rangesfm.vision.image_times import ImageTimes

# Scales of two clock offsets further apart than this are no answer, unless the others are hardly likely together.
_MAX_SPREAD = 0.03
_HARDLY_LIKELY = 0.05
_ANY_STDDEV = 1e3
# Relative stddev of a scale from which nothing can be refined: that of one that may as well be nothing.
_NOTHING_KNOWN = 1.0


def path_of_model(model: pycolmap.Reconstruction, times: ImageTimes | None) -> Trajectory:
    """The path of a model's photos; without their times where the log names photos."""
    if times is None:
        return trajectory_from_reconstruction(model)
    return trajectory_from_reconstruction(model, times.by_name(), time_resolution_s=times.resolution_s)


def path_with_times(
    survey: Survey, model: pycolmap.Reconstruction, times: ImageTimes | None, journal: Journal
) -> Trajectory:
    """The path of a model's photos that have a time, if the log needs any; InputError if none has."""
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
    """Search for the offset of the clocks where it is wanted and not given."""
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
    """The models with the ranges on their paths; of photos in several of them the first model keeps them.

    Args:
        trajectory: of the first model.
    """
    given_s, radio_times_s = survey.ranges.time_offset_s or 0.0, inputs.log.timestamp_s
    offsets_s = given_s if offset is None or radio_times_s is None else offset.at(radio_times_s)
    paths = [PathOfModel("sparse/0", models[0], trajectory, ranges_on_path(survey, inputs, trajectory, offsets_s))]
    names = set(trajectory.image_names)
    for k, model in enumerate(models[1:], start=1):
        rest = without_photos(model, names)
        path = path_of_model(rest, times)
        if not len(path):
            journal.warn(f"sparse/{k} is left out: its photos have no time, or are in other models too")
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
    """Ranges on the path; refused where the clocks cannot be right."""
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
    """``refine_with_ranges`` by a survey's options, from what the scale stage found.

    Args:
        scaled: in the metric world. trajectory: of the unscaled model, as the scale stage had it.
        tape: distances to keep to. learn: as of ``refine_with_ranges``.
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
    """All models that can be, as one."""
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
    """A map in metres, refined or not, judged as it is in the end.

    Raises:
        GeometryError: its scale is not determined, or not as well as asked for.
    """
    with journal.stage("scale"):
        metric = scale_by_survey(survey, inputs, path, offset, journal, is_a_start=refine)
    if refine:
        with journal.stage("refinement"):
            metric = refine_map(survey, inputs, metric, journal)
    with journal.timed("judgement"):
        return judge_map(survey, metric, journal)


def scale_by_survey(
    survey: Survey,
    inputs: RangingInputs,
    path: PathOfModel,
    offset: TimeOffset | None,
    journal: Journal,
    *,
    is_a_start: bool,
) -> MetricResult:
    """The map rescaled.

    Args:
        is_a_start: whether a refinement follows, by which it is judged then.
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
    predicted = predicted_ranges(
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
    """Of an unscaled model, as its photos hold it together, or as maps drift that have no points."""
    return bending_of_model(path.sfm, path.trajectory, survey.camera, survey.refine, survey.mapper.num_threads)


def _refused_with_cause(
    error: GeometryError, survey: Survey, inputs: RangingInputs, path: PathOfModel
) -> GeometryError:
    """A refusal with the mistake that the ranges show on the map all the same, if they show one."""
    lenient, bending = survey.changed({"scale.max_relative_stddev": _ANY_STDDEV}), bending_by_survey(survey, path)
    try:
        estimate = estimate_scale(lenient, inputs, path, bending)
    except (GeometryError, np.linalg.LinAlgError):
        return error
    return _with_cause(error, survey, _ranges_on_scaled(estimate, path.trajectory, bending))


def _with_cause(error: GeometryError, survey: Survey, on_map: RangesOnMap | None) -> GeometryError:
    try:
        trust = _trust_in(survey, on_map)
    except np.linalg.LinAlgError:
        return error
    return GeometryError(f"{error}; {sentence(trust.causes)}") if trust is not None and trust.causes else error


def _ranges_on_scaled(
    estimate: ScaleEstimate, trajectory: Trajectory, bending: MapBending | None
) -> RangesOnMap | None:
    """Where they have a path of poses alone; None where there are none."""
    if estimate.problem is None or estimate.solution is None:
        return None
    bending = bending or WalkBending(in_first_camera(trajectory))
    on_map = ranges_on_map(estimate.problem, estimate.solution, estimate.observations, trajectory, bending)
    return bent_to_ranges(on_map)


def _trust_in(survey: Survey, on_map: RangesOnMap | None) -> TrustVerdict | None:
    return None if on_map is None else trust_in(on_map, seed=survey.output.seed)


def scale_by_rivals(
    survey: Survey, inputs: RangingInputs, path: PathOfModel, offset: TimeOffset, scale: float
) -> Rivals:
    """Solve the scale for every rival of an offset.

    Args:
        scale: at the offset, metres per SfM unit.

    Returns:
        doubts in words, and the relative stddev of the scale by the choice: that of all the offsets by their
        probabilities, and no less than what makes a 95 % interval of it hold the scales of all; without those that are
        far apart, which are hardly likely then.

    Raises:
        GeometryError: the offset is not certain, and another scale follows from a rival.
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
            "the motion leaves the time offset open, and the scale with it: "
            f"{offset.value_s:+.2f} s ({offset.probability:.0%}) gives {scale:.6g} m per unit, "
            f"{', '.join(far_apart)}: {REMEDY}"
        )
    return Rivals(tuple(doubts), max(float(np.sqrt(variance)), farthest / NORMAL_95))


def refine_map(survey: Survey, inputs: RangingInputs, metric: MetricResult, journal: Journal) -> MetricResult:
    """The map refined with its ranges; the scaled one stays the result where the refined one is no map.

    Raises:
        SolverError: the scaled one is no map either.
    """
    offset = metric.time_offset
    if offset is not None and not offset.is_certain and not survey.refine.time_offset_stddev_s:
        survey = survey.changed({"refine.time_offset_stddev_s": offset.stddev_s})
    tape = metric.tape or Tape()
    if inputs.anchor_frame == "site" and metric.estimate.frame != "site":  # their positions could not be used
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
        journal.warn("no covariance of the poses: too many keyframes, or photos and ranges leave some of it open")
    broken = why_broken(metric.scaled, refined, metric.trajectory, estimate, summary, survey.refine.range_loss_scale)
    if broken and not point_errors(metric.scaled).fit:
        raise SolverError(
            f"the refinement broke the map: {'; '.join(broken)}; nor do the points of the model that it began with fit "
            "the photos: check that model, photos and the camera's parameters belong together (rangesfm scale gives "
            "the path alone)"
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


def judge_map(survey: Survey, metric: MetricResult, journal: Journal) -> MetricResult:
    """The finished map with all that is known of it, with all that speaks against it, which is told, and with the
    verdict on its place.

    Raises:
        GeometryError: its scale is less certain than asked for.
    """
    metric, on_map = _estimated(survey, metric)
    trust = trust_in_lengths(metric.estimate, metric.tape)
    try:
        if (of_ranges := _trust_in(survey, on_map)) is not None:
            trust = of_ranges.with_more(trust)
    except np.linalg.LinAlgError as error:
        journal.warn(f"mistakes were not looked for, as the ranges determine too little: {error}")
    journal.warn(*(metric.estimate.reasons if metric.estimate.verdict != "good" else ()), *trust.reasons)
    log, by_rivals = metric.observations.log, () if metric.rivals is None else metric.rivals.doubts
    doubts = []
    if metric.why_broken:
        reason = f"the refinement broke the map, which is left as scaled: {'; '.join(metric.why_broken)}"
        doubts.append(Doubt(reason, "check the model's points and cameras, clocks, lever arm and anchors"))
    doubts += doubts_of_map(
        metric.estimate,
        metric.kept_refinement,
        point_errors(metric.final),
        noise_is_given=survey.ranges.range_stddev_m is not None or bool(np.isfinite(log.range_stddev_m).any()),
    )
    journal.warn(*(doubt.reason for doubt in doubts), *by_rivals)
    centers_m = metric.trajectory.as_in(metric.final).centers
    bent_by_m = np.zeros(0) if on_map is None else bends_m(on_map)
    place = place_of_map(metric.estimate, metric.kept_refinement, centers_m, doubts, bent_by_m)
    judged = replace(metric, place=place, trust=trust).doubted(by_rivals)
    judged = judged.doubted([doubt.reason for doubt in doubts], [doubt.advice for doubt in doubts])
    return judged.doubted(trust.reasons)


def _estimated(survey: Survey, metric: MetricResult) -> tuple[MetricResult, RangesOnMap | None]:
    """With the scale of the final map, and the ranges on it."""
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

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
from rangesfm.geometry.trajectory import Trajectory, trajectory_from_reconstruction
from rangesfm.join.models import ModelVerdict, PathOfModel, estimate_scale, join_models
from rangesfm.progress import Journal
from rangesfm.ranging.association import associate
from rangesfm.ranging.clock.estimate import REMEDY, TimeOffset, estimate_time_offset
from rangesfm.ranging.errors.components import CLOCKS
from rangesfm.ranging.log import RangeKind
from rangesfm.ranging.observations import RangeObservations, RangeStatus, hold_out
from rangesfm.refine.radio import predicted_ranges
from rangesfm.refine.with_ranges import RefineSummary, refine_with_ranges
from rangesfm.result.metric_result import MetricResult
from rangesfm.scale.estimate import NORMAL_95, ScaleEstimate
from rangesfm.survey.inputs import RangingInputs
from rangesfm.survey.settings import Survey
from rangesfm.trust.finished_map import Doubt, doubts_of_map, place_of_map, why_broken
from rangesfm.trust.lengths import trust_in_lengths
from rangesfm.trust.linearized import ranges_on_map
from rangesfm.trust.verdict import TrustVerdict, sentence, trust_in
from rangesfm.vision.image_times import ImageTimes

# Scales of two clock offsets further apart than this are no answer, unless the others are hardly likely together.
_MAX_SPREAD = 0.03
_HARDLY_LIKELY = 0.05
_ANY_STDDEV = 1e3


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
) -> tuple[pycolmap.Reconstruction, RefineSummary]:
    """``refine_with_ranges`` by a survey's options, from what the scale stage found.

    Args:
        scaled: in the metric world. trajectory: of the unscaled model, as the scale stage had it.
        tape: distances to keep to.
    """
    errors = estimate.errors
    if survey.refine.time_offset_stddev_s and errors.learned is not None:
        errors = replace(errors, learned=errors.learned.without(CLOCKS))
    return refine_with_ranges(
        scaled,
        trajectory,
        estimate.observations,
        estimate.metric_from_sfm,
        estimate.anchors,
        errors,
        tag_in_cam_m=inputs.tag_in_cam_m,
        first_pose_is_fixed=estimate.frame != "site",
        gravity=gravity_of(survey.scale.up_in_first_camera),
        camera=survey.camera,
        options=survey.refine,
        tape=tape,
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


def scale_by_survey(
    survey: Survey, inputs: RangingInputs, path: PathOfModel, offset: TimeOffset | None, journal: Journal
) -> MetricResult:
    """The scale of a map, its doubts told, and the map rescaled."""
    if offset is not None and offset.offset_matters:
        path = replace(path, observations=replace(path.observations, time_offset_stddev_s=offset.stddev_s))
    try:
        estimate = estimate_scale(survey, inputs, path)
    except GeometryError as error:
        raise _with_cause(error, survey, inputs, path) from None
    by_rivals: tuple[str, ...] = ()
    if offset is not None and offset.rivals:
        by_rivals, stddev = scale_by_rivals(survey, inputs, path, offset, estimate.value)
        estimate = replace(estimate, uncertainty=estimate.uncertainty.beside(CLOCKS, stddev))
    journal.warn(*by_rivals, *(estimate.reasons if estimate.verdict != "good" else ()))
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
    metric = MetricResult(path.trajectory, offset, offset_s, estimate, scaled, predicted, weights, tape=tape)
    return _tested(survey, metric.doubted(by_rivals), journal)


def _with_cause(error: GeometryError, survey: Survey, inputs: RangingInputs, path: PathOfModel) -> GeometryError:
    """A refusal with the mistake that the ranges show on the map all the same, if they show one."""
    lenient = survey.changed({"scale.max_relative_stddev": _ANY_STDDEV})
    try:
        trust = _trust_in_ranges(survey, estimate_scale(lenient, inputs, path), path.trajectory)
    except (GeometryError, np.linalg.LinAlgError):
        return error
    return GeometryError(f"{error}; {sentence(trust.causes)}") if trust is not None and trust.causes else error


def _tested(survey: Survey, metric: MetricResult, journal: Journal) -> MetricResult:
    """The map with what the tests of mistakes say of it, and doubted if one was found.

    The scaled map is looked at, refined or not: a refinement bends a map to ranges that are wrong.
    """
    trust = trust_in_lengths(metric.estimate, metric.tape)
    try:
        if (of_ranges := _trust_in_ranges(survey, metric.estimate, metric.trajectory)) is not None:
            trust = of_ranges.with_more(trust)
    except np.linalg.LinAlgError as error:
        journal.warn(f"mistakes were not looked for, as the ranges determine too little: {error}")
    journal.warn(*trust.reasons)
    return replace(metric, trust=trust).doubted(trust.reasons)


def _trust_in_ranges(survey: Survey, estimate: ScaleEstimate, trajectory: Trajectory) -> TrustVerdict | None:
    """Of those on the scaled map; None where there are none."""
    if estimate.problem is None or estimate.solution is None:
        return None
    on_map = ranges_on_map(estimate.problem, estimate.solution, estimate.observations, trajectory)
    return trust_in(on_map, seed=survey.output.seed)


def scale_by_rivals(
    survey: Survey, inputs: RangingInputs, path: PathOfModel, offset: TimeOffset, scale: float
) -> tuple[tuple[str, ...], float]:
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
    return tuple(doubts), max(float(np.sqrt(variance)), farthest / NORMAL_95)


def refine_map(survey: Survey, inputs: RangingInputs, metric: MetricResult, journal: Journal) -> MetricResult:
    """The map refined with its ranges; the scaled one stays the result where that broke it.

    Raises:
        SolverError: the scaled one is no map either.
    """
    offset = metric.time_offset
    if offset is not None and not offset.is_certain and not survey.refine.time_offset_stddev_s:
        survey = survey.changed({"refine.time_offset_stddev_s": offset.stddev_s})
    tape = metric.tape or Tape()
    if inputs.anchor_frame == "site" and metric.estimate.frame != "site":  # their positions could not be used
        tape = tape.with_more(surveyed_distances(inputs.anchors))
    refined, summary = refine_by_survey(survey, inputs, metric.scaled, metric.trajectory, metric.estimate, tape)
    if survey.refine.covariance and summary.covariance is None:
        journal.warn("no covariance of the poses: too many keyframes, or photos and ranges leave some of it open")
    broken = why_broken(
        metric.scaled, refined, metric.trajectory, metric.estimate, summary, survey.refine.range_loss_scale
    )
    if broken and not point_errors(metric.scaled).fit:
        raise SolverError(
            f"the refinement broke the map: {'; '.join(broken)}; nor do the points of the model that it began with fit "
            "the photos: check that model, photos and the camera's parameters belong together (rangesfm scale gives "
            "the path alone)"
        )
    return replace(metric, refined=refined, refinement=summary, why_broken=broken)


def judge_map(survey: Survey, metric: MetricResult, journal: Journal) -> MetricResult:
    """The finished map with all that speaks against it, which is told, and with the verdict on its place."""
    log = metric.observations.log
    doubts = []
    if metric.why_broken:
        reason = f"the refinement broke the map, which is left as scaled: {'; '.join(metric.why_broken)}"
        doubts.append(Doubt(reason, "check the model's points and cameras, clocks, lever arm and anchors"))
    doubts += doubts_of_map(
        metric.estimate,
        metric.kept_refinement,
        None if metric.kept_refinement is None else metric.refined_scale,
        point_errors(metric.final),
        noise_is_given=survey.ranges.range_stddev_m is not None or bool(np.isfinite(log.range_stddev_m).any()),
    )
    journal.warn(*(doubt.reason for doubt in doubts))
    centers_m = metric.trajectory.as_in(metric.final).centers
    place = place_of_map(metric.estimate, metric.kept_refinement, centers_m, doubts)
    judged = replace(metric, place=place)
    return judged.doubted([doubt.reason for doubt in doubts], [doubt.advice for doubt in doubts])

"""The method, stage by stage: photos, scale, rescaling, refinement, comparison, results.

Lee, Zhu, Giorgi and Günther, "Fusion of Monocular Vision and Radio-based Ranging for Global
Scale Estimation and Drift Mitigation", 2018, with other means where real radios ask for them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import nullcontext, suppress
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt
import pycolmap

from rangesfm.ceres.doctor import versions
from rangesfm.colmap.merge import without_photos
from rangesfm.colmap.model_files import read_model
from rangesfm.colmap.passthrough import apply_options
from rangesfm.colmap.transform import rescale
from rangesfm.compare.with_reference import format_table, papers_table, reference_in_frame
from rangesfm.distances.ends import locate_distances
from rangesfm.distances.rows import disagreements, distance_rows
from rangesfm.distances.surveyed import surveyed_distances
from rangesfm.distances.tape import Tape
from rangesfm.errors import GeometryError, InputError
from rangesfm.export import COVARIANCE_FORMATS, check_formats
from rangesfm.files.sole_writer import sole_writer
from rangesfm.geometry.georeference import Georeference
from rangesfm.geometry.reference import write_reference
from rangesfm.geometry.trajectory import Trajectory
from rangesfm.join.models import PathOfModel, Ranging, join_models
from rangesfm.progress import Progress
from rangesfm.ranging.association import associate
from rangesfm.ranging.clock.estimate import TimeOffset, estimate_time_offset
from rangesfm.ranging.log import RangeKind
from rangesfm.ranging.observations import RangeObservations, RangeStatus, hold_out
from rangesfm.refine.radio import predicted_ranges
from rangesfm.report import write_report
from rangesfm.result.content import survey_result
from rangesfm.result.metric_result import MetricResult, ModelVerdict
from rangesfm.result.outputs import (
    forget_result,
    refuse_to_overwrite,
    replacing_result,
    summary_lines,
    write_outputs,
    write_result,
    write_scale_tables,
)
from rangesfm.scale.initialize import initialize_scale
from rangesfm.survey.input_hashes import input_hashes
from rangesfm.survey.inputs import RangingInputs, read_ranging_inputs, times_of_model
from rangesfm.survey.settings import Survey
from rangesfm.vision.image_times import ImageTimes, find_image_times, list_images
from rangesfm.vision.keyframes import select_keyframes
from rangesfm.vision.mapping_loop import GlobalAdjustment
from rangesfm.vision.reconstruct import prepare_submaps, reconstruct
from rangesfm.vision.submaps import Submap
from rangesfm.workflows.journal import Journal
from rangesfm.workflows.ranges_in_mapping import AdjustmentWithRanges
from rangesfm.workflows.survey_stages import path_of_model, refine_by_survey

_Done = TypeVar("_Done")


@dataclass(frozen=True)
class RunResult:
    """What a run left.

    Attributes:
        output_path: its folder.
        result: the content of ``result.json``; after a reconstruction alone, seconds and warnings.
        lines: a summary for people.
    """

    output_path: Path
    result: dict[str, Any]
    lines: tuple[str, ...]

    def summary_lines(self) -> list[str]:
        return list(self.lines)


def run_survey(survey: Survey, *, progress: Progress, restart: bool = False) -> RunResult:
    """Photos and ranges to a metric model. Steps of the reconstruction that are done are reused."""
    journal = Journal(progress)
    inputs, keyframes, times = _checked_inputs(survey, journal)
    with sole_writer(survey.output_path):
        adjustment = AdjustmentWithRanges(survey, inputs, keyframes[0], times)
        models = _reconstruct(
            survey, keyframes, journal, restart, adjustment if survey.mapper.ranges_in_mapping else None
        )
        if note := adjustment.note():
            journal.warn(note)
        return _to_metric(survey, inputs, models, times, journal, refine=survey.refine.enabled)


def prepare_survey(survey: Survey, *, progress: Progress, restart: bool = False) -> tuple[Submap, ...]:
    """What ``run_survey`` does before it maps the photos.

    Returns:
        The submaps that are to be mapped yet; whoever has them mapped (``Submap.map``), wherever, in any order and at
        once, saves ``run_survey`` doing it. None where the photos are mapped in one piece.
    """
    journal = Journal(progress)
    _, keyframes, _ = _checked_inputs(survey, journal)
    with sole_writer(survey.output_path):
        return _with_photos(prepare_submaps, survey, keyframes, journal, restart)


def reconstruct_survey(survey: Survey, *, progress: Progress, restart: bool = False) -> RunResult:
    """Photos to an unscaled model."""
    journal = Journal(progress)
    if survey.mapper.ranges_in_mapping:
        journal.warn("ranges_in_mapping: nothing has been said of ranges here, they take part in a whole run")
    keyframes, _ = _keyframes(survey, journal)
    with sole_writer(survey.output_path):
        sfm = _reconstruct(survey, keyframes, journal, restart)[0]
    path = survey.output_path / "sparse" / "0"
    line = f"unscaled model: {sfm.num_reg_images()} photos, {sfm.num_points3D()} points, in {path}"
    return RunResult(survey.output_path, {"seconds": journal.all_seconds(), "warnings": journal.warnings}, (line,))


def refine_model(survey: Survey, *, progress: Progress) -> RunResult:
    """An existing model and ranges to the refined metric model."""
    return _from_model(survey, progress, refine=True)


def scale_model(survey: Survey, *, progress: Progress) -> RunResult:
    """An existing model, or only its trajectory, and ranges to the scaled model."""
    return _from_model(survey, progress, refine=False)


def _from_model(survey: Survey, progress: Progress, *, refine: bool) -> RunResult:
    journal = Journal(progress)
    inputs = _read_inputs(survey, journal)
    if survey.model_path is None:
        raise InputError("no model: give --input_path MODEL, a COLMAP model as sparse/0")
    sfm = _read_registered(survey.model_path)
    if refine and not sfm.num_points3D():
        raise InputError("the model has no 3-D points to refine: a trajectory can only be scaled", survey.model_path)
    times = None
    if inputs.log.image_name is None:
        times = _noted(times_of_model(survey, sfm, survey.model_path), journal)
    with sole_writer(survey.output_path):
        return _to_metric(survey, inputs, [sfm], times, journal, refine=refine)


def _to_metric(
    survey: Survey,
    inputs: RangingInputs,
    models: Sequence[pycolmap.Reconstruction],
    times: ImageTimes | None,
    journal: Journal,
    *,
    refine: bool,
) -> RunResult:
    """From the unscaled models on: the same for photos just mapped and for a model brought along."""
    trajectory = path_of_model(models[0], times)
    if not len(trajectory):
        first = min(image.name for image in models[0].images.values())
        raise InputError(f"none of the model's photos has a time, the first is {first}", survey.image_times_path)
    if num_without_time := models[0].num_reg_frames() - len(trajectory):
        num = models[0].num_reg_frames()
        journal.warn(f"{num_without_time} of {num} photos of the model have no time and are left out")
    _check_times(survey, inputs, trajectory)
    # Clocks: where on the path each range was taken.
    offset = _time_offset(survey, inputs, trajectory, journal)
    paths = _paths(survey, inputs, models, trajectory, times, offset, journal)
    return map_in_metres(survey, inputs, paths, offset, journal, refine=refine)


def map_in_metres(
    survey: Survey,
    inputs: RangingInputs,
    paths: Sequence[PathOfModel],
    offset: TimeOffset | None,
    journal: Journal,
    *,
    refine: bool,
    must_join: bool = False,
) -> RunResult:
    """From the models and the ranges on their paths on: scale, refinement and results of all of them as one map.

    Args:
        paths: of the log in ``inputs``; to the first one the others are joined, or left out.
        offset: of the clocks, if it was estimated.
        must_join: whether it is an error if all others are left out.
    """
    # Scale, and the metric map that follows from it.
    with journal.stage("scale"):
        path, verdicts = _joined(survey, inputs, paths, journal, must_join=must_join)
        metric = replace(_scale(survey, inputs, path, offset), models=verdicts)
    for doubt in metric.estimate.reasons if metric.estimate.verdict != "good" else ():
        journal.warn(doubt)
    # Global refinement: photos and ranges together.
    if refine:
        with journal.stage("refinement"):
            metric = _refine(survey, inputs, metric)
        if metric.refinement is not None and not metric.refinement.converged:
            journal.warn(f"the refinement stopped before it converged: {metric.refinement.message}")
        if metric.refinement is not None and survey.refine.covariance and metric.refinement.covariance is None:
            journal.warn("no covariance of the poses: too many keyframes, or photos and ranges leave some of it open")
        for misfit in metric.refinement.misfits if metric.refinement is not None else ():
            journal.warn(f"after the refinement {misfit}")
    if not metric.center_covariance_m2 and (left_out := set(COVARIANCE_FORMATS) & set(survey.export.formats)):
        journal.warn(f"without covariances of the poses there is no {', '.join(sorted(left_out))}")
    # Comparison and results.
    return _write_results(survey, inputs, metric, journal)


def _write_results(survey: Survey, inputs: RangingInputs, metric: MetricResult, journal: Journal) -> RunResult:
    """All files of the result, ``result.json`` after all others, and the report on them."""
    if metric.estimate.frame == "site":
        metric = metric.moved(inputs.site.offset_m)
    distances = _distances(inputs, metric)
    disagreeing = tuple(disagreements(distances, metric.estimate.uncertainty.empirical))
    for note in disagreeing:
        journal.warn(note)
    metric = metric.doubted(disagreeing)
    result = survey_result(metric)
    with replacing_result(survey.output_path):
        with journal.stage("results"):
            result["distances"] = distances
            table = _compare(survey, inputs, metric, result)
            georeference = _georeference(inputs, metric)
            result["georeference"] = georeference and georeference.to_dict()
            write_outputs(
                metric, survey.export, survey.output_path, images_path=survey.images_path, georeference=georeference
            )
            write_scale_tables(metric, survey.output_path)
        result["versions"], result["settings"] = versions(), survey.to_dict()
        result["inputs"] = input_hashes(survey)
        result["seconds"], result["warnings"] = journal.all_seconds(), journal.warnings
        write_result(result, survey.output_path / "result.json")
    lines = [*summary_lines(metric, result, table, survey.output_path)]
    if survey.report_enabled:
        lines.append(f"report: {write_report(survey.output_path)}")
    return RunResult(survey.output_path, result, tuple(lines))


def _read_inputs(survey: Survey, journal: Journal) -> RangingInputs:
    """Everything that can be wrong is found before the long work begins."""
    check_formats(survey.export.formats)
    with survey.naming_its_lines():
        apply_options(pycolmap.BundleAdjustmentOptions(), survey.refine.bundle_adjustment, "refine.bundle_adjustment")
    refuse_to_overwrite(
        (
            survey.ranges.path,
            survey.ranges.error_curve_path,
            survey.anchors_path,
            survey.image_times_path,
            survey.reference_path,
            survey.model_path,
        ),
        survey.output_path,
    )
    inputs = read_ranging_inputs(survey)
    for note in inputs.notes:
        journal.warn(note)
    return inputs


def _checked_inputs(survey: Survey, journal: Journal) -> tuple[RangingInputs, tuple[str, ...], ImageTimes | None]:
    """Ranges and photos that have to do with each other; the photos' times, where any are needed."""
    inputs = _read_inputs(survey, journal)
    keyframes, times = _keyframes(survey, journal, log_names_photos=inputs.log.image_name is not None)
    _check_times(survey, inputs, _path_without_places(keyframes, times))
    return inputs, keyframes, times


def _keyframes(
    survey: Survey, journal: Journal, *, log_names_photos: bool | None = None
) -> tuple[tuple[str, ...], ImageTimes | None]:
    """The photos to reconstruct and their times; without times, where none are needed, in the order of their names.

    Args:
        log_names_photos: then no photo is left out for want of a time; None: there is no log.
    """
    folder = _images_path(survey)
    with journal.timed("keyframes"):
        names = list_images(folder)
        image_times = None
        with nullcontext() if survey.image_times_path or log_names_photos is False else suppress(InputError):
            image_times = find_image_times(folder, names, survey.image_times_path)
        if image_times is None or (log_names_photos and not survey.image_times_path and image_times.num_left_out):
            return select_keyframes(names, survey.keyframes), None
        keyframes = select_keyframes(image_times, survey.keyframes)
        return keyframes, _noted(image_times, journal).of(keyframes)


def _check_times(survey: Survey, inputs: RangingInputs, path: Trajectory) -> None:
    """Refuse a reference and ranges that have nothing to do with these photos; where they were does not matter."""
    reference, offset_s = inputs.reference, survey.ranges.time_offset_s
    if reference is not None and not np.isfinite(reference.positions_at(path)[0]).any():
        raise InputError(reference.why_nothing_is_known(path), survey.reference_path)
    if inputs.log.image_name is not None or offset_s is not None:
        _observations(survey, inputs, path, offset_s or 0.0)


def _path_without_places(keyframes: tuple[str, ...], times: ImageTimes | None) -> Trajectory:
    n = len(keyframes)
    timestamps_s = None if times is None else times.timestamps_s
    return Trajectory(np.arange(n), keyframes, timestamps_s, np.zeros((n, 3)), np.tile(np.eye(3), (n, 1, 1)))


def _reconstruct(
    survey: Survey,
    keyframes: tuple[str, ...],
    journal: Journal,
    restart: bool,
    adjustment: GlobalAdjustment | None = None,
) -> tuple[pycolmap.Reconstruction, ...]:
    """Map the keyframes into ``sparse``; returns ``sparse/0``, ``sparse/1``, ..."""
    summary = _with_photos(partial(reconstruct, adjustment=adjustment), survey, keyframes, journal, restart)
    journal.seconds.update(summary.seconds)
    if summary.num_registered < summary.num_keyframes:
        which = "the model" if len(summary.models) == 1 else f"the largest of {len(summary.models)} models"
        journal.warn(f"{summary.num_registered} of {summary.num_keyframes} keyframes are in {which}")
    return summary.models


def _with_photos(
    do: Callable[..., _Done], survey: Survey, keyframes: tuple[str, ...], journal: Journal, restart: bool
) -> _Done:
    """Call ``reconstruct``, or a part of it, for the keyframes of a survey."""
    with survey.naming_its_lines():
        return do(
            _images_path(survey),
            keyframes,
            survey.output_path,
            camera=survey.camera,
            mapper=survey.mapper,
            seed=survey.seed,
            progress=journal.progress,
            restart=restart,
            before_change=lambda: forget_result(survey.output_path),
        )


def _images_path(survey: Survey) -> Path:
    if survey.images_path is None:
        raise InputError("no photos: give [images] path in a survey file, or --images FOLDER")
    return survey.images_path


def _noted(image_times: ImageTimes, journal: Journal) -> ImageTimes:
    for note in image_times.notes:
        journal.warn(note)
    return image_times


def _read_registered(path: Path) -> pycolmap.Reconstruction:
    model = read_model(path)
    if not model.num_reg_images():
        raise InputError("the model has no registered images", path)
    return model


def _time_offset(survey: Survey, inputs: RangingInputs, trajectory: Trajectory, journal: Journal) -> TimeOffset | None:
    """Search for the offset of the clocks where it is wanted and not given."""
    if inputs.log.image_name is not None or survey.ranges.time_offset_s is not None:
        return None
    with journal.stage("time offset"):
        offset = estimate_time_offset(
            inputs.log,
            trajectory,
            inputs.tag_in_cam_m,
            association=survey.ranges.association,
            seed=survey.seed,
            progress=journal.progress,
        )
    if offset.note:
        journal.warn(offset.note)
    return offset


def _paths(
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
    offset_s = offset.value_s if offset is not None else survey.ranges.time_offset_s
    radio_times_s = inputs.log.timestamp_s
    offsets_s = (offset_s or 0.0) if offset is None or radio_times_s is None else offset.at(radio_times_s)
    paths = [PathOfModel("sparse/0", models[0], trajectory, _observations(survey, inputs, trajectory, offsets_s))]
    names = set(trajectory.image_names)
    for k, model in enumerate(models[1:], start=1):
        rest = without_photos(model, names)
        path = path_of_model(rest, times)
        if not len(path):
            journal.warn(f"sparse/{k} is left out: its photos have no time, or are in other models too")
            continue
        names.update(path.image_names)
        observations = hold_out(_on_path(survey, inputs, path, offsets_s), survey.ranges.checks, survey.seed)
        paths.append(PathOfModel(f"sparse/{k}", rest, path, observations))
    return paths


def _joined(
    survey: Survey, inputs: RangingInputs, paths: Sequence[PathOfModel], journal: Journal, *, must_join: bool
) -> tuple[PathOfModel, tuple[ModelVerdict, ...]]:
    """All models that can be, as one."""
    if len(paths) == 1:
        return paths[0], ()
    ranging = Ranging(inputs.anchors, inputs.anchor_frame, survey.scale, survey.ranges.model, inputs.tape, survey.seed)
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


def _scale(survey: Survey, inputs: RangingInputs, path: PathOfModel, offset: TimeOffset | None) -> MetricResult:
    sfm, trajectory, observations = path.sfm, path.trajectory, path.observations
    distances = None
    if inputs.tape is not None:
        distances = locate_distances(inputs.tape, sfm, observations.log.anchor_ids)
    estimate = initialize_scale(
        observations,
        trajectory,
        inputs.anchors,
        anchor_frame=inputs.anchor_frame,
        options=survey.scale,
        range_model=survey.ranges.model,
        distances=distances,
        seed=survey.seed,
    )
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
    return MetricResult(trajectory, offset, offset_s, estimate, scaled, predicted, weights)


def _observations(
    survey: Survey, inputs: RangingInputs, trajectory: Trajectory, offset_s: float | npt.NDArray[np.float64]
) -> RangeObservations:
    """Ranges on the path; refused where the clocks cannot be right."""
    observations = _on_path(survey, inputs, trajectory, offset_s)
    if not observations.has_place.any():
        raise InputError(
            _why_no_range_has_a_place(observations, trajectory, float(np.mean(offset_s))), survey.ranges.path
        )
    return hold_out(observations, survey.ranges.checks, survey.seed)


def _on_path(
    survey: Survey, inputs: RangingInputs, trajectory: Trajectory, offset_s: float | npt.NDArray[np.float64]
) -> RangeObservations:
    return associate(
        inputs.log, trajectory, inputs.tag_in_cam_m, time_offset_s=offset_s, options=survey.ranges.association
    )


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


def _refine(survey: Survey, inputs: RangingInputs, metric: MetricResult) -> MetricResult:
    refined, summary = refine_by_survey(
        survey, inputs, metric.scaled, metric.trajectory, metric.estimate, _control(inputs, metric)
    )
    return replace(metric, refined=refined, refinement=summary)


def _control(inputs: RangingInputs, metric: MetricResult) -> Tape:
    """What was taped, and the distances between surveyed anchors where their positions could not be used."""
    tape = inputs.tape or Tape()
    if inputs.anchor_frame != "site" or metric.estimate.frame == "site":
        return tape
    return replace(tape, distances=tape.distances + surveyed_distances(inputs.anchors))


def _georeference(inputs: RangingInputs, metric: MetricResult) -> Georeference | None:
    """Of the final map: that of the anchors, if the map could be carried to them."""
    return inputs.site.georeference if metric.estimate.frame == "site" else None


def _distances(inputs: RangingInputs, metric: MetricResult) -> list[dict[str, Any]]:
    """The table of control and check distances in the final map."""
    if inputs.tape is None:
        return []
    located = locate_distances(inputs.tape, metric.final, [anchor.anchor_id for anchor in metric.anchors])
    anchors_m = np.array([anchor.position_m for anchor in metric.anchors]).reshape(-1, 3)
    return distance_rows(inputs.tape, located.lengths_m(1.0, anchors_m))


def _compare(survey: Survey, inputs: RangingInputs, metric: MetricResult, result: dict[str, Any]) -> str | None:
    """Add the paper's table to the result where there is a reference; returns it as text."""
    if inputs.reference is None:
        return None
    frame = metric.estimate.frame
    scaled = metric.path_of(metric.scaled)
    refined = None if metric.refined is None else metric.path_of(metric.refined)
    rows = papers_table(scaled, refined, inputs.reference, frame=frame)
    result["comparison"] = [asdict(row) for row in rows]
    in_frame = reference_in_frame(refined or scaled, inputs.reference, frame=frame)
    if in_frame is not None:
        write_reference(in_frame, survey.output_path / "reference.csv")
    return format_table(rows)

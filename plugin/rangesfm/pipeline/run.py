"""The method, stage by stage: photos, scale, rescaling, refinement, comparison, results.

It follows Lee, Zhu, Giorgi and Günther, "Fusion of Monocular Vision and Radio-based Ranging for Global Scale Estimation
and Drift Mitigation", 2018, with other estimators where real radios need them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import pycolmap

from rangesfm.errors import GeometryError, InputError
from rangesfm.measurements.imu.sensor import InertialSensor
from rangesfm.measurements.lengths.markers import locatable
from rangesfm.measurements.lengths.tape import Tape
from rangesfm.measurements.positions.clock import find_antenna_offset
from rangesfm.measurements.positions.surveyed_positions import SurveyedPositions
from rangesfm.pipeline.close_loops import close_loops_of_models
from rangesfm.pipeline.join_models import join_models, tie_by_photos
from rangesfm.pipeline.make_metric_map import metric_map, with_likeliest_cause
from rangesfm.pipeline.map_photos import (
    begin_run,
    find_keyframes,
    map_keyframes,
    read_registered,
    refuse_to_overwrite,
    result_names,
    with_keyframes,
    with_photos_in_folder,
    with_tags,
    with_times,
)
from rangesfm.pipeline.metric_result import MetricResult
from rangesfm.pipeline.place_ranges import place_ranges
from rangesfm.pipeline.plan_again import with_advice
from rangesfm.pipeline.run_results import RunResult, write_results
from rangesfm.progress import SILENT, Journal, Progress
from rangesfm.result.summary import ResultSummary
from rangesfm.sfm.rigs import read_rigs
from rangesfm.survey.photo_times import times_of_model
from rangesfm.survey.settings import Survey
from rangesfm.survey.survey_run import PathOfModel, SurveyRun
from rangesfm.util.files.atomic import sole_writer
from rangesfm.util.geometry.numerics import NORMAL_95
from rangesfm.util.processes.threads import at_most, with_one_blas_thread


@with_one_blas_thread
def run_survey(survey: Survey, *, progress: Progress = SILENT, restart: bool = False) -> RunResult:
    """Make the metric model of a survey and write the result folder, as ``rangesfm run`` does.

    Args:
        survey: settings and inputs. It has either photos or an unscaled model.
        progress: is told of stages and warnings; None: nobody is.
        restart: whether to do all steps again; otherwise finished steps of an earlier run are reused.

    Returns:
        The result; ``print`` shows the lines that the command prints at its end.

    Raises:
        InputError: an input is wrong.
        GeometryError: the scale is not determined.
        ReconstructionError: the photos give no model.
        SolverError: the refinement failed.
    """
    if survey.images.model is None:
        return _from_photos(survey, progress, restart=restart)
    return _from_model(survey, progress, refine=survey.refine.enabled, or_scale=True)


def _from_photos(survey: Survey, progress: Progress, *, restart: bool) -> RunResult:
    run = begin_run(survey, Journal(progress))
    with sole_writer(survey.output.path) as output, at_most(survey.mapper.num_threads):
        output.require_own(output.path / name for name in result_names(survey))
        run = replace(run, survey=with_photos_in_folder(survey, run.journal, restart=restart))
        run, keyframes = with_keyframes(run)
        run = with_tags(run, keyframes)
        # An earlier result keeps its reconstruction until the new result is complete.
        deferred = (output.path / ResultSummary.NAME).exists()
        models = map_keyframes(run.survey, keyframes, run.journal, restart, deferred=deferred)
        paths = tie_by_photos(run, place_ranges(run, models))
        return with_results(run, map_in_metres(run, paths, refine=survey.refine.enabled))


def reconstruct_survey(survey: Survey, *, progress: Progress = SILENT, restart: bool = False) -> list[str]:
    """Make an unscaled model from photos, and return a summary for the user."""
    journal = Journal(progress)
    refuse_to_overwrite(survey)
    with sole_writer(survey.output.path), at_most(survey.mapper.num_threads):
        survey = with_photos_in_folder(survey, journal, restart=restart)
        keyframes, _ = find_keyframes(survey, journal)
        models = map_keyframes(survey, keyframes, journal, restart, deferred=False)
        sfm = close_loops_of_models(survey, models, journal)
    path = survey.output.path / "sparse" / "0"
    return [f"unscaled model: {sfm.num_reg_images()} photos, {sfm.num_points3D()} points, in {path}"]


def refine_model(survey: Survey, *, progress: Progress = SILENT) -> RunResult:
    """Make a refined metric model from an existing model and ranges, and write the result folder."""
    return _from_model(survey, progress, refine=True)


def scale_model(survey: Survey, *, progress: Progress = SILENT) -> RunResult:
    """Scale an existing model, or a model with poses only, by ranges, and write the result folder."""
    return _from_model(survey, progress, refine=False)


@with_one_blas_thread
def _from_model(survey: Survey, progress: Progress, *, refine: bool, or_scale: bool = False) -> RunResult:
    """Scale or refine a given model; ``or_scale``: a model without points is scaled where it should be refined."""
    run = begin_run(survey, Journal(progress))
    sfm = read_registered(survey.given_model_path, run.journal)
    if refine and or_scale and not sfm.num_points3D():
        run.journal.note("the model has no 3-D points: it is scaled, and not refined")
        refine = False
    if refine and not sfm.num_points3D():
        raise InputError("the model has no 3-D points to refine: a trajectory can only be scaled", survey.images.model)
    with sole_writer(survey.output.path) as output, at_most(survey.mapper.num_threads):
        output.require_own(output.path / name for name in result_names(survey))
        run = replace(run, survey=with_photos_in_folder(survey, run.journal))
        return with_results(run, map_of_model(run, sfm, refine=refine))


def map_of_model(run: SurveyRun, sfm: pycolmap.Reconstruction, *, refine: bool) -> MetricResult:
    """Scale the model that a survey gives, and refine it if asked for; nothing is written.

    Args:
        run: the survey.
        sfm: its model.
        refine: whether to refine the map after scaling it.
    """
    if run.inputs.needs_times:
        times = times_of_model(run.survey, sfm, run.survey.given_model_path)
        run.journal.note(*times.assumed)
        run.journal.warn(*times.notes)
        run = with_times(run, times)
    names = sorted(image.name for image in sfm.images.values())
    run = with_tags(run.with_photos(names, "the map"), names)
    return map_in_metres(run, place_ranges(run, [sfm]), refine=refine)


def map_in_metres(
    run: SurveyRun, paths: Sequence[PathOfModel], *, refine: bool, must_join: bool = False
) -> MetricResult:
    """Join models with ranges to one map, scale and refine it, and judge it.

    Args:
        run: the survey.
        paths: models with the ranges of its log on their paths. The others are joined to the first, or left out.
        refine: whether to refine the map after scaling it.
        must_join: whether it is an error if all others are left out.

    Returns:
        The map, no longer in the local frame of the inputs but in the coordinates that were given, where these are
        metres. If a mistake was adopted, its inputs are corrected.
    """
    with run.journal.stage("scale"):
        path, verdicts = join_models(run, paths, must_join=must_join)
        images = run.survey.images
        baselines = read_rigs(images.rig_config).baselines(path.sfm, images.baseline_stddev_m)
        tape = run.inputs.tape.with_more(baselines)
        positions = _positions_on_path(run, path)
        run.journal.warn(*positions.notes_on(path.sfm))
        tape_in_map = locatable(tape, path.sfm) if tape.distances else Tape()
        run = replace(run, inputs=replace(run.inputs, tape=tape_in_map, positions=positions))
        run = replace(run, inputs=replace(run.inputs, imu=_imu_on_path(run, path)))
    # Scale, refinement of photos and ranges together, and judgement of the final map.
    made = replace(metric_map(run, path, refine=refine), models=verdicts)
    if run.survey.scale.adopt:
        made = with_likeliest_cause(run, made)
    return made.in_given_coordinates()


def _positions_on_path(run: SurveyRun, path: PathOfModel) -> SurveyedPositions:
    """Return the known positions with the time offset of the antenna's, which are left out if nothing tells it.

    Raises:
        InputError: the photos have no times. GeometryError: nothing tells the offset, and nothing else is measured.
    """
    positions = run.inputs.positions
    if positions.antenna is None:
        return positions
    try:
        return replace(positions, antenna=find_antenna_offset(positions.antenna, path.trajectory))
    except GeometryError as error:
        if not len(run.inputs.log) and not positions.points.points:
            raise
        run.journal.warn(f"the positions of the antenna are not used: {error}")
        return replace(positions, antenna=None)


def _imu_on_path(run: SurveyRun, path: PathOfModel) -> InertialSensor | None:
    """Return the inertial sensor aligned with the photos, after warnings; it is left out if these do not tell how.

    Raises:
        InputError: the photos have no times, or were not taken while the sensor was recorded. GeometryError: the turns
            do not tell how the sensor sits, and nothing else is measured.
    """
    if run.inputs.imu is None:
        return None
    try:
        aligned = run.inputs.imu.aligned_with(path.trajectory)
    except GeometryError as error:
        if {*run.survey.metric_keys} <= {"imu.path"}:
            raise
        run.journal.warn(f"the inertial sensor is not used: {error}")
        return None
    if (found := aligned.alignment) is not None:
        run.journal.warn(*found.mistakes)
        half_s = NORMAL_95 * found.time_offset_stddev_s
        offset = f"{found.time_offset_s:+.4f} +- {half_s:.4f} s (95 %)"
        run.journal.note(f"time offset of the inertial sensor: {offset}, by {found.num_turns} turns of the photos")
    return aligned


def with_results(run: SurveyRun, made: MetricResult) -> RunResult:
    """Add advice for the next survey to a map, compare it with the reference, and write all results."""
    with run.journal.stage("advice"):
        advised = with_advice(made)
    return write_results(run, advised)

"""The method, stage by stage: photos, scale, rescaling, refinement, comparison, results.

It follows Lee, Zhu, Giorgi and Günther, "Fusion of Monocular Vision and Radio-based Ranging for Global Scale Estimation
and Drift Mitigation", 2018, with other estimators where real radios need them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import TypeVar

import pycolmap

from rangesfm.errors import GeometryError, InputError
from rangesfm.measurements.kind_as_read import KindAsRead
from rangesfm.measurements.kinds_in_words import KINDS_IN_WORDS
from rangesfm.measurements.lengths.locate_lengths import locatable
from rangesfm.measurements.lengths.tape import Tape
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
    with_times_of_model,
)
from rangesfm.pipeline.metric_result import MetricResult
from rangesfm.pipeline.place_ranges import place_ranges
from rangesfm.pipeline.plan_again import with_advice
from rangesfm.pipeline.run_results import write_results
from rangesfm.progress import SILENT, Journal, Progress
from rangesfm.result.result_folder import ResultFolder
from rangesfm.result.summary import ResultSummary
from rangesfm.sfm.rigs import read_rigs
from rangesfm.survey.settings import Survey
from rangesfm.survey.survey_run import PathOfModel, SurveyRun
from rangesfm.util.files.output_folder import sole_writer
from rangesfm.util.geometry.gravity import gravity_of
from rangesfm.util.geometry.trajectory import Trajectory
from rangesfm.util.processes.threads import at_most, with_one_blas_thread

_Sensor = TypeVar("_Sensor")


@with_one_blas_thread
def run_survey(survey: Survey, *, progress: Progress = SILENT, restart: bool = False) -> ResultFolder:
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


def _from_photos(survey: Survey, progress: Progress, *, restart: bool) -> ResultFolder:
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


def refine_model(survey: Survey, *, progress: Progress = SILENT) -> ResultFolder:
    """Make a refined metric model from an existing model and ranges, and write the result folder."""
    return _from_model(survey, progress, refine=True)


def scale_model(survey: Survey, *, progress: Progress = SILENT) -> ResultFolder:
    """Scale an existing model, or a model with poses only, by ranges, and write the result folder."""
    return _from_model(survey, progress, refine=False)


@with_one_blas_thread
def _from_model(survey: Survey, progress: Progress, *, refine: bool, or_scale: bool = False) -> ResultFolder:
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
    run = with_times_of_model(run, sfm)
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
        run = _with_clocks(run, paths[0].trajectory)  # where another model is joined may depend on the clocks
        path, verdicts = join_models(run, paths, must_join=must_join)
        run = _in_map(run, path.sfm)
    # Scale, refinement of photos and ranges together, and judgement of the final map.
    made = replace(metric_map(run, path, refine=refine), models=verdicts)
    if run.survey.scale.adopt:
        made = with_likeliest_cause(run, made)
    return made.in_given_coordinates()


def _with_clocks(run: SurveyRun, path: Trajectory) -> SurveyRun:
    """Return the survey with the clocks of its sensors, as found on a path; errors are those of ``_or_left_out``."""
    positions, others = run.inputs.positions, dict[str, KindAsRead]()
    timed, without = partial(positions.on_path, path), replace(positions, antenna=None)
    positions = _or_left_out(run, "positions.path", "positions of the antenna are", timed, without)
    run.journal.warn(*positions.warnings_on_path)
    for words in KINDS_IN_WORDS:
        if (each := run.inputs.others.get(words.kind)) is None:
            continue
        what = f"{words.words} {words.verb}"
        found = _or_left_out(run, f"{words.kind}.path", what, partial(each.on_path, path), None)
        if found is not None:
            run.journal.warn(*found.warnings_on_path)
            run.journal.note(*found.notes_on_path)
            others[words.kind] = found
    inputs, doubts = replace(run.inputs, positions=positions, others=others), tuple(positions.doubts_of_clock)
    return replace(run, inputs=inputs, doubts=doubts)


def _or_left_out(run: SurveyRun, key: str, what: str, find: Callable[[], _Sensor], without: _Sensor) -> _Sensor:
    """Return a sensor with its clock, or without it after a warning if nothing tells the clock.

    Args:
        key: of the file that it is read from. what: words for it. find: returns it with its clock.

    Raises:
        GeometryError: nothing tells the clock, and nothing else is measured. InputError: as of ``find``.
    """
    try:
        return find()
    except GeometryError as error:
        if {*run.survey.metric_keys} <= {key}:
            raise
        run.journal.warn(f"the {what} not used: {error}")
        return without


def _in_map(run: SurveyRun, sfm: pycolmap.Reconstruction) -> SurveyRun:
    """Return the survey with the lengths that are in a model, those of its rigs among them, after warnings."""
    images, tape = run.survey.images, run.inputs.tape
    tape = tape.with_more(read_rigs(images.rig_config).baselines(sfm, images.baseline_stddev_m))
    run.journal.warn(*run.inputs.positions.notes_on(sfm))
    in_map = locatable(tape, sfm) if tape.distances else Tape()
    if lost := [taped for taped in tape.distances if taped not in in_map.distances and not taped.is_printed]:
        run.journal.warn(
            f"{len(lost)} of {len(tape.distances)} measured lengths are left out, as marks of their ends do not meet "
            f"(by drift of the poses, or as they are of several points): "
            f"{', '.join(' to '.join(taped.ends) for taped in lost)}"
        )
    return replace(run, inputs=replace(run.inputs, tape=in_map))


def with_results(run: SurveyRun, made: MetricResult) -> ResultFolder:
    """Add advice for the next survey to a map, compare it with the reference, and write all results."""
    with run.journal.stage("advice"):
        advised = with_advice(made, gravity_of(run.survey.scale.up_in_first_camera))
    return write_results(run, advised)

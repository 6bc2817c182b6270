"""The method, stage by stage: photos, scale, rescaling, refinement, comparison, results.

It follows Lee, Zhu, Giorgi and Günther, "Fusion of Monocular Vision and Radio-based Ranging for Global Scale Estimation
and Drift Mitigation", 2018, with other estimators where real radios need them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import pycolmap

from rangesfm.distances.locate_lengths import locatable
from rangesfm.distances.tape import Tape
from rangesfm.errors import InputError
from rangesfm.files.atomic import sole_writer
from rangesfm.join.join_models import PathOfModel
from rangesfm.processes.threads import at_most, with_one_blas_thread
from rangesfm.progress import Journal, Progress
from rangesfm.ranging.clock.time_offset import TimeOffset
from rangesfm.result.result_folder import refuse_to_overwrite, result_names
from rangesfm.result.summary import ResultSummary
from rangesfm.survey.inputs import RangingInputs, times_of_model
from rangesfm.survey.settings import Survey
from rangesfm.vision.image_times import ImageTimes
from rangesfm.vision.rigs import read_rigs
from rangesfm.workflows.adoption import with_likeliest_cause
from rangesfm.workflows.make_metric_map import (
    find_time_offset,
    join_by_survey,
    metric_map,
    path_with_times,
    ranges_on_paths,
)
from rangesfm.workflows.map_photos import (
    check_times,
    checked_keyframes,
    find_keyframes,
    map_keyframes,
    read_inputs,
    read_registered,
    tell_of_times,
    with_photos_in_folder,
    with_tags,
)
from rangesfm.workflows.plan_again import with_advice
from rangesfm.workflows.run_results import RunResult, write_results


def metric_map_of(survey: Survey, *, progress: Progress, restart: bool = False) -> RunResult:
    """Make the metric model of a survey, from its photos or from the unscaled model that it gives."""
    if survey.images.model is None:
        return run_survey(survey, progress=progress, restart=restart)
    return (refine_model if survey.refine.enabled else scale_model)(survey, progress=progress)


@with_one_blas_thread
def run_survey(survey: Survey, *, progress: Progress, restart: bool = False) -> RunResult:
    """Make a metric model from photos and ranges, and write the result folder.

    Args:
        survey: settings and inputs.
        progress: is told of stages and warnings.
        restart: whether to do all steps again; otherwise finished steps of an earlier run are reused.

    Raises:
        InputError: an input is wrong.
        GeometryError: the scale is not determined.
        ReconstructionError: the photos give no model.
        SolverError: the refinement failed.
    """
    journal = Journal(progress)
    inputs = read_inputs(survey, journal)
    with sole_writer(survey.output.path) as output, at_most(survey.mapper.num_threads):
        output.require_own(output.path / name for name in result_names(survey))
        survey = with_photos_in_folder(survey, journal, restart=restart)
        keyframes, times = checked_keyframes(survey, inputs, journal)
        inputs = with_tags(survey, inputs, keyframes, journal)
        # An earlier result keeps its reconstruction until the new result is complete.
        deferred = (output.path / ResultSummary.NAME).exists()
        models = map_keyframes(survey, keyframes, journal, restart, deferred=deferred)
        return to_metric(survey, inputs, models, times, journal, refine=survey.refine.enabled)


def reconstruct_survey(survey: Survey, *, progress: Progress, restart: bool = False) -> list[str]:
    """Make an unscaled model from photos, and return a summary for the user."""
    journal = Journal(progress)
    refuse_to_overwrite(survey)
    with sole_writer(survey.output.path), at_most(survey.mapper.num_threads):
        survey = with_photos_in_folder(survey, journal, restart=restart)
        keyframes, _ = find_keyframes(survey, journal)
        sfm = map_keyframes(survey, keyframes, journal, restart, deferred=False)[0]
    path = survey.output.path / "sparse" / "0"
    return [f"unscaled model: {sfm.num_reg_images()} photos, {sfm.num_points3D()} points, in {path}"]


def refine_model(survey: Survey, *, progress: Progress) -> RunResult:
    """Make a refined metric model from an existing model and ranges, and write the result folder."""
    return _from_model(survey, progress, refine=True)


def scale_model(survey: Survey, *, progress: Progress) -> RunResult:
    """Scale an existing model, or a model with poses only, by ranges, and write the result folder."""
    return _from_model(survey, progress, refine=False)


@with_one_blas_thread
def _from_model(survey: Survey, progress: Progress, *, refine: bool) -> RunResult:
    journal = Journal(progress)
    inputs = read_inputs(survey, journal)
    sfm = read_registered(survey.given_model_path, journal)
    if refine and not sfm.num_points3D():
        raise InputError("the model has no 3-D points to refine: a trajectory can only be scaled", survey.images.model)
    times = None
    with sole_writer(survey.output.path) as output, at_most(survey.mapper.num_threads):
        output.require_own(output.path / name for name in result_names(survey))
        survey = with_photos_in_folder(survey, journal)
        if inputs.log.image_name is None:
            times = times_of_model(survey, sfm, survey.given_model_path)
            journal.warn(*times.notes)
            tell_of_times(survey, inputs, times, journal)
        inputs = with_tags(survey, inputs, sorted(image.name for image in sfm.images.values()), journal)
        return to_metric(survey, inputs, [sfm], times, journal, refine=refine)


def to_metric(
    survey: Survey,
    inputs: RangingInputs,
    models: Sequence[pycolmap.Reconstruction],
    times: ImageTimes | None,
    journal: Journal,
    *,
    refine: bool,
) -> RunResult:
    """Do all stages after the unscaled models, which were just mapped or were given."""
    trajectory = path_with_times(survey, models[0], times, journal)
    check_times(survey, inputs, trajectory)
    # Time offset between the clocks, and with it the place of each range on the path.
    offset = find_time_offset(survey, inputs, trajectory, journal)
    paths = ranges_on_paths(survey, inputs, models, trajectory, times, offset, journal)
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
    """Join models with ranges to one map, scale and refine it, and write the results.

    Args:
        survey: options.
        inputs: of the survey.
        paths: models with the ranges of ``inputs.log`` on their paths. The others are joined to the first, or left out.
        offset: estimate of the time offset; None where it is given or not needed.
        journal: for stages and warnings.
        refine: whether to refine the map after scaling it.
        must_join: whether it is an error if all others are left out.
    """
    with journal.timed("scale"):
        path, verdicts = join_by_survey(survey, inputs, paths, journal, must_join=must_join)
        tape = (inputs.tape or Tape()).with_more(
            read_rigs(survey.images.rig_config).baselines(path.sfm, survey.images.baseline_stddev_m)
        )
        inputs = replace(inputs, tape=locatable(tape, path.sfm) if tape.distances else None)
    # Scale, refinement of photos and ranges together, and judgement of the final map.
    made = replace(metric_map(survey, inputs, path, offset, journal, refine=refine), models=verdicts)
    if survey.scale.adopt:
        inputs, made = with_likeliest_cause(survey, inputs, path, made, journal)
    # Comparison and results.
    judged = with_advice(made, inputs.tag_in_cam_m)
    return write_results(survey, inputs, judged, journal)

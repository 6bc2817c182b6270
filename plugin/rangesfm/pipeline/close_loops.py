"""Closing of loops: the map at rest proposes pairs of photos, which are matched, tested and used, in rounds.

A refined map has its metres from any kind of measurement. The model of a mapper is in any unit, and closes its loops by
its photos alone.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import pycolmap

from rangesfm.colmap.model_files import write_binary_model
from rangesfm.colmap.reprojection import point_errors
from rangesfm.errors import GeometryError, InputError, SolverError
from rangesfm.estimation.map_problem import MapProblem
from rangesfm.estimation.photo_bending import LARGEST_FACTOR
from rangesfm.estimation.refinement import MapAtRest, joint_errors, refine, refine_with_loops
from rangesfm.estimation.vision_information import Loop
from rangesfm.pipeline.metric_result import MetricResult
from rangesfm.pipeline.refine_map import refine_closed_map
from rangesfm.progress import Journal, Progress
from rangesfm.result.result_folder import RESULT_NAMES
from rangesfm.sfm.loop_database import LoopMatching, has_closed_loops
from rangesfm.sfm.loops.loop_finder import LoopFinder
from rangesfm.sfm.loops.rounds import MAX_NUM_ROUNDS, LoopClosure, find_loops
from rangesfm.sfm.matching import matching_options
from rangesfm.sfm.steps import DATABASE_NAME, MODELS_NAME, Workspace
from rangesfm.survey.settings import Survey
from rangesfm.survey.survey_run import SurveyRun
from rangesfm.util.files.output_folder import OutputFolder, sole_writer
from rangesfm.util.geometry.map_errors import MapErrors
from rangesfm.util.geometry.trajectory import Trajectory, trajectory_from_reconstruction

_Map = TypeVar("_Map")
"""A refined map whose loops can be closed."""


def loop_matching(survey: Survey, progress: Progress, output: OutputFolder) -> LoopMatching | None:
    """Return the matching of pairs that may be loops; None where loops are not to be closed."""
    is_given = survey.images.model is not None
    source = survey.mapper.database_path if is_given else output.newest(output.path / DATABASE_NAME)
    if not survey.mapper.close_loops or source is None or not source.is_file():
        return None
    with pycolmap.Database.open(source) as database:
        num_photos = database.num_images()
    options = matching_options(survey.mapper, num_photos, survey.output.seed)
    return LoopMatching(source, options, progress, output) if is_given or options.is_in_time_only else None


def close_loops_of_survey(run: SurveyRun, metric: MetricResult) -> MetricResult:
    """Return a refined map with its loops closed; the same map where they are not to be closed.

    Raises:
        InputError: the given database does not belong to the given model.
    """
    if not run.survey.mapper.close_loops or metric.kept is None:
        return metric
    with sole_writer(run.survey.output.path) as output:
        if (matching := loop_matching(run.survey, run.journal.progress, output)) is None:
            return metric
        if not metric.kept.covariance.are_known:
            run.journal.warn("loops are not closed, because the covariance of the poses is not known")
            return metric
        if why_not := matching.why_unfit(metric.final):
            matching.discard()
            if run.survey.images.model is not None:
                raise InputError(why_not, run.survey.mapper.database_path)
            return metric

        def close(
            before: MetricResult, found: Sequence[Loop], is_last: bool
        ) -> tuple[MetricResult, Sequence[str]] | None:
            del is_last  # its covariance is that of the result
            closed = refine_closed_map(run, before, found, matching.merge_tracks)
            return None if closed is None or closed.refined is None else (closed, closed.refined.why_broken)

        last, loops = _close_in_rounds(run.journal, matching, metric, _finder_in, close, by_likeness=False)
        output.defer(matching.places)
        if loops.contradicted:
            first, second = (last.final.image(image_id).name for image_id in min(loops.contradicted))
            run.journal.warn(
                f"{len(loops.contradicted)} pairs of photos match but contradict the measurements, and are not used;"
                f" the first is {first} and {second}, and loops.csv has all"
            )
        assert last.refined is not None, "a refined map"
        # The bend that the ranges took out of the map is that of the first refinement; the others began with its map.
        return replace(last, refined=replace(last.refined, bend_m=metric.kept.bend_m, loops=loops))


def close_loops_of_models(
    survey: Survey, models: Sequence[pycolmap.Reconstruction], journal: Journal
) -> pycolmap.Reconstruction:
    """Close the loops of the largest model of a reconstruction, in its place, and return the model.

    Where they are not to be closed, or an earlier run has closed them, the model stays as it is. Results that were made
    from the model before are removed.

    Args:
        models: of the output folder, which has their database and record.
    """
    with sole_writer(survey.output.path) as output:
        if has_closed_loops(Workspace(output.path, journal.progress)):
            return models[0]
        if (matching := loop_matching(survey, journal.progress, output)) is None:
            return models[0]
        try:
            model, tried = _closed_by_photos(survey, journal, matching, models[0])
        except (GeometryError, SolverError) as error:
            journal.warn(f"loops are not closed: {error}")
            matching.discard()
            return models[0]
        matching.keep_closed()
        wrong = f"; {len(tried.contradicted)} contradict the model and were not used" if tried.contradicted else ""
        journal.progress.message(
            f"loops: {len(tried.proposed)} pairs of photos may show the same place; {len(tried.verified)} of them "
            f"match; {len(tried.closed)} were used to close loops{wrong}"
        )
        new, superseded = matching.places, list[Path]()
        if tried.closed:
            staged = new[output.path / MODELS_NAME / "0"] = matching.folder / "model"
            staged.mkdir(exist_ok=True)
            write_binary_model(model, staged)
            superseded = [output.path / name for name in RESULT_NAMES]
        output.publish(new, superseded)
        matching.discard()
        return model if tried.closed else models[0]


def _close_in_rounds(
    journal: Journal,
    matching: LoopMatching,
    refined: _Map,
    finder_in: Callable[[_Map], LoopFinder],
    close: Callable[[_Map, Sequence[Loop], bool], tuple[_Map, Sequence[str]] | None],
    *,
    by_likeness: bool,
) -> tuple[_Map, LoopClosure]:
    """Close the loops of a map, and return the last map with the pairs of all rounds.

    The test of a loop takes the errors of the map for small. A map that is bent by metres contradicts true loops until
    others have straightened it. So where loops contradict the map, another round tests them again in the next map. If
    they are few, this only tells which of them still do; otherwise more are proposed and closed. It ends where nothing
    new is found. The matches of closed loops stay in the database, and what was tried in vain.

    Args:
        refined: the map. finder_in: of the loops of a map.
        close: returns a map refined with loops, and what shows that it broke; None if they are closed in the map. Its
            last argument says whether no more loops are to be proposed in the map that it returns.
        by_likeness: as for ``find_loops``.
    """
    tried = LoopClosure(finder_in(refined).path)
    for _ in range(MAX_NUM_ROUNDS):
        if not (finder := finder_in(refined)).map_errors.are_known:
            break
        may_close = tried.promises_more
        with journal.stage("loops"):
            loops, tried = find_loops(finder, matching, tried, by_likeness=by_likeness)
        if not (loops and may_close):
            break
        closed = replace(tried, closed=tried.closed.union(loops))
        matching.keep(closed.proposed, closed.verified, closed.closed)
        with journal.stage("refinement"):
            after = close(refined, list(loops.values()), not closed.promises_more)
        if after is None:
            break
        if after[1]:
            journal.warn(f"loops are left open, because the map broke: {'; '.join(after[1])}")
            break
        refined, tried = after[0], closed
        if not tried.contradicted:
            break
    matching.keep(tried.proposed, tried.verified, tried.closed)
    return refined, tried


def _finder_in(metric: MetricResult) -> LoopFinder:
    refined = metric.kept
    assert refined is not None, "a refined map"
    path = metric.trajectory.as_in(refined.model)
    return LoopFinder(refined.model, path, refined.covariance, refined.pixel_stddev)


def _closed_by_photos(
    survey: Survey, journal: Journal, matching: LoopMatching, model: pycolmap.Reconstruction
) -> tuple[pycolmap.Reconstruction, LoopClosure]:
    """Close the loops of a mapper's model, and return it at rest with the pairs of all rounds.

    Raises:
        GeometryError: the photos do not belong to the model, or do not determine it. SolverError: the solver failed.
    """
    if why_not := matching.why_unfit(model):
        raise GeometryError(why_not)
    path = trajectory_from_reconstruction(model)

    def finder_in(rest: MapAtRest, errors: MapErrors) -> LoopFinder:
        closed = rest.problem.metric
        return LoopFinder(closed, path.as_in(closed), errors, rest.run.pixel_stddev)

    def close(before: LoopFinder, loops: Sequence[Loop], is_last: bool) -> tuple[LoopFinder, Sequence[str]] | None:
        problem = _problem(survey, path, before.model, is_refined=True)
        rest = refine_with_loops(problem, (), loops, matching.merge_tracks, with_equations=not is_last)
        if rest is None:
            return None
        errors = point_errors(rest.problem.metric)
        # Those of the last map before its loops were closed were larger.
        after = finder_in(rest, before.map_errors if is_last else _errors_alone(rest))
        return after, () if errors.fit else (errors.apart("the refined map"),)

    with journal.stage("refinement"):
        rest = refine(_problem(survey, path, model, is_refined=False))
    start = finder_in(rest, _errors_alone(rest))
    if not start.map_errors.are_known:
        raise GeometryError("the covariance of the poses is not known")
    last, tried = _close_in_rounds(journal, matching, start, lambda finder: finder, close, by_likeness=True)
    return last.model, tried


def _errors_alone(at_rest: MapAtRest) -> MapErrors:
    """Return the errors of a map that is bent as much as photos usually bend maps, since nothing tells how much."""
    return joint_errors(at_rest, LARGEST_FACTOR)


def _problem(survey: Survey, path: Trajectory, model: pycolmap.Reconstruction, *, is_refined: bool) -> MapProblem:
    return MapProblem(
        pycolmap.Reconstruction(model),
        (),
        path.frame_ids,
        survey.camera,
        survey.refine,
        first_pose_is_fixed=True,
        num_threads=survey.mapper.num_threads,
        is_refined=is_refined,
    )

"""Closing of loops: the map at rest proposes pairs of photos, which are matched, tested and used, in rounds.

A refined map has its metres from any kind of measurement. The model of a mapper is in any unit, and closes its loops by
its photos alone.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import pycolmap

from rangesfm.colmap.colmap_log import colmap_log
from rangesfm.colmap.model_files import write_binary_model
from rangesfm.colmap.reprojection import point_errors
from rangesfm.errors import GeometryError, InputError, SolverError
from rangesfm.estimation.map_problem import MapProblem
from rangesfm.estimation.photo_bending import LARGEST_FACTOR
from rangesfm.estimation.refinement import MapAtRest, MergeTracks, joint_errors, refine, refine_with_loops
from rangesfm.estimation.vision_information import LoopPoses
from rangesfm.pipeline.metric_result import MetricResult
from rangesfm.pipeline.refine_map import refine_closed_map
from rangesfm.progress import Journal, Progress
from rangesfm.result.result_folder import RESULT_NAMES
from rangesfm.sfm.loop_database import LoopMatching, Pair, has_closed_loops
from rangesfm.sfm.loops.loop_closure import LoopClosure
from rangesfm.sfm.loops.loop_finder import LoopFinder
from rangesfm.sfm.loops.merge import merge_tracks
from rangesfm.sfm.loops.resection import Loop
from rangesfm.sfm.loops.rounds import TriedPairs, close_in_rounds, find_in
from rangesfm.sfm.matching import matching_options
from rangesfm.sfm.photos_alike import pairs_alike
from rangesfm.sfm.steps import DATABASE_NAME, MODELS_NAME, Workspace
from rangesfm.survey.settings import Survey
from rangesfm.survey.survey_run import SurveyRun
from rangesfm.util.files.output_folder import OutputFolder, sole_writer
from rangesfm.util.geometry.map_errors import MapErrors
from rangesfm.util.geometry.trajectory import Trajectory, trajectory_from_reconstruction

if TYPE_CHECKING:
    from typing_extensions import Self


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
        if not metric.kept.summary.covariance.are_known:
            run.journal.warn("loops are not closed, because the covariance of the poses is not known")
            return metric
        if why_not := matching.why_unfit(metric.final):
            matching.discard()
            if run.survey.images.model is not None:
                raise InputError(why_not, run.survey.mapper.database_path)
            return metric
        last, tried = close_in_rounds(_MetricMap(run.survey, run.journal, matching, run, metric))
        last.keep(tried)
        matching.publish(output)
        closed, contradicted = (
            tuple((last.model.image(first).name, last.model.image(second).name) for first, second in sorted(pairs))
            for pairs in (tried.closed, tried.contradicted)
        )
        before, after = metric.kept, last.metric.refined
        assert after is not None, "a refined map"
        path = metric.trajectory.as_in(before.model)
        loops = LoopClosure(len(tried.proposed), len(tried.verified), closed, contradicted, path)
        run.journal.warn(*filter(None, [loops.warning]))
        # The bend that the ranges took out of the map is that of the first refinement; the others began with its map.
        summary = replace(after.summary, bend_m=before.summary.bend_m)
        return replace(last.metric, refined=replace(after, summary=summary, loops=loops))


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
            if why_not := matching.why_unfit(models[0]):
                raise GeometryError(why_not)
            with journal.stage("refinement"):
                path = trajectory_from_reconstruction(models[0])
                at_rest = refine(_problem(survey, path, models[0], is_refined=False))
            start = _UnscaledMap(survey, journal, matching, path, at_rest, _errors_alone(at_rest))
            if start.finder is None:
                raise GeometryError("the covariance of the poses is not known")
            last, tried = close_in_rounds(start)
        except (GeometryError, SolverError) as error:
            journal.warn(f"loops are not closed: {error}")
            matching.discard()
            return models[0]
        last.keep(tried)
        matching.keep_closed()
        wrong = f"; {len(tried.contradicted)} contradict the model and were not used" if tried.contradicted else ""
        journal.progress.message(
            f"loops: {len(tried.proposed)} pairs of photos may show the same place; {len(tried.verified)} of them "
            f"match; {len(tried.closed)} were used to close loops{wrong}"
        )
        if not tried.closed:
            matching.publish_with(output)
            return models[0]
        staged = matching.folder / "model"
        staged.mkdir(exist_ok=True)
        write_binary_model(last.model, staged)
        place = output.path / MODELS_NAME / "0"
        matching.publish_with(output, {place: staged}, [output.path / name for name in RESULT_NAMES])
        return last.model


@dataclass(frozen=True)
class _MatchedMap(ABC):
    """A map at rest with the matching of its photos."""

    survey: Survey
    journal: Journal
    matching: LoopMatching

    @property
    @abstractmethod
    def model(self) -> pycolmap.Reconstruction:
        """The map."""

    @property
    @abstractmethod
    def finder(self) -> LoopFinder | None:
        """Of its loops; None if the errors of its poses are not known."""

    @property
    @abstractmethod
    def why_broken(self) -> tuple[str, ...]:
        """What shows that the map is broken; empty if nothing does."""

    @abstractmethod
    def with_loops(self, loops: LoopPoses, merge: MergeTracks, *, is_last: bool) -> Self | None:
        """Return the map refined with loops, relative poses by ids of frames; None if they are closed in it.

        Args:
            is_last: whether no more loops are to be proposed in that map.
        """

    def alike(self, known: Mapping[int, Set[int]]) -> list[Pair]:
        """Return pairs of photos that look alike; arguments as of ``find_in``."""
        del known
        return []

    def neighbours(self) -> Mapping[int, Set[int]]:
        """Return photos that tell the same; as of ``find_in``."""
        return {}

    def find(self, tried: TriedPairs) -> tuple[list[Loop], TriedPairs]:
        if self.finder is None:
            return [], tried
        with self.journal.stage("loops"):
            matching = self.matching
            return find_in(self.finder, matching.match, matching.known(), tried, self.alike, self.neighbours())

    def with_closed(self, loops: Sequence[Loop], tried: TriedPairs) -> Self | None:
        self.keep(tried)
        assert self.finder is not None, "it has found the loops"

        def merge(model: pycolmap.Reconstruction) -> None:
            with colmap_log(self.matching.log):
                merge_tracks(model, self.matching.database, seed=self.survey.output.seed)

        with self.journal.stage("refinement"):
            closed = self.with_loops(self.finder.relative_poses(loops), merge, is_last=not tried.promise_more)
        if closed is not None and (why := closed.why_broken):
            self.journal.warn(f"loops are left open, because the map broke: {'; '.join(why)}")
            return None
        return closed

    def keep(self, tried: TriedPairs) -> None:
        """Keep the matches of closed loops alone in the database, and what was tried in vain."""
        self.matching.keep(tried.proposed, tried.verified, tried.closed)


@dataclass(frozen=True)
class _MetricMap(_MatchedMap):
    """A refined map of a survey."""

    run: SurveyRun
    metric: MetricResult

    @property
    def model(self) -> pycolmap.Reconstruction:
        return self.metric.final

    @cached_property
    def finder(self) -> LoopFinder | None:
        refined, path = self.metric.kept, self.metric.trajectory
        if refined is None or not refined.summary.covariance.are_known:
            return None
        errors = refined.summary.covariance
        seed = self.survey.output.seed
        return LoopFinder.in_refined_map(refined.model, path, errors, refined.summary.pixel_stddev, seed)

    @property
    def why_broken(self) -> tuple[str, ...]:
        return () if self.metric.refined is None else self.metric.refined.why_broken

    def with_loops(self, loops: LoopPoses, merge: MergeTracks, *, is_last: bool) -> _MetricMap | None:
        del is_last
        closed = refine_closed_map(self.run, self.metric, loops, merge)
        return None if closed is None else replace(self, metric=closed)


@dataclass(frozen=True)
class _UnscaledMap(_MatchedMap):
    """The model of a mapper, whose photos are matched as far as they look alike, too.

    Attributes:
        trajectory: of its keyframes. at_rest: the model, with no measurements but its photos.
        errors: of its poses; of the last map those before its loops were closed, which were larger.
    """

    trajectory: Trajectory
    at_rest: MapAtRest
    errors: MapErrors

    @property
    def model(self) -> pycolmap.Reconstruction:
        return self.at_rest.problem.metric

    @cached_property
    def finder(self) -> LoopFinder | None:
        if not self.errors.are_known:
            return None
        pixel_stddev, seed = self.at_rest.pixel_stddev, self.survey.output.seed
        return LoopFinder.in_refined_map(self.model, self.trajectory, self.errors, pixel_stddev, seed)

    @property
    def why_broken(self) -> tuple[str, ...]:
        errors = point_errors(self.model)
        return () if errors.fit else (errors.apart("the refined map"),)

    def with_loops(self, loops: LoopPoses, merge: MergeTracks, *, is_last: bool) -> _UnscaledMap | None:
        problem = _problem(self.survey, self.trajectory, self.model, is_refined=True)
        rest = refine_with_loops(problem, problem, loops, merge, with_equations=not is_last)
        if rest is None:
            return None
        return replace(self, at_rest=rest, errors=self.errors if is_last else _errors_alone(rest))

    def neighbours(self) -> Mapping[int, Set[int]]:
        return self.matching.known()

    def alike(self, known: Mapping[int, Set[int]]) -> list[Pair]:
        matching = self.matching
        return pairs_alike(matching.database, known, matching.log, max_num=1, seed=self.survey.output.seed)


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

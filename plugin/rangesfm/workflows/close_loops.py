"""Closing of loops by the options of a survey: the refined map proposes pairs, which are matched, tested and used."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import pycolmap

from rangesfm.colmap.colmap_log import colmap_log
from rangesfm.errors import InputError
from rangesfm.estimation.refinement import MapAtRest
from rangesfm.estimation.vision_information import LoopPoses
from rangesfm.files.output_folder import sole_writer
from rangesfm.geometry.trajectory import Trajectory
from rangesfm.loops.loop_closure import LoopClosure
from rangesfm.loops.loop_finder import LoopFinder
from rangesfm.loops.merge import merge_tracks
from rangesfm.loops.resection import Loop
from rangesfm.loops.rounds import TriedPairs, close_in_rounds, find_in
from rangesfm.survey.survey_run import SurveyRun
from rangesfm.workflows.loop_matching import LoopMatching
from rangesfm.workflows.metric_result import MetricResult


@dataclass(frozen=True)
class RefinedMap:
    """A refined map as a result, and at rest with its equations."""

    metric: MetricResult
    at_rest: MapAtRest


MergeTracks = Callable[[pycolmap.Reconstruction], None]
Refine = Callable[[SurveyRun, RefinedMap, LoopPoses, MergeTracks], RefinedMap]
"""Closes loops of a map and refines it again."""


def close_loops_of_survey(run: SurveyRun, refined: RefinedMap, refine: Refine) -> MetricResult:
    """Return a refined map with its loops closed; the same map where they are not to be closed.

    Args:
        run: the survey. refine: closes loops and refines the map again.

    Raises:
        InputError: the given database does not belong to the given model.
    """
    metric = refined.metric
    if not run.survey.mapper.close_loops or metric.kept_refinement is None:
        return metric
    with sole_writer(run.survey.output.path) as output:
        if (matching := LoopMatching.for_survey(run, output)) is None:
            return metric
        if metric.map_errors is None:
            run.journal.warn("loops are not closed, because the covariance of the poses is not known")
            return metric
        if why_not := matching.database.why_unfit(metric.final):
            matching.database.discard()
            if run.survey.images.model is not None:
                raise InputError(why_not, run.survey.mapper.database_path)
            return metric
        last, tried = close_in_rounds(_RefinedMap(run, refined, matching, refine))
        last.keep(tried)
        matching.database.publish(output)
        return _told(run, metric, last.refined.metric, tried)


@dataclass(frozen=True)
class _RefinedMap:
    """A refined map with the matching of its photos."""

    run: SurveyRun
    refined: RefinedMap
    matching: LoopMatching
    refine: Refine

    def find(self, tried: TriedPairs) -> tuple[list[Loop], TriedPairs]:
        if (finder := self._finder) is None:
            return [], tried
        with self.run.journal.stage("loops"):
            return find_in(finder, self.matching.match, self.matching.database.known(), tried)

    def with_closed(self, loops: Sequence[Loop], tried: TriedPairs) -> _RefinedMap | None:
        self.keep(tried)
        finder, database = self._finder, self.matching.database
        assert finder is not None, "it has found the loops"

        def merge(model: pycolmap.Reconstruction) -> None:
            with colmap_log(database.log):
                merge_tracks(model, database.path, seed=finder.seed)

        with self.run.journal.stage("refinement"):
            refined = self.refine(self.run, self.refined, finder.relative_poses(loops), merge)
        if why := refined.metric.why_broken:
            self.run.journal.warn(f"loops are left open, because the map broke: {'; '.join(why)}")
            return None
        return replace(self, refined=refined)

    def keep(self, tried: TriedPairs) -> None:
        self.matching.database.keep(tried.proposed, tried.verified, tried.closed)

    @cached_property
    def _finder(self) -> LoopFinder | None:
        metric = self.refined.metric
        if metric.map_errors is None or metric.kept_refinement is None:
            return None
        pixel_stddev, seed = metric.kept_refinement.pixel_stddev, self.run.survey.output.seed
        return LoopFinder.of(metric.final, metric.trajectory, metric.map_errors, pixel_stddev, seed)


def _told(run: SurveyRun, before: MetricResult, after: MetricResult, tried: TriedPairs) -> MetricResult:
    """Return the last map with what became of its loops, of which the journal is told."""
    closed, contradicted = (
        tuple((after.final.image(first).name, after.final.image(second).name) for first, second in sorted(pairs))
        for pairs in (tried.closed, tried.contradicted)
    )
    path_before = _delivered(before) if closed else None
    loops = LoopClosure(len(tried.proposed), len(tried.verified), closed, contradicted, path_before)
    run.journal.warn(*filter(None, [loops.warning]))
    if before.refinement is None or after.refinement is None:
        return replace(after, loops=loops)
    # The bend that the ranges took out of the map is that of the first refinement; the others began with its map.
    return replace(after, loops=loops, refinement=replace(after.refinement, bend_m=before.refinement.bend_m))


def _delivered(metric: MetricResult) -> Trajectory:
    """Return the path of a refined map as it would be the result: moved as a whole to where its interval lies."""
    path, at = metric.trajectory.as_in(metric.final), metric.at_refined
    if at is None or metric.kept_refinement is None:
        return path
    change = at.change(at.posterior)
    return path.transformed(change.scale, change.rotation, change.translation)

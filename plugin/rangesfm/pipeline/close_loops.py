"""Closing of loops by the options of a survey: the refined map proposes pairs, which are matched, tested and used."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import pycolmap

from rangesfm.errors import InputError
from rangesfm.estimation.vision_information import LoopPoses
from rangesfm.pipeline.judge_map import moved_to_estimate
from rangesfm.pipeline.loop_matching import loop_matching
from rangesfm.pipeline.matched_map import MatchedMap, MergeTracks
from rangesfm.pipeline.metric_result import MetricResult
from rangesfm.pipeline.refine_map import RefinedMap
from rangesfm.sfm.loops.loop_closure import LoopClosure
from rangesfm.sfm.loops.rounds import TriedPairs, close_in_rounds
from rangesfm.survey.survey_run import SurveyRun
from rangesfm.util.files.output_folder import sole_writer
from rangesfm.util.geometry.map_errors import MapErrors
from rangesfm.util.geometry.trajectory import Trajectory

Refine = Callable[[SurveyRun, RefinedMap, LoopPoses, MergeTracks], RefinedMap | None]
"""Closes loops of a map and refines it again; None if they are closed in it."""


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
        if (matching := loop_matching(run.survey, run.journal.progress, output)) is None:
            return metric
        if metric.map_errors is None:
            run.journal.warn("loops are not closed, because the covariance of the poses is not known")
            return metric
        if why_not := matching.why_unfit(metric.final):
            matching.discard()
            if run.survey.images.model is not None:
                raise InputError(why_not, run.survey.mapper.database_path)
            return metric
        metric_map, seed = _MetricMap(run, refined, refine), run.survey.output.seed
        last, tried = close_in_rounds(MatchedMap(metric_map, matching, run.journal, seed, asks_vocabulary=False))
        last.keep(tried)
        matching.publish(output)
        return _told(run, metric, last.map.refined.metric, tried)


@dataclass(frozen=True)
class _MetricMap:
    """A refined map of a survey, as one whose loops can be closed."""

    run: SurveyRun
    refined: RefinedMap
    refine: Refine

    @property
    def model(self) -> pycolmap.Reconstruction:
        return self.refined.metric.final

    @property
    def trajectory(self) -> Trajectory:
        return self.refined.metric.trajectory

    @property
    def errors(self) -> MapErrors | None:
        return self.refined.metric.map_errors

    @property
    def pixel_stddev(self) -> float:
        return self.refined.at_rest.pixel_stddev

    @property
    def why_broken(self) -> tuple[str, ...]:
        return self.refined.metric.why_broken

    def with_loops(self, loops: LoopPoses, merge: MergeTracks) -> _MetricMap | None:
        closed = self.refine(self.run, self.refined, loops, merge)
        return None if closed is None else replace(self, refined=closed)


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
    """Return the path of a refined map as it would be the result: bent and moved to its best estimate."""
    if metric.at_refined is not None and metric.kept_refinement is not None:
        metric = moved_to_estimate(metric, metric.at_refined)
    return metric.trajectory.as_in(metric.final)

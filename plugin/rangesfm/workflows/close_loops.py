"""Closing of loops by the options of a survey: the refined map proposes pairs, which are matched, tested and used."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import pycolmap

from rangesfm.colmap.colmap_log import colmap_log
from rangesfm.errors import InputError
from rangesfm.files.output_folder import sole_writer
from rangesfm.loops.loop_closure import LoopClosure
from rangesfm.loops.loop_finder import LoopFinder
from rangesfm.loops.merge import merge_tracks
from rangesfm.progress import Journal
from rangesfm.refine.with_ranges import LoopClosing
from rangesfm.result.metric_result import MetricResult
from rangesfm.survey.survey_run import SurveyRun
from rangesfm.vision.loop_database import LoopDatabase, Pair
from rangesfm.vision.matching import MatchingOptions, matching_options
from rangesfm.vision.steps import DATABASE_NAME

MAX_NUM_PAIRS = 5
"""Pairs that one photo proposes at most. Sequential matching pairs a photo with 10 neighbours by default."""


@dataclass(frozen=True)
class FoundLoops:
    """Loops of a map, with the database that has their matches.

    Attributes:
        closing: for the refinement; None if there are no loops.
        outcome: for the result, with the map as it is before they are closed.
    """

    closing: LoopClosing | None
    outcome: LoopClosure


def find_loops(run: SurveyRun, metric: MetricResult) -> FoundLoops | None:
    """Match the pairs that a refined map proposes, and test those that match; None where loops are not to be closed.

    Raises:
        InputError: the given database does not belong to the given model.
    """
    survey, is_given = run.survey, run.survey.images.model is not None
    is_wanted = survey.mapper.close_loops and not (is_given and survey.mapper.database_path is None)
    if not is_wanted or not len(metric.observations.log) or metric.kept_refinement is None:
        return None
    with sole_writer(survey.output.path) as output:
        source = survey.mapper.database_path if is_given else output.newest(output.path / DATABASE_NAME)
        if source is None or not source.is_file():
            return None
        options = matching_options(survey.mapper, metric.final.num_images(), survey.output.seed)
        if not (is_given or options.is_in_time_only):
            return None
        if metric.map_errors is None:
            run.journal.warn("loops are not closed, because the covariance of the poses is not known")
            return None
        with run.journal.stage("loops"):
            database = LoopDatabase.of(source, output)
            if why_not := database.why_unfit(metric.final):
                database.discard()
                if is_given:
                    raise InputError(why_not, source)
                return None
            finder = LoopFinder.of(
                metric.final,
                metric.trajectory,
                metric.map_errors,
                metric.kept_refinement.pixel_stddev,
                survey.output.seed,
            )
            found = _found(finder, database, options, run.journal)
            database.publish(output)
            return found


def _found(finder: LoopFinder, database: LoopDatabase, options: MatchingOptions, journal: Journal) -> FoundLoops:
    proposed = finder.propose(database.known(), max_num=MAX_NUM_PAIRS)
    verified = database.match(proposed, options, journal.progress)
    loops, contradicted = finder.tested(verified)
    accepted = [loop.image_ids for loop in loops]
    database.keep(proposed, verified, accepted)
    closed_pairs, others = (_named(finder.model, pairs) for pairs in (accepted, contradicted))
    outcome = LoopClosure(len(proposed), len(verified), closed_pairs, others, finder.path, finder.path)
    journal.warn(*filter(None, [outcome.warning]))

    def merge(model: pycolmap.Reconstruction) -> None:
        with colmap_log(database.log):
            merge_tracks(model, database.path, seed=finder.seed)

    return FoundLoops(LoopClosing(finder.relative_poses(loops), merge) if loops else None, outcome)


def _named(model: pycolmap.Reconstruction, pairs: Sequence[Pair]) -> tuple[tuple[str, str], ...]:
    return tuple((model.image(first).name, model.image(second).name) for first, second in pairs)


def closed(run: SurveyRun, found: FoundLoops, metric: MetricResult, refined: MetricResult) -> MetricResult:
    """Return the map refined with its loops, with what was found; the map without them if it broke.

    Args:
        run: the survey. found: its loops.
        metric: the map before. refined: the map after.
    """
    outcome = found.outcome
    if refined.why_broken:
        run.journal.warn(f"loops are left open, because the map broke: {'; '.join(refined.why_broken)}")
        refined, outcome = metric, replace(outcome, closed=())
    loops = replace(outcome, after=refined.trajectory.as_in(refined.final))
    if metric.refinement is None or refined.refinement is None:
        return replace(refined, loops=loops)
    # The bend that the ranges took out of the map is that of the first refinement; the second began with its map.
    return replace(refined, loops=loops, refinement=replace(refined.refinement, bend_m=metric.refinement.bend_m))

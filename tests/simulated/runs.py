"""Runs of simulated surveys in memory: the scale stage alone, or all stages from the scale on, with their tests."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from unittest.mock import patch

import numpy as np
from tests.simulated.surveys import Array, MadeSurvey

from rangesfm.diagnostics.place import by_similarity
from rangesfm.errors import GeometryError, SolverError
from rangesfm.estimation.scale.initialize import initialize_scale
from rangesfm.estimation.scale.scale_estimate import ScaleEstimate
from rangesfm.measurements.joint_map import find_kind
from rangesfm.measurements.lengths.tape import Tape
from rangesfm.measurements.mistakes import MistakeTests
from rangesfm.measurements.positions.surveyed_positions import SurveyedPositions
from rangesfm.measurements.ranges.anchors.anchor import Anchor
from rangesfm.measurements.ranges.anchors.site import Site
from rangesfm.measurements.ranges.association import associate
from rangesfm.measurements.ranges.range_log import RangeLog
from rangesfm.measurements.ranges.scale.range_equation import RangeProblem, RangeState
from rangesfm.measurements.ranges.scale.range_scale import RangeScale
from rangesfm.measurements.ranges.scale.ranges_on_map import RangesOnMap
from rangesfm.options import ScaleOptions
from rangesfm.pipeline.metric_result import MetricResult
from rangesfm.pipeline.run import map_in_metres
from rangesfm.progress import Journal, Progress
from rangesfm.survey.inputs import RangingInputs
from rangesfm.survey.settings import Survey
from rangesfm.survey.survey_run import PathOfModel, SurveyRun
from rangesfm.util.geometry.similarity import align_points

NO_RANGES = RangeLog.from_arrays([], [])


def inputs_of(
    survey: MadeSurvey | None, tape: Tape = Tape(), positions: SurveyedPositions | None = None
) -> RangingInputs:
    """Return what is measured: the ranges of a survey, or none, and what is known beside them."""
    radio: tuple[RangeLog, Array, tuple[Anchor, ...], str] = NO_RANGES, np.zeros((0, 3)), (), "unknown"
    if survey is not None:
        radio = survey.log, survey.tag_in_cam_m[None], survey.anchors, survey.anchor_frame
    return RangingInputs(*radio, Site(), tape, positions=positions or SurveyedPositions())


def run_stages(
    survey: MadeSurvey,
    seed: int,
    inputs: RangingInputs | None = None,
    *,
    intrinsics_are_known: bool = True,
    is_refined: bool = True,
) -> MetricResult:
    """Run all stages from the scale on, with all defaults.

    Args:
        inputs: what is measured; None: the survey's ranges.
        is_refined: whether a map with points is refined, too.
    """
    settings = Survey().changed({"output.seed": seed, "mapper.num_threads": 1})
    settings = settings.changed({"camera.refine_intrinsics": not intrinsics_are_known})
    inputs = inputs or inputs_of(survey)
    observations = associate(inputs.log, survey.trajectory, inputs.tag_in_cam_m, time_offset_s=survey.time_offset_s)
    path = PathOfModel("sparse/0", survey.model, survey.trajectory, observations)
    run = SurveyRun(settings, inputs, Journal(Progress()))
    return map_in_metres(run, [path], refine=is_refined and survey.sfm is not None)


@dataclass(frozen=True)
class Run:
    """The outcome of a survey with a radio; there is no estimate where it was refused.

    Attributes:
        diagnosis: tests of mistakes. doubts: everything that speaks against the map.
        place_in_stddevs: how far the middle of the map is displaced, in its stated stddevs; 0 without a place.
        on_map: the ranges after the scale stage alone.
    """

    survey: MadeSurvey
    estimate: ScaleEstimate | None = None
    diagnosis: MistakeTests | None = None
    doubts: Sequence[str] = ()
    place_in_stddevs: float = 0.0
    on_map: RangesOnMap | None = None
    refusal: str = ""

    @property
    def is_wrong(self) -> bool:
        """Return whether the true scale lies outside the stated interval."""
        if self.estimate is None:
            return False
        low, high = self.estimate.interval_95
        return not low <= self.survey.metres_per_unit <= high


def run(survey: MadeSurvey, seed: int) -> Run:
    """Run the scale stage and the tests after it, starting near the truth if that is a valid start."""
    observations = associate(survey.log, survey.trajectory, survey.tag_in_cam_m, time_offset_s=survey.time_offset_s)
    options, frame = ScaleOptions(max_relative_stddev=1e3), survey.anchor_frame
    near_truth = patch("rangesfm.measurements.ranges.scale.solution.site_starts", _near_truth(survey))
    try:
        with nullcontext() if survey.needs_search else near_truth:
            estimate = initialize_scale(
                observations, survey.trajectory, survey.anchors, anchor_frame=frame, options=options, seed=seed
            )
    except GeometryError as error:
        return Run(survey, refusal=str(error))
    on_map, estimate = estimate.on_map, estimate.where_bent(options)
    ranges = find_kind(on_map.kinds, RangeScale)
    assert ranges is not None
    tests, in_stddevs = ranges.tests(on_map, {}), 0.0
    if estimate.placement is not None:
        centers_m = estimate.metric_from_sfm.apply(survey.trajectory.centers)
        of_map, _ = by_similarity(estimate.placement, centers_m)
        off_m = np.nanmean(centers_m - survey.true_centers_m, axis=0)
        in_stddevs = float(np.linalg.norm(off_m) / np.sqrt(np.trace(of_map[4:, 4:])))
    doubts = [*tests.reasons, *(estimate.reasons if estimate.verdict != "good" else ())]
    return Run(survey, estimate, tests, doubts, in_stddevs, ranges.on(on_map))


def _near_truth(survey: MadeSurvey) -> Callable[[RangeProblem, int], list[RangeState]]:
    trajectory = survey.trajectory
    first_camera = (trajectory.centers - trajectory.centers[0]) @ trajectory.world_from_cam[0]
    is_known = np.isfinite(survey.true_centers_m).all(axis=1)

    def starts(problem: RangeProblem, seed: int) -> list[RangeState]:
        anchors_m = np.where(np.isfinite(problem.anchor_mean_m), problem.anchor_mean_m, 0.0)
        placed = align_points(first_camera[is_known], survey.true_centers_m[is_known])
        return [RangeState(placed, anchors_m, problem.bias_mean_m.copy())]

    return starts


def run_with_photos(survey: MadeSurvey, seed: int) -> Run:
    """Scale, refine and judge a survey, with all defaults."""
    try:
        metric = run_stages(survey, seed)
    except (GeometryError, SolverError) as error:
        return Run(survey, refusal=str(error))
    estimate, place, in_stddevs = metric.estimate, metric.place, 0.0
    doubts = [*(estimate.reasons if estimate.verdict != "good" else ())]
    if place is not None:
        doubts += place.reasons if place.verdict != "good" else ()
        off_m = np.mean(metric.trajectory.as_in(metric.final).centers - survey.true_centers_m, axis=0)
        in_stddevs = float(np.linalg.norm(off_m) / np.linalg.norm(place.stddev_m))
    return Run(survey, estimate, metric.diagnosis, doubts, in_stddevs)

"""Runs of simulated surveys in memory: the scale stage alone, or all stages from the scale on, with their tests."""

from __future__ import annotations

from collections.abc import Callable
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
    """The outcome of the scale stage on one survey; None where the scale was refused."""

    survey: MadeSurvey
    estimate: ScaleEstimate | None
    diagnosis: MistakeTests | None
    on_map: RangesOnMap | None = None
    refusal: str = ""

    @property
    def is_wrong(self) -> bool:
        """Return whether the true scale lies outside the stated interval."""
        if self.estimate is None:
            return False
        low, high = self.estimate.interval_95
        return not low <= self.survey.metres_per_unit <= high

    @property
    def doubts(self) -> list[str]:
        """List everything that speaks against the map of a survey without photos."""
        assert self.estimate is not None
        assert self.diagnosis is not None
        of_scale = self.estimate.reasons if self.estimate.verdict != "good" else ()
        return [*self.diagnosis.reasons, *of_scale]

    @property
    def place_in_stddevs(self) -> float:
        """Return how far the middle of the map is displaced, in its stated stddevs; 0 without a place."""
        if self.estimate is None or self.estimate.placement is None:
            return 0.0
        centers_m = self.estimate.metric_from_sfm.apply(self.survey.trajectory.centers)
        of_map, _ = by_similarity(self.estimate.placement, centers_m)
        off_m = np.nanmean(centers_m - self.survey.true_centers_m, axis=0)
        return float(np.linalg.norm(off_m) / np.sqrt(np.trace(of_map[4:, 4:])))


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
        return Run(survey, None, None, refusal=str(error))
    ranges, on_map = find_kind(estimate.on_map.kinds, RangeScale), estimate.on_map
    assert ranges is not None
    return Run(survey, estimate.where_bent(options), ranges.tests(on_map, {}), ranges.on(on_map))


def _near_truth(survey: MadeSurvey) -> Callable[[RangeProblem, int], list[RangeState]]:
    trajectory = survey.trajectory
    first_camera = (trajectory.centers - trajectory.centers[0]) @ trajectory.world_from_cam[0]
    is_known = np.isfinite(survey.true_centers_m).all(axis=1)

    def starts(problem: RangeProblem, seed: int) -> list[RangeState]:
        anchors_m = np.where(np.isfinite(problem.anchor_mean_m), problem.anchor_mean_m, 0.0)
        placed = align_points(first_camera[is_known], survey.true_centers_m[is_known])
        return [RangeState(placed, anchors_m, problem.bias_mean_m.copy())]

    return starts


@dataclass(frozen=True)
class RunOfPhotos(Run):
    """The outcome of one survey with photos; no result where it was refused."""

    metric: MetricResult | None = None

    @property
    def doubts(self) -> list[str]:
        """List everything that speaks against the map."""
        assert self.metric is not None
        estimate, place = self.metric.estimate, self.metric.place
        of_place = place.reasons if place is not None and place.verdict != "good" else ()
        return [*(estimate.reasons if estimate.verdict != "good" else ()), *of_place]

    @property
    def place_in_stddevs(self) -> float:
        """Return how far the middle of the map is displaced, in its stated stddevs; 0 without a place."""
        if self.metric is None or self.metric.place is None:
            return 0.0
        centers_m = self.metric.trajectory.as_in(self.metric.final).centers
        off_m = np.mean(centers_m - self.survey.true_centers_m, axis=0)
        return float(np.linalg.norm(off_m) / np.linalg.norm(self.metric.place.stddev_m))


def run_with_photos(survey: MadeSurvey, seed: int) -> RunOfPhotos:
    """Scale, refine and judge a survey, with all defaults."""
    try:
        metric = run_stages(survey, seed)
    except (GeometryError, SolverError) as error:
        return RunOfPhotos(survey, None, None, refusal=str(error))
    return RunOfPhotos(survey, metric.estimate, metric.diagnosis, metric=metric)

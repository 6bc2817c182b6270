"""Check whether scale and place by control points and positions are in their stated intervals, and mistakes are found.

Run: python -m tests.studies.known_positions [--with points positions ...] [--mistakes lever_arm ...] [--num_seeds 60]

Each survey is mapped from noisy features by COLMAP's bundle adjustment in a frame of its own, as in
``measured_distances``, then placed by what is known of it and refined, with all defaults. Known are, by ``--with``:
marks that somebody clicked in up to four photos with an error of one pixel and surveyed to 1 cm (half of those in the
scene are control points, the others check points); positions of an antenna on the camera, 1 Hz, with 5 cm of noise and
as much that lasts for 20 s; or both, also beside ranges. ``--mistakes`` makes one mistake in each survey.

Prints for each kind of survey the share of scales in their 95 % interval, the median half width of that, the root mean
square error of scale and place in stated standard deviations, and the RMSE of check points; of surveys with a mistake,
in how many it was found and named. Exit status 1 if less than 90 % of the scales are covered.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
from tests.studies.drifting_maps import Made
from tests.studies.measured_distances import KINDS, Kind, marks_in, simulated
from tests.studies.simulated_survey import TAG_IN_CAM_M
from tests.studies.simulated_survey import Survey as Truth

from rangesfm.demo.simulated_radio import CameraPath
from rangesfm.errors import GeometryError, SolverError
from rangesfm.geometry.similarity import align_points
from rangesfm.options import RangesOptions
from rangesfm.positions.antenna_track import AntennaTrack
from rangesfm.positions.control_points import ControlPoint, ControlPoints
from rangesfm.positions.position_log import PositionLog
from rangesfm.positions.surveyed_positions import PointsEntry, SurveyedPositions
from rangesfm.progress import Journal, SilentProgress
from rangesfm.ranging.anchors.anchor import Anchor
from rangesfm.ranging.anchors.site import Site
from rangesfm.ranging.association import associate
from rangesfm.ranging.range_log import RangeLog
from rangesfm.result.metric_result import MetricResult
from rangesfm.survey.inputs import RangingInputs
from rangesfm.survey.settings import Survey
from rangesfm.survey.survey_run import PathOfModel, SurveyRun
from rangesfm.workflows.run import map_in_metres

Array = npt.NDArray[np.float64]
Line = dict[str, Any]

POINT_STDDEV_M = 0.01
LEAST_COVERED = 0.9
NOISE_M, LASTING_S = 0.05, 20.0
NO_RANGES = RangeLog.from_arrays([], [], image_name=[])
KINDS_OF_SURVEY = ("yard", "room", "orbit of a drone", "way that never returns")


def points_of(truth: Truth, rng: np.random.Generator) -> ControlPoints:
    """Return marks of a survey with their coordinates, control and check points in turn."""
    markers, true_m = marks_in(truth, rng)
    points = tuple(
        ControlPoint(name, at + POINT_STDDEV_M * rng.standard_normal(3), POINT_STDDEV_M, ("control", "check")[k % 2], 0)
        for k, (name, at) in enumerate(true_m.items())
    )
    return ControlPoints(points, markers)


def track_of(survey: Made, path: CameraPath, rng: np.random.Generator, shift_s: float = 0.0) -> AntennaTrack:
    """Return positions of the antenna, whose clock is ``shift_s`` ahead of the camera's; the offset is not known."""
    assert survey.trajectory.timestamps_s is not None
    first_s, last_s = survey.trajectory.timestamps_s[[0, -1]].tolist()
    times = np.arange(first_s, last_s, 1.0)
    true_m = path.centers(times) + path.world_from_cam(times) @ TAG_IN_CAM_M
    alike = np.linalg.cholesky(np.exp(-np.abs(times[:, None] - times) / LASTING_S) + 1e-9 * np.eye(len(times)))
    errors_m = NOISE_M * (rng.standard_normal(true_m.shape) + alike @ rng.standard_normal(true_m.shape))
    covariances = np.tile(NOISE_M**2 * np.eye(3), (len(times), 1, 1))
    log = PositionLog(true_m + errors_m, covariances, times + shift_s, None, np.arange(len(times)))
    return AntennaTrack(log, TAG_IN_CAM_M, None, RangesOptions())


def arm_off(surveyed: SurveyedPositions) -> SurveyedPositions:
    """Return the positions with a lever arm that is 0.3 m off."""
    assert surveyed.antenna is not None
    wrong = surveyed.antenna.antenna_in_cam_m + np.array([0.0, -0.24, 0.18])
    return replace(surveyed, antenna=replace(surveyed.antenna, antenna_in_cam_m=wrong))


def datum_off(surveyed: SurveyedPositions) -> SurveyedPositions:
    """Return the positions with those of the antenna shifted by a metre against the points."""
    assert surveyed.antenna is not None
    log = surveyed.antenna.log
    shifted = log.moved_to(log.position_m + np.array([0.6, -0.64, 0.48]))
    return replace(surveyed, antenna=replace(surveyed.antenna, log=shifted))


def clock_off(surveyed: SurveyedPositions) -> SurveyedPositions:
    """Return the positions with times that are said to be the camera's, and are a second ahead."""
    assert surveyed.antenna is not None
    assert surveyed.antenna.log.timestamp_s is not None
    log = replace(surveyed.antenna.log, timestamp_s=surveyed.antenna.log.timestamp_s + 1.0)
    return replace(surveyed, antenna=replace(surveyed.antenna, log=log, offset_s=0.0))


def one_point_off(surveyed: SurveyedPositions) -> SurveyedPositions:
    """Return the positions with one control point half a metre off."""
    assert surveyed.points is not None
    first, *others = surveyed.points.points
    wrong = replace(first, position_m=first.position_m + np.array([0.3, 0.4, 0.0]))
    return replace(surveyed, points=replace(surveyed.points, points=(wrong, *others)))


MISTAKES: dict[str, tuple[Callable[[SurveyedPositions], SurveyedPositions], tuple[str, str]]] = {
    "none": (lambda surveyed: surveyed, ("", "")),
    "lever_arm": (arm_off, ("antenna's lever arm", "")),
    "datum": (datum_off, ("datum shift", "")),
    "clock": (clock_off, ("antenna's clock", "")),
    "one_point": (one_point_off, ("control point", "mark0")),
}


def run(survey: Made, surveyed: SurveyedPositions, *, with_ranges: bool, seed: int) -> MetricResult:
    """Run all stages from the scale on, with all defaults."""
    settings = Survey().changed({"output.seed": seed, "camera.refine_intrinsics": False, "mapper.num_threads": 1})
    log, arms = (survey.log, survey.tag_in_cam_m[None]) if with_ranges else (NO_RANGES, np.zeros((0, 3)))
    anchors = tuple(Anchor(name) for name in log.anchor_ids)
    inputs = RangingInputs(log, arms, anchors, "unknown", Site(np.zeros(3)), None, None, (), positions=surveyed)
    path = PathOfModel("sparse/0", survey.sfm, survey.trajectory, associate(log, survey.trajectory, arms))
    return map_in_metres(SurveyRun(settings, inputs, Journal(SilentProgress())), [path], refine=True)[1]


def told(kind: Kind, known: str, mistake: str, seed: int) -> Line:
    """Make and run a survey, and return its errors in stated standard deviations."""
    truth, survey = simulated(replace(kind, frame="site"), seed)
    change, wanted = MISTAKES[mistake]
    rng = np.random.default_rng([seed, 31])
    points = points_of(truth, rng)
    if "points" not in known:
        points = replace(points, points=tuple(replace(point, kind="check") for point in points.points))
    track = track_of(survey, kind.path(seed), rng) if "positions" in known else None
    surveyed = change(SurveyedPositions(points, track))
    try:
        metric = run(survey, surveyed, with_ranges="ranges" in known, seed=seed)
    except (GeometryError, SolverError) as error:
        return {"refused": str(error)}
    final_m = metric.trajectory.as_in(metric.final).centers
    off = np.log(align_points(survey.truth_m, final_m).scale)
    low, high = metric.estimate.uncertainty.interval_95
    errors = PointsEntry.of(metric.positions, metric.final, metric.trajectory.as_in(metric.final))
    assert errors is not None
    assert metric.place is not None
    named = [
        (test.name, test.subject) for test in (metric.diagnosis.tests if metric.diagnosis else ()) if test.rejected
    ]
    shift_m = np.mean(final_m - survey.truth_m, axis=0)
    return {
        "refused": "",
        "off": -off / metric.estimate.uncertainty.empirical,
        "covered": low <= -off <= high,
        "half": (high - low) / 2,
        "place": float(np.sqrt(np.mean((shift_m / np.array(metric.place.stddev_m)) ** 2))),
        "rmse_m": float(np.sqrt(np.mean(np.sum((final_m - survey.truth_m) ** 2, axis=1)))),
        "check_m": errors.check.rmse_3d_m,
        "verdict": metric.estimate.verdict,
        "named": named,
        "found": wanted in named,
    }


def summary_of(lines: Sequence[Line]) -> str:
    """Return the figures of some surveys as a line."""
    kept = [line for line in lines if not line["refused"]]
    if not kept:
        return f"all refused: {lines[0]['refused']}"

    def rms(name: str) -> float:
        return float(np.sqrt(np.mean([line[name] ** 2 for line in kept])))

    covered, good = np.mean([line["covered"] for line in kept]), np.mean([line["verdict"] == "good" for line in kept])
    half, found = np.median([line["half"] for line in kept]), sum(line["found"] for line in kept)
    others = sorted({name for line in kept for name in line["named"]})
    return (
        f"{len(kept)} of {len(lines)}: scale covered {100 * covered:.0f} %, half width {100 * half:.2f} %, error "
        f"{rms('off'):.2f} stddevs, place {rms('place'):.2f} stddevs, map {_median(kept, 'rmse_m'):.3f} m, "
        f"check points {_median(kept, 'check_m'):.3f} m, good {100 * good:.0f} %, found {found}, {others}"
    )


def _median(lines: Sequence[Line], name: str) -> float:
    return float(np.median([line[name] for line in lines]))


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kinds", nargs="+", default=KINDS_OF_SURVEY, choices=KINDS)
    parser.add_argument("--with", nargs="+", default=["points"], dest="known")
    parser.add_argument("--mistakes", nargs="+", default=["none"], choices=MISTAKES)
    parser.add_argument("--num_seeds", type=int, default=15)
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args(arguments)
    covered = []
    for mistake in asked.mistakes:
        for known in asked.known:
            for name in asked.kinds:
                seeds = range(asked.seed, asked.seed + asked.num_seeds)
                lines = [told(KINDS[name], known, mistake, seed) for seed in seeds]
                print(f"{known}, {name}, mistake: {mistake}: {summary_of(lines)}", flush=True)
                covered += [line["covered"] for line in lines if not line["refused"] and mistake == "none"]
    return int(bool(covered) and np.mean(covered) < LEAST_COVERED)


if __name__ == "__main__":
    sys.exit(main())

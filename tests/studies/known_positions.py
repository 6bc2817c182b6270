"""Check whether scale and place by control points and positions are in their stated intervals, and mistakes are found.

Run: python -m tests.studies.known_positions [--with points positions+ranges ...] [--mistakes leap ...] [--num_seeds 60]

Each survey is mapped from noisy features by COLMAP's bundle adjustment in a frame of its own, as in
``measured_distances``, then placed by what is known of it and refined, with all defaults. Known are, by ``--with``, one
or several of these, joined by "+":

- ``points``: marks that somebody clicked in up to four photos with an error of one pixel and surveyed to 1 cm (half of
  those in the scene are control points, the others check points);
- ``positions``: of an antenna on the camera, 1 Hz, with 5 cm of noise and as much that lasts for 20 s;
- ``exif``: a position of each photo, with 0.5 m of noise and 3 m that last for 100 s;
- ``ranges``, of a radio drawn from the population; ``anchors``: those have surveyed anchors.

``--mistakes`` makes one mistake in each survey.

Prints for each kind of survey the shares of scales and of coordinates of the place in their 95 % intervals, the root
mean square errors of both, also over the Cramer-Rao bound of points and positions with their true errors (without
ranges), and in stated standard deviations; the RMSE of keyframes and of check points; in how many a mistake was found
and named, and which were. Exit status 1 if less than 90 % of the scales are covered.
"""

from __future__ import annotations

import itertools
import sys
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt
from tests.simulated.runs import inputs_of, run_stages
from tests.simulated.surveys import TAG_IN_CAM_M, MadeSurvey, Truth, photos_adjuster, simulated
from tests.studies.kept_runs import KeptRuns, seeds_parser
from tests.studies.measured_distances import KINDS, marks_in

from rangesfm.demo.simulated_radio import CameraPath
from rangesfm.errors import GeometryError, SolverError
from rangesfm.estimation.photo_bending import PhotoBending
from rangesfm.measurements.clock.offset import TimeOffset
from rangesfm.measurements.positions.antenna_track import AntennaTrack
from rangesfm.measurements.positions.control_points import ControlPoint, ControlPoints
from rangesfm.measurements.positions.position_formats import AUTONOMOUS_STDDEV_M
from rangesfm.measurements.positions.position_log import PositionLog
from rangesfm.measurements.positions.position_scale import PositionScale, scale_by_positions
from rangesfm.measurements.positions.surveyed_positions import SurveyedPositions
from rangesfm.options import RangesOptions
from rangesfm.pipeline.metric_result import MetricResult
from rangesfm.pipeline.result_records import points_entry
from rangesfm.solver.covariance import PhotosAlone
from rangesfm.solver.normal_equations import NormalEquations
from rangesfm.util.geometry.moments import ByPhoto, ByTime, Moments
from rangesfm.util.geometry.numerics import NORMAL_95
from rangesfm.util.geometry.similarity import align_points, similarity_motions
from rangesfm.util.geometry.trajectory import trajectory_from_reconstruction

Array = npt.NDArray[np.float64]
Line = dict[str, Any]

POINT_STDDEV_M = 0.01
LEAST_COVERED = 0.9
LEAP_S = 18.0
KINDS_OF_SURVEY = ("yard", "room", "orbit of a drone", "way that never returns")


@dataclass(frozen=True)
class Receiver:
    """Errors of positions: noise, and a Gauss-Markov process of this size and duration."""

    noise_m: float
    lasting_m: float
    lasting_s: float

    def covariance_m2(self, times_s: Array) -> Array:
        """Return the (n, n) covariance of one coordinate."""
        alike = np.exp(-np.abs(times_s[:, None] - times_s) / self.lasting_s)
        return np.asarray(self.lasting_m**2 * alike + self.noise_m**2 * np.eye(len(times_s)))

    def errors_m(self, times_s: Array, rng: np.random.Generator) -> Array:
        """Draw (n, 3) errors."""
        return np.asarray(np.linalg.cholesky(self.covariance_m2(times_s)) @ rng.standard_normal((len(times_s), 3)))


RECEIVERS = {"positions": Receiver(0.05, 0.05, 20.0), "exif": Receiver(0.5, 3.0, 100.0)}


def points_of(truth: Truth, rng: np.random.Generator) -> ControlPoints:
    """Return marks of a survey with their coordinates, control and check points in turn."""
    markers, true_m = marks_in(truth, rng)
    points = tuple(
        ControlPoint(name, at + POINT_STDDEV_M * rng.standard_normal(3), POINT_STDDEV_M, ("control", "check")[k % 2], 0)
        for k, (name, at) in enumerate(true_m.items())
    )
    return ControlPoints(points, markers)


def antenna_track(
    at_m: Array, stddev_m: float, moments: Moments, arm_m: Array | None = None, offset: TimeOffset | None = None
) -> AntennaTrack:
    """Return positions (n, 3) of an antenna, or of the camera without an arm; NaN: no stddev is stated."""
    covariances = np.tile(stddev_m**2 * np.eye(3), (len(at_m), 1, 1))
    log = PositionLog(at_m, covariances, moments, np.arange(len(at_m)))
    return AntennaTrack(log, np.zeros(3) if arm_m is None else arm_m, offset, RangesOptions())


def track_of(survey: MadeSurvey, path: CameraPath, rng: np.random.Generator) -> AntennaTrack:
    """Return positions of the antenna once a second; their time offset is not known."""
    first_s, last_s = survey.trajectory.times_s[[0, -1]].tolist()
    times, receiver = np.arange(first_s, last_s, 1.0), RECEIVERS["positions"]
    true_m = path.centers(times) + path.world_from_cam(times) @ TAG_IN_CAM_M
    at_m = true_m + receiver.errors_m(times, rng)
    return antenna_track(at_m, receiver.noise_m, ByTime(times), TAG_IN_CAM_M)


def exif_of(survey: MadeSurvey, rng: np.random.Generator) -> AntennaTrack:
    """Return a position of each photo, with the accuracy that is taken for EXIF positions without a word about it."""
    path = survey.trajectory
    at_m = survey.true_centers_m + RECEIVERS["exif"].errors_m(path.times_s, rng)
    return antenna_track(at_m, AUTONOMOUS_STDDEV_M, ByPhoto(path.image_names))


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


def clock_off(surveyed: SurveyedPositions, ahead_s: float = 1.0) -> SurveyedPositions:
    """Return the positions with times that are said to be the camera's, and are ahead of it."""
    assert surveyed.antenna is not None
    log = replace(surveyed.antenna.log, moments=ByTime(surveyed.antenna.log.moments.timestamp_s + ahead_s))
    return replace(surveyed, antenna=replace(surveyed.antenna, log=log, offset=TimeOffset.given(0.0)))


def leap_off(surveyed: SurveyedPositions) -> SurveyedPositions:
    """Return the positions with times that are ahead by leap seconds."""
    return clock_off(surveyed, LEAP_S)


def one_point_off(surveyed: SurveyedPositions) -> SurveyedPositions:
    """Return the positions with one control point half a metre off."""
    first, *others = surveyed.points.points
    wrong = replace(first, position_m=first.position_m + np.array([0.3, 0.4, 0.0]))
    return replace(surveyed, points=replace(surveyed.points, points=(wrong, *others)))


MISTAKES: dict[str, tuple[Callable[[SurveyedPositions], SurveyedPositions], str]] = {
    "none": (lambda surveyed: surveyed, "nothing"),
    "lever_arm": (arm_off, "the antenna sits elsewhere"),
    "datum": (datum_off, "frames that are shifted"),
    "clock": (clock_off, "the times of the positions are"),
    "leap": (leap_off, "their clock is"),
    "one_point": (one_point_off, "the control point mark0 is"),
}


@dataclass(frozen=True)
class Known:
    """A survey with what is known of it, by the names in ``--with``."""

    names: tuple[str, ...]
    truth: Truth
    survey: MadeSurvey
    surveyed: SurveyedPositions

    @classmethod
    def of(cls, names: Sequence[str], truth: Truth, survey: MadeSurvey, path: CameraPath, seed: int) -> Known:
        """Draw errors, which are the same whatever else is known."""
        rng = np.random.default_rng([seed, 31])
        points, track = points_of(truth, rng), track_of(survey, path, rng)
        if "points" not in names:
            points = replace(points, points=tuple(replace(point, kind="check") for point in points.points))
        tracks = {"positions": track, "exif": exif_of(survey, rng)}
        chosen = [tracks[name] for name in tracks if name in names]
        return cls(tuple(names), truth, survey, SurveyedPositions(points, chosen[0] if chosen else None))

    def run(self, surveyed: SurveyedPositions, seed: int) -> MetricResult:
        """Run all stages from the scale on, with all defaults."""
        survey = replace(self.survey, anchor_frame="site" if "anchors" in self.names else "unknown")
        return run_stages(survey, seed, inputs_of(survey if "ranges" in self.names else None, positions=surveyed))

    def bound(self, pixel_stddev: float) -> tuple[float, float]:
        """Return the Cramer-Rao bound of the scale (relative) and of a coordinate of the place, without ranges.

        The errors of points, marks and positions are the true ones, and the bending is that which the photos allow.
        """
        truth = self.truth.model
        path = trajectory_from_reconstruction(truth.reconstruction, truth.timestamps_s)
        antenna = self.surveyed.antenna
        known_offset = antenna and replace(antenna, offset=TimeOffset.given(0.0))
        known = replace(self.surveyed, antenna=known_offset).located(truth.reconstruction, path)
        photos_problem = photos_adjuster(truth.reconstruction, hold_first=self.truth.is_in_first_camera).problem
        photos = PhotosAlone(
            NormalEquations.of(photos_problem, truth.reconstruction, photos_problem.num_residuals()), pixel_stddev
        )
        all_poses = np.ones(len(path), dtype=bool)
        bending = PhotoBending(photos, path, (all_poses,), all_poses, True)
        found = scale_by_positions(PositionScale.begun(known, bending))
        problem = found.alone.problem
        parts = {part.name: part.alike for part in problem.components}
        covariance = problem.bending.formal_m2 + sum(parts.get(name, 0.0) for name in ("marks", "points"))
        grouping, at = found.alone.observed[found.kind].averages, np.flatnonzero(~known.is_mark)
        own = np.zeros((len(known), len(known)))
        for name in RECEIVERS.keys() & {*self.names}:
            own[np.ix_(at, at)] = RECEIVERS[name].covariance_m2(known.time_s[at])
        covariance = covariance + grouping @ np.kron(own, np.eye(3)) @ grouping.T
        used, design = problem.is_used, problem.design
        if known.velocity.any():  # the time offset is unknown, too
            design = np.column_stack([design, grouping @ known.velocity.ravel()])
        design = design[used]
        of_map = np.linalg.inv(design.T @ np.linalg.solve(covariance[np.ix_(used, used)], design))[:7, :7]
        motions = similarity_motions(path.centers - path.centers[0]).mean(axis=0)
        return float(np.sqrt(of_map[0, 0])), float(np.sqrt(np.trace(motions @ of_map @ motions.T) / 3))


def told(known: Known, mistake: str, pixel_stddev: float, seed: int) -> Line:
    """Run a survey, and return its errors: absolute, and in stated standard deviations."""
    change, wanted = MISTAKES[mistake]
    try:
        metric = known.run(change(known.surveyed), seed)
    except (GeometryError, SolverError) as error:
        return {"refused": str(error), "found": wanted in str(error)}
    final_m, truth_m = metric.trajectory.as_in(metric.final).centers, known.survey.true_centers_m
    off = float(np.log(align_points(final_m, truth_m).scale))
    low, high = metric.estimate.uncertainty.interval_95
    errors = points_entry(metric)
    assert errors is not None
    shift_m = np.mean(final_m - truth_m, axis=0)
    in_stddevs = shift_m / (metric.place.stddev_m if metric.place is not None else np.nan)
    has_bound = "ranges" not in known.names and mistake == "none"
    bounds = known.bound(pixel_stddev) if has_bound else (np.nan, np.nan)
    tests = metric.diagnosis.tests
    return {
        "refused": "",
        "scale": (off, (off - (low + high) / 2) / metric.estimate.uncertainty.empirical, off / bounds[0]),
        "half": (high - low) / 2,
        "covered": bool(low <= off <= high),
        "place": (rms(shift_m), rms(in_stddevs), rms(shift_m) / bounds[1]),
        "placed": float(np.mean(np.abs(in_stddevs) <= NORMAL_95)),
        "rmse_m": float(np.sqrt(np.mean(np.sum((final_m - truth_m) ** 2, axis=1)))),
        "check_m": errors.check.rmse_3d_m,
        "verdict": metric.estimate.verdict,
        "named": [f"{test.name} {test.subject}".strip() for test in tests if test.rejected],
        "found": wanted in "; ".join(metric.estimate.reasons),
    }


def rms(values: npt.ArrayLike) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def summary_of(lines: Sequence[Line]) -> str:
    """Return the figures of some surveys as a line."""
    kept = [line for line in lines if not line["refused"]]
    found = f"mistake found in {sum(line['found'] for line in lines)}"
    if not kept:
        return f"all refused: {lines[0]['refused']}, {found}"
    (off, off_stddevs, off_bounds), (shift_m, shift_stddevs, shift_bounds) = (
        [rms([line[name][k] for line in kept]) for k in range(3)] for name in ("scale", "place")
    )
    covered, placed, good = (
        100 * float(np.mean(values))
        for values in zip(*((line["covered"], line["placed"], line["verdict"] == "good") for line in kept), strict=True)
    )
    rmse_m, check_m, half = (float(np.median([line[name] for line in kept])) for name in ("rmse_m", "check_m", "half"))
    named = dict(Counter(name for line in kept for name in line["named"]))
    return (
        f"{len(kept)} of {len(lines)}: scale covered {covered:.1f} %, half width {100 * half:.2f} %, error "
        f"{100 * off:.2f} %, {off_stddevs:.2f} stddevs, {off_bounds:.2f} bounds; place covered {placed:.1f} %, error "
        f"{shift_m:.3f} m, {shift_stddevs:.2f} stddevs, {shift_bounds:.2f} bounds; map {rmse_m:.3f} m, check points "
        f"{check_m:.3f} m; good {good:.0f} %, {found}, named {named}"
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the study."""
    parser = seeds_parser(__doc__, KINDS, 15)
    parser.set_defaults(kinds=KINDS_OF_SURVEY)
    parser.add_argument("--with", nargs="+", default=["points"], dest="known")
    parser.add_argument("--mistakes", nargs="+", default=["none"], choices=MISTAKES)
    asked = parser.parse_args(arguments)
    kept = KeptRuns(asked.out, "known", "mistake", "kind", "seed")
    for name, seed in itertools.product(asked.kinds, range(asked.seed, asked.seed + asked.num_seeds)):
        kind, made = KINDS[name], None
        for known, mistake in itertools.product(asked.known, asked.mistakes):
            which = {"known": known, "mistake": mistake, "kind": name, "seed": seed}
            if not kept.has(**which):
                made = made or simulated(replace(kind, anchor_frame="site"), seed)
                of_survey = Known.of(known.split("+"), *made, kind.path(seed), seed)
                kept.run(partial(told, of_survey, mistake, kind.pixel_stddev, seed), **which)
    for known, mistake, name in itertools.product(asked.known, asked.mistakes, [*asked.kinds, "all"]):
        alike = [line for line in kept.rows if (line["known"], line["mistake"]) == (known, mistake)]
        lines = [line for line in alike if name in ("all", line["kind"])]
        print(f"{known}, {name}, mistake: {mistake}: {summary_of(lines)}", flush=True)
    clean = [line for line in kept.rows if line["mistake"] == "none" and not line["refused"]]
    return int(bool(clean) and np.mean([line["covered"] for line in clean]) < LEAST_COVERED)


if __name__ == "__main__":
    sys.exit(main())

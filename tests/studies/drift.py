"""Simulate the paper's experiment, a rover's lap around a soccer field, and measure how far ranges remove its drift.

    python -m tests.studies.drift [--num_seeds 20] [--anchor beside] [--level_by scaling] [--anchor_frame unknown]

600 keyframes of a forward camera, tracks of at most 8 of them, no loop closure, one anchor on a mast near the middle of
the field (or beside it), known in the first camera's frame, one range of stddev 0.1 m at each keyframe. The drift is
that of vision itself: COLMAP adjusts noisy features, so the drifted map is the one that fits the photos best. The
stages after the mapping know only what a survey would tell them: scale, noise of ranges and noise of features are
estimated.

The same noise gives small or large drift by chance. Therefore each run's drift is brought to the level, and no seed is
skipped:

- ``mixing``: the features have the stddev with which the drift is at the level on average (root mean square, by the
  normal equations of the noise-free map). A seed draws errors of that stddev until one draw drifts less than the level
  and the next one more, or the other way round. A mixture between the two drifts exactly as far as the level. The
  squared weights of a mixture sum to 1, so it is noise of the same stddev.
- ``scaling``: the seed's errors are multiplied by the factor that brings their drift to the level. A seed with small
  drift then has far noisier features than another, and the refinement has to rely more on the ranges. A seed that would
  need features of more than 4 pixels is refused, because no survey has such features.

Prints, in the shape of the paper's table, the root mean square error of the keyframes in the first camera's frame,
without alignment: at the true scale, at the estimated scale, and refined. Then come their ratio, the iterations of the
full problem, the features' stddev, and the share of the drift that the Cramer-Rao bound leaves: no method can expect a
smaller ratio. Seeds that are refused, by the study or by the scale stage, are named and counted; medians are over the
others. Exit status 1 if at some level the median ratio or a single run misses its limit, or no run is left.
"""

from __future__ import annotations

import argparse
import itertools
import sys
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import pycolmap
from tests.studies.simulated_survey import (
    Survey,
    lap_survey,
    mapped,
    range_log,
    rmse_bound_m,
    run_stages,
    unit_pixel_errors,
)

from rangesfm.comparison.with_reference import papers_table
from rangesfm.errors import GeometryError
from rangesfm.geometry.reference import Reference
from rangesfm.geometry.similarity import align_points, rmse
from rangesfm.geometry.trajectory import trajectory_from_reconstruction
from rangesfm.refine.with_ranges import RefineSummary

Array = npt.NDArray[np.float64]

ANCHORS_M = {"inside": (10.0, 5.0, 8.0), "beside": (0.0, -44.0, 8.0)}
MAX_RATIO = 0.5
MAX_NUM_ITERATIONS = 30
_DRIFT_TOLERANCE = 0.02
_MAX_NUM_TRIALS = 20
_MAX_PIXEL_STDDEV = 4.0


class NoSuchDriftError(Exception):
    """A seed's noise cannot be brought to a level of drift."""


@dataclass(frozen=True)
class Level:
    """A level of drift from vision: root mean square over the keyframes, at the true scale.

    Attributes:
        num_observations: features in a keyframe.
        max_median_ratio: largest median ratio of refined to true-scale error.
    """

    drift_m: float
    num_observations: int
    max_median_ratio: float


LEVELS = (Level(0.5, 150, 0.2), Level(5.0, 60, 0.12), Level(12.0, 40, 0.06))


@dataclass(frozen=True)
class Drift:
    """One run: errors in metres, and what the refinement reports.

    Attributes:
        pixel_stddev: of the features.
        bound_m: lower bound on the refined error's root mean square.
    """

    true_scale_m: float
    estimated_scale_m: float
    refined_m: float
    pixel_stddev: float
    bound_m: float
    summary: RefineSummary

    @property
    def ratio(self) -> float:
        return self.refined_m / self.true_scale_m

    @property
    def is_good(self) -> bool:
        return self.ratio < MAX_RATIO and self.summary.num_iterations <= MAX_NUM_ITERATIONS


@dataclass(frozen=True)
class Lap:
    """A survey at a level of drift.

    Attributes:
        pixel_stddev: of the features; with it, the drift is at the level on average.
        bound_m: lower bound on the root mean square of the refined error, with such features.
    """

    survey: Survey
    level: Level
    pixel_stddev: float
    bound_m: float

    @classmethod
    def of(cls, survey: Survey, level: Level) -> Lap:
        pixel_stddev = level.drift_m / rmse_bound_m(survey, 1.0, with_ranges=False)
        return cls(survey, level, pixel_stddev, rmse_bound_m(survey, pixel_stddev))


def study_run(lap: Lap, seed: int, *, level_by: str = "mixing", obstructed_share: float = 0.0) -> Drift:
    survey, bound_m = lap.survey, lap.bound_m
    errors, sfm = (mixed_to_level if level_by == "mixing" else scaled_to_level)(lap, seed)
    pixel_stddev = float(np.sqrt(np.mean(errors**2)))
    if level_by == "scaling":
        bound_m = rmse_bound_m(survey, pixel_stddev)
    result = run_stages(survey, sfm, range_log(survey, seed, obstructed_share=obstructed_share))
    model = survey.model
    reference = Reference(model.centers_m, tuple(model.timestamps_s), world_from_cam=model.world_from_cam)
    rows = papers_table(result.scaled, result.refined, reference, frame="first_camera")
    true_scale_m, estimated_scale_m, refined_m = (float(row.rmse_m or np.nan) for row in rows)
    return Drift(true_scale_m, estimated_scale_m, refined_m, pixel_stddev, bound_m, result.summary)


def scaled_to_level(lap: Lap, seed: int) -> tuple[Array, pycolmap.Reconstruction]:
    """Scale the seed's pixel errors so that the map drifts as far as asked; return both.

    Raises:
        NoSuchDriftError: no multiple drifts so far, or only with features that no survey has.
    """
    errors = lap.pixel_stddev * unit_pixel_errors(lap.survey, seed)
    for _ in range(_MAX_NUM_TRIALS):
        sfm = mapped(lap.survey, errors)
        excess = log_excess(lap, sfm)
        if abs(excess) < _DRIFT_TOLERANCE:
            return errors, sfm
        most = _MAX_PIXEL_STDDEV / np.std(errors)
        if excess < 0 and most < 1 + 1e-6:
            raise NoSuchDriftError(f"a drift of {lap.level.drift_m} m needs more than {_MAX_PIXEL_STDDEV} px of noise")
        errors = errors * min(np.exp(np.clip(-excess, -1.0, 1.0)), most)
    raise NoSuchDriftError(f"no multiple of its noise was found that drifts by {lap.level.drift_m} m")


def mixed_to_level(lap: Lap, seed: int) -> tuple[Array, pycolmap.Reconstruction]:
    """Mix two of the seed's draws of pixel errors so that the map drifts as far as asked; return both.

    Raises:
        NoSuchDriftError: no mixture drifts so far.
    """
    drawn: list[tuple[Array, float]] = []
    for k in itertools.count():
        draw = lap.pixel_stddev * unit_pixel_errors(lap.survey, 1000 * seed + k)
        drawn.append((draw, log_excess(lap, mapped(lap.survey, draw))))
        if drawn[0][1] * drawn[-1][1] <= 0:
            break
    (less, below), (more, above) = sorted(drawn[-2:], key=lambda one: one[1])
    low, high = 0.0, 0.5 * np.pi
    for _ in range(_MAX_NUM_TRIALS):
        # Between the linear guess and the middle, so that the bracket shrinks even for a curved function.
        angle = low + (high - low) * (0.25 + 0.5 * below / (below - above))
        errors = np.cos(angle) * less + np.sin(angle) * more
        sfm = mapped(lap.survey, errors)
        excess = log_excess(lap, sfm)
        if abs(excess) < _DRIFT_TOLERANCE:
            return errors, sfm
        low, high, below, above = (angle, high, excess, above) if excess < 0 else (low, angle, below, excess)
    raise NoSuchDriftError(f"no mixture of its noise was found that drifts by {lap.level.drift_m} m")


def log_excess(lap: Lap, sfm: pycolmap.Reconstruction) -> float:
    """Return the logarithm of the drift over the level."""
    return float(np.log(rmse(drift_of(lap.survey, sfm)) / lap.level.drift_m))


def drift_of(survey: Survey, sfm: pycolmap.Reconstruction) -> Array:
    """(n, 3) error of the keyframes in the first camera's frame, at the true scale."""
    path, truth = trajectory_from_reconstruction(sfm, survey.model.timestamps_s), survey.model.centers_m
    scale = align_points(path.centers, truth).scale
    drift: Array = scale * (path.centers - path.centers[0]) @ path.world_from_cam[0] - truth
    return drift


def main() -> int:
    parser = argparse.ArgumentParser(description="Drift of a simulated rover, before and after the refinement.")
    parser.add_argument("--num_seeds", type=int, default=20)
    parser.add_argument("--anchor", choices=tuple(ANCHORS_M), default="inside")
    parser.add_argument("--anchor_frame", choices=("first_camera", "unknown"), default="first_camera")
    parser.add_argument("--level_by", choices=("mixing", "scaling"), default="mixing")
    parser.add_argument("--obstructed_share", type=float, default=0.0, help="of the ranges read 1 m long on average")
    arguments = parser.parse_args()
    print(
        f"{'level':6} {'seed':>6} {'true scale':>11} {'estimated':>10} {'refined':>8} {'ratio':>6} {'bound':>6} "
        f"{'iterations':>10} {'pixels':>7}"
    )
    is_good = True
    for level in LEVELS:
        survey = lap_survey(
            num_observations=level.num_observations,
            anchor_m=ANCHORS_M[arguments.anchor],
            anchor_frame=arguments.anchor_frame,
        )
        lap = Lap.of(survey, level)
        runs = runs_at_level(lap, arguments)
        print(f"{level.drift_m:g} m  {arguments.num_seeds - len(runs)} of {arguments.num_seeds} seeds refused")
        if not runs:
            is_good = False
            continue
        median, worst = np.median(values_of(runs), axis=0), np.max(values_of(runs), axis=0)
        is_good &= median[3] <= level.max_median_ratio and all(run.is_good for run in runs)
        print_row(f"{level.drift_m:g} m", "median", median, f"ratio at most {level.max_median_ratio}")
        print_row(f"{level.drift_m:g} m", "worst", worst, f"ratio below {MAX_RATIO}")
    return 0 if is_good else 1


def runs_at_level(lap: Lap, arguments: argparse.Namespace) -> list[Drift]:
    """Run all seeds, print them, and return those that were not refused."""
    runs: list[Drift] = []
    level = f"{lap.level.drift_m:g} m"
    for seed in range(arguments.num_seeds):
        try:
            run = study_run(lap, seed, level_by=arguments.level_by, obstructed_share=arguments.obstructed_share)
        except (NoSuchDriftError, GeometryError) as reason:
            print(f"{level:6} {seed:>6} refused: {reason}", flush=True)
            continue
        runs.append(run)
        misfits = "; ".join(misfit.reason for misfit in run.summary.misfits)
        note = misfits or ("" if run.summary.converged else "not converged")
        print_row(level, str(seed), values_of([run])[0], note)
    return runs


def values_of(runs: list[Drift]) -> Array:
    return np.array(
        [
            (
                run.true_scale_m,
                run.estimated_scale_m,
                run.refined_m,
                run.ratio,
                run.bound_m / run.true_scale_m,
                run.summary.num_iterations,
                run.pixel_stddev,
            )
            for run in runs
        ]
    )


def print_row(level: str, seed: str, values: Array, note: str) -> None:
    true_scale, estimated, refined, ratio, bound, iterations, pixels = values
    errors = f"{true_scale:11.3f} {estimated:10.3f} {refined:8.3f} {ratio:6.3f} {bound:6.3f}"
    print(f"{level:6} {seed:>6} {errors} {iterations:10.0f} {pixels:7.2f}  {note}", flush=True)


if __name__ == "__main__":
    sys.exit(main())

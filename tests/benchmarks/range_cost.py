"""Measure what ranges add to COLMAP's bundle adjustment: the processor time of an iteration with and without them.

    python -m tests.benchmarks.range_cost [--num_rounds 9]

600 keyframes in sequence with 200 observations each, one thread. Every round solves each variant twice from the same
perturbed start, with few and with more iterations; the difference is the cost of the iterations, without the set-up.
Each round goes through all variants, so that other load on the machine affects all alike. The medians over the rounds
are printed. At one range per keyframe the ratio should be at most 1.05. There is no limit on the times.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any
from unittest import mock

import numpy as np
import numpy.typing as npt
import pycolmap
from tests.known_errors import known_errors
from tests.simulated.model import SyntheticModel, synthetic_model
from tests.simulated.path import sequence_path

from rangesfm import ceres
from rangesfm.demo.simulated_radio import CameraPath, Radio, simulate_ranges
from rangesfm.geometry.similarity import IDENTITY
from rangesfm.geometry.trajectory import Trajectory, pose_of, trajectory_from_reconstruction
from rangesfm.options import CameraOptions
from rangesfm.ranging.anchors.anchor import AnchorEstimate
from rangesfm.ranging.association import associate
from rangesfm.ranging.range_observations import RangeObservations
from rangesfm.refine.with_ranges import refine_with_ranges

Array = npt.NDArray[np.float64]

NUM_KEYFRAMES = 600
NUM_OBSERVATIONS = 200
KEYFRAME_INTERVAL_S = 0.5
RANGE_STDDEV_M = 0.1
TAG_IN_CAM_M = (0.05, -0.12, -0.03)
ANCHORS_M = {"A1": (50.0, 12.0, 3.0), "A2": (110.0, -15.0, 1.0), "A3": (180.0, 14.0, 0.5), "A4": (250.0, -12.0, 4.0)}
# From this start every one of these steps succeeds, so that each iteration does the same work.
FEW_ITERATIONS, MORE_ITERATIONS = 1, 6


@dataclass(frozen=True)
class Variant:
    """Number of ranges to add per keyframe (0: none), and whether anchors are free."""

    num_per_keyframe: int
    anchors_are_free: bool

    @property
    def name(self) -> str:
        if self.num_per_keyframe == 0:
            return "no ranges"
        return f"{self.num_per_keyframe} a keyframe, anchors {'free' if self.anchors_are_free else 'fixed'}"


VARIANTS = (Variant(0, False), Variant(1, False), Variant(1, True), Variant(10, False), Variant(10, True))


@dataclass(frozen=True)
class Solve:
    """One solve: its processor time, and what the solver reports about it."""

    seconds: float
    num_unsuccessful_steps: int
    schur_structure: str


class TimedAdjuster:
    """A bundle adjuster that does a given number of iterations and takes the time of its solve."""

    def __init__(self, adjuster: pycolmap.CeresBundleAdjuster, num_iterations: int, solves: list[Solve]):
        self._adjuster = adjuster
        self._solves = solves
        solver = adjuster.options.ceres.solver_options
        solver.max_num_iterations = num_iterations
        solver.function_tolerance = solver.gradient_tolerance = solver.parameter_tolerance = 0.0

    @property
    def problem(self) -> Any:
        return self._adjuster.problem

    def solve(self) -> Any:
        start = time.process_time()
        summary: Any = self._adjuster.solve()
        seconds = time.process_time() - start
        of_ceres = summary.ceres_summary
        self._solves.append(Solve(seconds, of_ceres.num_unsuccessful_steps, of_ceres.schur_structure_used))
        return summary


@contextmanager
def timed_solves(num_iterations: int) -> Iterator[list[Solve]]:
    """Make every bundle adjuster that is created inside the block a timed one."""
    make = pycolmap.create_default_ceres_bundle_adjuster
    solves: list[Solve] = []

    def make_timed(*arguments: Any) -> TimedAdjuster:
        return TimedAdjuster(make(*arguments), num_iterations, solves)

    with mock.patch.object(pycolmap, "create_default_ceres_bundle_adjuster", make_timed):
        yield solves


@dataclass(frozen=True)
class Survey:
    """A metric model away from its optimum, and the ranges of each variant on its path."""

    reconstruction: pycolmap.Reconstruction
    trajectory: Trajectory
    observations: dict[Variant, RangeObservations]


def make_survey() -> Survey:
    times = np.linspace(0.0, KEYFRAME_INTERVAL_S * (NUM_KEYFRAMES - 1), NUM_KEYFRAMES)
    path = sequence_path(float(times[-1]) + KEYFRAME_INTERVAL_S, seed=1)
    model = synthetic_model(
        times,
        path.centers(times),
        path.world_from_cam(times),
        num_observations=NUM_OBSERVATIONS,
        max_track_length=8,
        pixel_stddev=0.5,
        metric_from_sfm=IDENTITY,
    )
    perturb(model.reconstruction)
    trajectory = trajectory_from_reconstruction(model.reconstruction, model.timestamps_s)
    return Survey(
        model.reconstruction,
        trajectory,
        {variant: ranges_of(variant, path, model, trajectory) for variant in VARIANTS},
    )


def perturb(reconstruction: pycolmap.Reconstruction) -> None:
    rng = np.random.default_rng(0)
    for point in reconstruction.points3D.values():
        point.xyz = point.xyz + 0.05 * rng.standard_normal(3)
    for frame_id in reconstruction.reg_frame_ids():
        pose_of(reconstruction.frame(frame_id)).params[4:] += 0.02 * rng.standard_normal(3)


def ranges_of(variant: Variant, path: CameraPath, model: SyntheticModel, trajectory: Trajectory) -> RangeObservations:
    """Simulate ranges: the first of each keyframe is taken with its photo, the others before the next photo."""
    rate = max(variant.num_per_keyframe, 1) / KEYFRAME_INTERVAL_S / len(ANCHORS_M)
    simulated = simulate_ranges(path, ANCHORS_M, TAG_IN_CAM_M, Radio(rate_hz=rate, range_stddev_m=RANGE_STDDEV_M))
    wanted = ANCHORS_M if variant.num_per_keyframe else ()
    return associate(simulated.log, trajectory, TAG_IN_CAM_M, anchor_ids=wanted)


def solve(survey: Survey, variant: Variant, num_iterations: int) -> Solve:
    observations = survey.observations[variant]
    with timed_solves(num_iterations) as solves:
        refine_with_ranges(
            survey.reconstruction,
            survey.trajectory,
            observations,
            IDENTITY,
            [anchor(name, variant.anchors_are_free) for name in observations.log.anchor_ids],
            known_errors(observations, RANGE_STDDEV_M),
            tag_in_cam_m=TAG_IN_CAM_M,
            first_pose_is_fixed=True,
            camera=CameraOptions(refine_intrinsics=False),
            num_threads=1,
        )
    return solves[-1]


def anchor(name: str, is_free: bool) -> AnchorEstimate:
    position = np.array(ANCHORS_M[name])
    return AnchorEstimate(
        anchor_id=name,
        position_m=position,
        position_stddev_m=1.0 if is_free else 0.0,
        prior_position_m=None if is_free else position,
        prior_position_stddev_m=np.inf if is_free else 0.0,
        range_bias_m=0.0,
        prior_bias_m=0.0,
        prior_bias_stddev_m=0.01,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description="Time of a solver iteration with ranges, against without.")
    parser.add_argument("--num_rounds", type=int, default=9)
    num_rounds = parser.parse_args().num_rounds
    survey = make_survey()
    ceres.check_compatibility()
    seconds: dict[Variant, list[float]] = {variant: [] for variant in VARIANTS}
    last: dict[Variant, Solve] = {}
    for _ in range(num_rounds):
        for variant in VARIANTS:
            few = solve(survey, variant, FEW_ITERATIONS)
            last[variant] = solve(survey, variant, MORE_ITERATIONS)
            seconds[variant].append((last[variant].seconds - few.seconds) / (MORE_ITERATIONS - FEW_ITERATIONS))
    print(
        f"{NUM_KEYFRAMES} keyframes, {NUM_OBSERVATIONS} observations each; medians of {num_rounds} rounds, one thread"
    )
    print(f"{'ranges':28} {'number':>6} {'ms/iteration':>12} {'ratio':>6} {'structure':>9} {'failed steps':>12}")
    without = np.array(seconds[VARIANTS[0]])
    for variant in VARIANTS:
        here = np.array(seconds[variant])
        print(
            f"{variant.name:28} {np.count_nonzero(survey.observations[variant].has_place):6d} "
            f"{1e3 * np.median(here):12.1f} {np.median(here / without):6.3f} "
            f"{last[variant].schur_structure:>9} {last[variant].num_unsuccessful_steps:12d}"
        )


if __name__ == "__main__":
    main()

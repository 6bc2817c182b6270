"""Check the scale by an antenna's positions on real photos: positions of the true path, with noise, by a lever arm.

Run: python -m tests.studies.real_positions --data FOLDER --model sparse/0 [--num_seeds 30] [--num_refined 3]

FOLDER has photos' times, a radio and the true path (room_env1), and the model is of its photos
(``rangesfm reconstruct``). Positions are at 1 Hz, with 0.1 m of independent noise that is not stated, of an antenna
0.23 m from the lens; nor is the time offset stated. Each seed draws other noise.

Prints for each seed the error of the scale against the similarity to the true path that fits best, and its 95 %
interval; for the first seeds also those of the refined map. Then the share covered, and the Cramer-Rao bound of the
scale by this noise alone, on a map without errors.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
from tests.simulated.runs import inputs_of, run_stages
from tests.studies.known_positions import antenna_track
from tests.studies.real_room import interpolated, path_and_truth, real_room

from rangesfm.arrays import Array
from rangesfm.measurements.positions.surveyed_positions import SurveyedPositions
from rangesfm.util.geometry.moments import ByTime
from rangesfm.util.geometry.trajectory import Trajectory

ANTENNA_IN_CAM_M, NOISE_M = np.array([0.1, -0.2, 0.05]), 0.1


def true_antenna(path: Trajectory, times: Array, centers_m: Array, world_from_cam: Array) -> tuple[Array, Array]:
    """Return times and positions of the antenna once a second, where the true path is known."""
    at_s = np.arange(np.ceil(path.times_s[0]), path.times_s[-1], 1.0)
    nearest = np.abs(times[:, None] - at_s).argmin(axis=0)
    at_m = interpolated(times, centers_m, at_s) + world_from_cam[nearest] @ ANTENNA_IN_CAM_M
    is_known = np.isfinite(at_m).all(axis=1)
    return at_s[is_known], at_m[is_known]


def main() -> int:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--model", type=Path, required=True)
    parser.add_argument("--num_seeds", type=int, default=30)
    parser.add_argument("--num_refined", type=int, default=3)
    asked = parser.parse_args()
    path, times, centers_m, rotations = path_and_truth(asked.data, asked.model)
    at_s, at_m = true_antenna(path, times, centers_m, rotations(times).as_matrix())
    survey = replace(real_room(asked.data, asked.model, 0), sfm=pycolmap.Reconstruction(asked.model))
    lines = []
    for seed in range(asked.num_seeds):
        noise_m = NOISE_M * np.random.default_rng(seed).standard_normal(at_m.shape)
        track = antenna_track(at_m + noise_m, np.nan, ByTime(at_s), ANTENNA_IN_CAM_M)
        inputs = inputs_of(None, positions=SurveyedPositions(antenna=track))
        for name in ("scaled", "refined")[: 1 + (seed < asked.num_refined)]:
            metric = run_stages(survey, 0, inputs, intrinsics_are_known=False, is_refined=name == "refined")
            low, high = metric.estimate.uncertainty.interval_95
            off = float(np.log(survey.metres_per_unit / metric.estimate.value))
            print(f"{name}: error {-100 * off:+.2f} %, interval {-100 * high:+.2f} to {-100 * low:+.2f} %", flush=True)
            lines.append((name, off, low <= off <= high))
    bound = NOISE_M / np.linalg.norm(at_m - at_m.mean(axis=0))
    for wanted in ("scaled", "refined"):
        errors, covered = (np.array([line[k] for line in lines if line[0] == wanted]) for k in (1, 2))
        print(
            f"{wanted}: RMS error {100 * np.sqrt(np.mean(errors**2)):.2f} %, bound {100 * bound:.2f} %, "
            f"{np.count_nonzero(covered)} of {len(covered)} in their intervals"
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())

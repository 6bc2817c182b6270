"""Check the scale by an antenna's positions on real photos: positions of the true path, with noise, by a lever arm.

Run: python -m tests.studies.real_positions --data FOLDER --model sparse/0 [--num_seeds 30] [--num_refined 3]

FOLDER has photos' times and the true path (room_env1: images.csv, groundtruth.csv), and the model is of its photos
(``rangesfm reconstruct``). Positions are at 1 Hz, with 0.1 m of independent noise that is not stated, of an antenna
0.23 m from the lens; nor is the time offset stated. Each seed draws other noise.

Prints for each seed the error of the scale against the similarity to the true path that fits best, and its 95 %
interval; for the first seeds also those of the refined map. Then the share covered, and the Cramer-Rao bound of the
scale by this noise alone, on a map without errors.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pycolmap
from tests.studies.known_positions import NO_RANGES
from tests.studies.real_room import interpolated, path_and_truth

from rangesfm.measurements.lengths.tape import Tape
from rangesfm.measurements.positions.antenna_track import AntennaTrack, locate_antenna
from rangesfm.measurements.positions.clock import find_antenna_offset
from rangesfm.measurements.positions.position_log import PositionLog
from rangesfm.measurements.positions.position_scale import PositionScale, scale_by_positions
from rangesfm.measurements.positions.surveyed_positions import SurveyedPositions
from rangesfm.measurements.ranges.anchors.site import Site
from rangesfm.measurements.ranges.association import associate
from rangesfm.options import RangesOptions
from rangesfm.pipeline.make_metric_map import bending_by_survey
from rangesfm.pipeline.run import map_in_metres
from rangesfm.progress import Journal, Progress
from rangesfm.solver.posterior import ScaleUncertainty
from rangesfm.survey.inputs import RangingInputs
from rangesfm.survey.settings import Survey
from rangesfm.survey.survey_run import PathOfModel, SurveyRun
from rangesfm.util.geometry.moments import ByTime
from rangesfm.util.geometry.similarity import align_points
from rangesfm.util.geometry.trajectory import Trajectory

Array = npt.NDArray[np.float64]
ANTENNA_IN_CAM_M, NOISE_M = np.array([0.1, -0.2, 0.05]), 0.1
SETTINGS = Survey().changed({"mapper.num_threads": 1})


def refined(survey_path: PathOfModel, track: AntennaTrack) -> tuple[float, ScaleUncertainty]:
    """Return the scale of the refined map, with all defaults."""
    known = SurveyedPositions(antenna=track)
    inputs = RangingInputs(NO_RANGES, np.zeros((0, 3)), (), "unknown", Site(np.zeros(3)), Tape(), positions=known)
    metric = map_in_metres(SurveyRun(SETTINGS, inputs, Journal(Progress())), [survey_path], refine=True)
    return metric.estimate.value, metric.estimate.uncertainty


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
    true_m = interpolated(times, centers_m, path.times_s)
    is_known = np.isfinite(true_m).all(axis=1)
    true_scale = align_points(path.centers[is_known], true_m[is_known]).scale
    model = pycolmap.Reconstruction(asked.model)
    whole = PathOfModel("sparse/0", model, path, associate(NO_RANGES, path, np.zeros((0, 3))))
    bending, lines = bending_by_survey(SETTINGS, whole), []

    def told(name: str, value: float, uncertainty: ScaleUncertainty) -> None:
        (low, high), off = uncertainty.interval_95, float(np.log(true_scale / value))
        print(f"{name}: error {-100 * off:+.2f} %, interval {-100 * high:+.2f} to {-100 * low:+.2f} %", flush=True)
        lines.append((name, off, low <= off <= high))

    for seed in range(asked.num_seeds):
        noise_m = NOISE_M * np.random.default_rng(seed).standard_normal(at_m.shape)
        log = PositionLog(at_m + noise_m, np.full((len(at_s), 3, 3), np.nan), ByTime(at_s), np.arange(len(at_s)))
        track = AntennaTrack(log, ANTENNA_IN_CAM_M, None, RangesOptions())
        timed = find_antenna_offset(track, path)
        known = locate_antenna(timed, path)
        found = scale_by_positions(PositionScale.begun(known, bending, SurveyedPositions(antenna=timed)))
        told("scaled", found.alone.scale.value, found.alone.posterior.uncertainty)
        if seed < asked.num_refined:
            told("refined", *refined(whole, track))
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

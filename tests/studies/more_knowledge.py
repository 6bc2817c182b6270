"""Check that a scale is known no worse the more is measured: real ranges, with positions and lengths beside them.

Run: python -m tests.studies.more_knowledge --data FOLDER [--sets room_env1 ...]

The ranges are those of ``real_logs``, on the true path in another unit, with surveyed, known and unknown anchors.
Beside those to surveyed anchors there are 20 positions of the camera with 0.1 m of noise, and 4 lengths between photos
with 0.02 m, each as stated. Noise is drawn once for each log.

Prints for each log the half widths of the 95 % intervals and the errors of the scale, by each combination; then the
medians over the logs, and for each combination how many logs have it wider than the narrowest of its parts.
"""

from __future__ import annotations

import argparse
import itertools
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
from tests.simulated.runs import NO_RANGES
from tests.simulated.surveys import model_of_poses
from tests.studies.known_positions import antenna_track
from tests.studies.real_logs import FACTOR, SETS, RealLog

from rangesfm.errors import GeometryError
from rangesfm.estimation.scale.scale_estimate import ScaleEstimate
from rangesfm.measurements.lengths.tape import CONTROL, Tape, TapedDistance
from rangesfm.measurements.positions.surveyed_positions import SurveyedPositions
from rangesfm.measurements.ranges.anchors.site import Site
from rangesfm.measurements.ranges.association import associate
from rangesfm.pipeline.run import map_in_metres
from rangesfm.progress import Journal, Progress
from rangesfm.survey.inputs import RangingInputs
from rangesfm.survey.settings import Survey
from rangesfm.survey.survey_run import PathOfModel, SurveyRun
from rangesfm.util.geometry.moments import ByPhoto
from rangesfm.util.geometry.trajectory import Trajectory

Array = npt.NDArray[np.float64]

NUM_POSITIONS, POSITION_STDDEV_M = 20, 0.1
NUM_LENGTHS, LENGTH_STDDEV_M = 4, 0.02
SETTINGS = Survey().changed({"mapper.num_threads": 1, "scale.max_relative_stddev": 1.0})
KINDS = ("ranges", "positions", "lengths")
COMBINATIONS = [each for num in (1, 2, 3) for each in itertools.combinations(KINDS, num)]


@dataclass(frozen=True)
class Measured:
    """A real log, and what else is measured of its path."""

    name: str
    path: Trajectory
    inputs: RangingInputs
    ranges: PathOfModel

    @classmethod
    def of(cls, data: Path, name: str, frame: str) -> Measured:
        real, rng = RealLog.read(data, name), np.random.default_rng(0)
        path, case = real.path, real.case(frame)
        observations = real.placed(case, path)
        true_m = FACTOR * path.centers
        rows = np.linspace(0, len(path) - 1, NUM_POSITIONS).round().astype(np.int64)
        at_m = true_m[rows] + POSITION_STDDEV_M * rng.standard_normal((len(rows), 3))
        names = path.image_names
        track = antenna_track(at_m, POSITION_STDDEV_M, ByPhoto(tuple(names[row] for row in rows)))
        taped = []
        for _ in range(NUM_LENGTHS):
            first, last = (int(rng.integers(len(path) // 4)), int(rng.integers(len(path) // 2, len(path))))
            length_m = np.linalg.norm(true_m[first] - true_m[last]) + LENGTH_STDDEV_M * rng.standard_normal()
            taped.append(TapedDistance((names[first], names[last]), float(length_m), LENGTH_STDDEV_M, CONTROL, 0))
        inputs = RangingInputs(
            observations.log, np.zeros((len(observations.log.tag_ids), 3)), tuple(case.anchors), case.frame,
            Site(), Tape(tuple(taped)), positions=SurveyedPositions(antenna=track),
        )  # fmt: skip
        return cls(name, path, inputs, PathOfModel("sparse/0", model_of_poses(path), path, observations))

    def estimate(self, kinds: tuple[str, ...]) -> ScaleEstimate | None:
        """Return the scale by some of the kinds; None if it is refused."""
        inputs, path = self.inputs, self.ranges
        if "ranges" not in kinds:
            inputs = replace(inputs, log=NO_RANGES, tag_in_cam_m=np.zeros((0, 3)), anchors=())
            path = replace(path, observations=associate(NO_RANGES, self.path, inputs.tag_in_cam_m))
        if "positions" not in kinds:
            inputs = replace(inputs, positions=SurveyedPositions())
        if "lengths" not in kinds:
            inputs = replace(inputs, tape=Tape())
        run = SurveyRun(SETTINGS, inputs, Journal(Progress()))
        try:
            return map_in_metres(run, [path], refine=False).estimate
        except GeometryError:
            return None


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--sets", nargs="*", choices=SETS, metavar="NAME")
    args = parser.parse_args()
    runs = [("surveyed", kinds) for kinds in COMBINATIONS] + [("known", ("ranges",)), ("unknown", ("ranges",))]
    found: dict[str, list[float]] = {}
    for name in args.sets or SETS:
        words = []
        for frame, kinds in runs:
            estimate = Measured.of(args.data, name, frame).estimate(kinds)
            half, error = np.nan, np.nan
            if estimate is not None:
                half, error = estimate.uncertainty.half_width_95, float(np.log(estimate.value / FACTOR))
            run = "+".join(kinds) if frame == "surveyed" else f"{frame} anchors"
            found.setdefault(run, []).append(half)
            words.append(f"{run} {100 * half:.2f} ({100 * error:+.2f})")
        print(f"{name:16} {', '.join(words)}", flush=True)
    for run, halves in found.items():
        told = f"{run:28} median half width {100 * np.nanmedian(halves):.2f} %"
        if "+" in run:
            narrowest = np.nanmin([found[each] for each in run.split("+")], axis=0)
            num_wider = np.count_nonzero(np.array(halves) > 1.001 * narrowest)
            told += f", wider than the narrowest of its parts in {num_wider} of {len(halves)}"
        print(told)
    return 0


if __name__ == "__main__":
    sys.exit(main())

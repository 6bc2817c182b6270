"""Compare scale and path from all ranges with those from the ranges at photos alone.

    python -m tests.studies.interpolation RESULT_FOLDER REFERENCE ANCHORS [--tag_in_cam=X,Y,Z]

Takes the folder that a run left (``sparse/0``, ``images.csv``, ``ranges.csv``, ``result.json``), of a log with times,
and a reference (``image_name,x_m,y_m,z_m`` or ``timestamp_s,...``). Places the log on the path anew and estimates the
scale from

- all: every range that has a place, interpolated between keyframes;
- near: only ranges within ``--near_s`` of a keyframe;

in each case from all of these ranges, and from ``--num_parts`` random parts of the log, a tenth of it each. It prints
the scale error and the root mean square error of the keyframe centres without alignment: for the whole log, and mean
and stddev over the parts. The stddev over the parts says how much chance there is in the figures of the whole log.
Errors that all ranges share (of the radio's calibration, or the anchors' survey) are in both means alike.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from rangesfm.colmap.model_files import read_model
from rangesfm.errors import GeometryError
from rangesfm.geometry.reference import read_reference
from rangesfm.geometry.similarity import Similarity, align_points
from rangesfm.geometry.trajectory import Trajectory, trajectory_from_reconstruction
from rangesfm.ranging.anchors.anchor import Anchor
from rangesfm.ranging.anchors.anchor_file import read_anchors
from rangesfm.ranging.association import associate
from rangesfm.ranging.range_observations import RangeObservations, RangeStatus
from rangesfm.ranging.readers import read_ranges
from rangesfm.scale.initialize import initialize_scale
from rangesfm.vision.image_times import read_image_times_csv

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Survey:
    """Ranges on the path, and the truth.

    Attributes:
        trajectory: of n keyframes, unscaled.
        observations: all ranges.
        anchors: in the site frame; without positions, only the scale is compared.
        is_near: (m,) whether each range is next to a keyframe.
        centers_m: (n, 3) true centres; NaN where unknown.
        metric_from_sfm: the similarity that fits them best.
    """

    trajectory: Trajectory
    observations: RangeObservations
    anchors: tuple[Anchor, ...]
    is_near: npt.NDArray[np.bool_]
    centers_m: Array
    metric_from_sfm: Similarity

    def errors(self, chosen: npt.NDArray[np.bool_]) -> tuple[float, float]:
        """Return the scale error (percent) and the centres' root mean square error (metres) from some of the ranges."""
        status = self.observations.status.copy()
        status[~chosen & (status == RangeStatus.USED)] = RangeStatus.CHECK
        estimate = initialize_scale(
            replace(self.observations, status=status), self.trajectory, self.anchors, anchor_frame="site", seed=0
        )
        known = np.isfinite(self.centers_m).all(axis=1)
        off = (estimate.metric_from_sfm.apply(self.trajectory.centers) - self.centers_m)[known]
        return 100 * (estimate.value / self.metric_from_sfm.scale - 1), float(np.sqrt(np.mean(np.sum(off**2, axis=1))))


def read_survey(folder: Path, reference: Path, anchors: Path, tag_in_cam_m: Array, near_s: float) -> Survey:
    times = read_image_times_csv(folder / "images.csv")
    trajectory = trajectory_from_reconstruction(read_model(folder / "sparse" / "0"), times.by_name())
    log = read_ranges(folder / "ranges.csv")
    # These stddevs are the run's findings, not the radio's statements.
    log = replace(log, range_stddev_m=np.full(len(log), np.nan))
    result = json.loads((folder / "result.json").read_text())
    offset_s = float(result["time_offset"]["value_s"])
    centers = read_reference(reference).positions_at(trajectory)[0]
    known = np.isfinite(centers).all(axis=1)
    assert log.timestamp_s is not None
    assert trajectory.timestamps_s is not None
    after = np.clip(np.searchsorted(trajectory.timestamps_s, log.timestamp_s + offset_s), 1, len(trajectory) - 1)
    nearest = np.minimum(
        np.abs(trajectory.timestamps_s[after] - log.timestamp_s - offset_s),
        np.abs(trajectory.timestamps_s[after - 1] - log.timestamp_s - offset_s),
    )
    return Survey(
        trajectory,
        associate(log, trajectory, tag_in_cam_m, time_offset_s=offset_s),
        tuple(read_anchors(anchors)),
        nearest <= near_s,
        centers,
        align_points(trajectory.centers[known], centers[known]),
    )


def print_table(survey: Survey, num_parts: int) -> None:
    """Print a line for each choice of ranges."""
    everything = np.ones(len(survey.is_near), dtype=bool)
    part = np.random.default_rng(0).integers(0, 10, len(everything))
    print("ranges       num  scale_%   rmse_m | of tenths: scale_% mean stddev, rmse_m mean stddev")
    for name, kind in (("all", everything), ("near", survey.is_near)):
        whole = survey.errors(kind)
        of_parts = []
        for number in range(num_parts):
            try:
                of_parts.append(survey.errors(kind & (part == number)))
            except GeometryError as error:
                print(f"a tenth of {name}: {error}")
        mean, stddev = np.mean(of_parts, axis=0), np.std(of_parts, axis=0, ddof=1)
        num = np.count_nonzero(kind & survey.observations.has_place)
        print(
            f"{name:8s} {num:7d} {whole[0]:+8.3f} {whole[1]:8.4f} | "
            f"{mean[0]:+8.3f} {stddev[0]:7.3f}  {mean[1]:8.4f} {stddev[1]:7.4f}",
            flush=True,
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="that a run left")
    parser.add_argument("reference", type=Path, help="true positions")
    parser.add_argument("anchors", type=Path, help="surveyed anchors, site frame")
    parser.add_argument("--tag_in_cam", default="0,0,0", help="lever arm, metres")
    parser.add_argument("--near_s", type=float, default=0.02)
    parser.add_argument("--num_parts", type=int, default=10, help="random tenths to look at, up to 10")
    options = parser.parse_args()
    tag_in_cam_m = np.array(options.tag_in_cam.split(","), dtype=np.float64)
    survey = read_survey(options.folder, options.reference, options.anchors, tag_in_cam_m, options.near_s)
    print_table(survey, options.num_parts)


if __name__ == "__main__":
    main()

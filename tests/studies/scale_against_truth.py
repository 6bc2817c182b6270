"""Error and 95 % interval of the scale on a real log, in every way of knowing its anchors.

Run: python -m tests.studies.scale_against_truth --ranges uwb.csv --anchors surveyed.csv --reference truth.csv
     [--model sparse/0 --images images.csv] [--tag_in_cam X,Y,Z] [--time_offset SECONDS] [--error_curve curve.csv]

With a model: its path, and the truth is the scale of its similarity to the reference, which holds camera poses.
Without: the reference is the path of the tag, divided by a factor that is to be found again. Prints for surveyed
anchors (site frame; without a model also in the frame of the first pose), all unknown, and each alone unknown: the
error, the interval about the truth, whether that lies within, the parts of the stddev, and the verdict.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from rangesfm.cli.survey_flags import position
from rangesfm.errors import GeometryError
from rangesfm.geometry.reference import Reference, read_reference
from rangesfm.geometry.similarity import align_points
from rangesfm.geometry.trajectory import Trajectory, trajectory_from_reconstruction
from rangesfm.options import AssociationOptions, ScaleOptions
from rangesfm.ranging.anchors.anchor import Anchor
from rangesfm.ranging.anchors.anchor_file import read_anchors
from rangesfm.ranging.association import associate
from rangesfm.ranging.errors.error_curve import correct_ranges, read_error_curve
from rangesfm.ranging.log import RangeLog
from rangesfm.ranging.readers import read_ranges
from rangesfm.scale.estimate import ScaleEstimate
from rangesfm.scale.initialize import initialize_scale
from rangesfm.vision.image_times import read_image_times_csv

Array = npt.NDArray[np.float64]

FACTOR = 4.63
MIN_STEP_S = 0.1


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for flag in ("--ranges", "--anchors", "--reference"):
        parser.add_argument(flag, type=Path, required=True)
    for flag in ("--model", "--images", "--error_curve"):
        parser.add_argument(flag, type=Path)
    parser.add_argument("--tag_in_cam", type=position, default=(0.0, 0.0, 0.0))
    parser.add_argument("--time_offset", type=float, default=0.0)
    parser.add_argument("--max_gap", type=float, default=2.0, help="between keyframes, seconds")
    args = parser.parse_args()
    anchors = read_anchors(args.anchors)
    log = read_ranges(args.ranges, anchor_ids=[anchor.anchor_id for anchor in anchors])
    if args.error_curve:
        log, _ = correct_ranges(log, read_error_curve(args.error_curve))
    reference = read_reference(args.reference)
    if args.model:
        path, truth = mapped_path(args.model, args.images, reference)
    else:
        path, truth = tag_path(reference), FACTOR
    options = AssociationOptions(max_interpolation_gap_s=args.max_gap)
    for name, frame, heard in cases(log, anchors, None if args.model else FACTOR * path.centers[0]):
        part = log.subset(np.isin(np.array(log.anchor_ids)[log.anchor_index], [a.anchor_id for a in heard]))
        observations = associate(part, path, args.tag_in_cam, time_offset_s=args.time_offset, options=options)
        try:
            found = initialize_scale(
                observations, path, heard, anchor_frame=frame, options=ScaleOptions(max_relative_stddev=1.0)
            )
        except GeometryError as error:
            print(f"{name:16} refused: {error}", flush=True)
            continue
        print(f"{name:16} {described(found, truth)}", flush=True)


def cases(
    log: RangeLog, anchors: Sequence[Anchor], first_position_m: Array | None
) -> Iterator[tuple[str, str, list[Anchor]]]:
    """Name, frame and the anchors that are heard."""
    in_log = [anchor for anchor in anchors if anchor.anchor_id in log.anchor_ids]
    yield "surveyed", "site", in_log
    if first_position_m is not None:
        from_there = [replace(a, position_m=np.asarray(a.position_m) - first_position_m) for a in in_log]
        yield "first pose known", "first_camera", from_there
    yield "unknown", "unknown", in_log
    for anchor in in_log:
        yield f"unknown, only {anchor.anchor_id}", "unknown", [anchor]


def mapped_path(model: Path, images: Path | None, reference: Reference) -> tuple[Trajectory, float]:
    import pycolmap

    times = read_image_times_csv(images).by_name() if images else None
    path = trajectory_from_reconstruction(pycolmap.Reconstruction(str(model)), times)
    positions, _ = reference.positions_at(path)
    known = np.isfinite(positions).all(axis=1)
    return path, align_points(path.centers[known], positions[known]).scale


def tag_path(reference: Reference) -> Trajectory:
    """At most ten poses a second."""
    times = reference.timestamps_s
    assert times is not None, "the path of the tag is by time"
    kept = [0]
    for i, time in enumerate(times):
        if time - times[kept[-1]] >= MIN_STEP_S:
            kept.append(i)
    num = len(kept)
    names = tuple(f"{i:06d}" for i in range(num))
    rotations = np.tile(np.eye(3), (num, 1, 1))
    return Trajectory(np.arange(1, num + 1), names, times[kept], reference.positions_m[kept] / FACTOR, rotations)


def described(found: ScaleEstimate, truth: float) -> str:
    low, high = found.interval_95
    parts = found.uncertainty
    jackknife = "" if parts.jackknife is None else f" anchors {100 * parts.jackknife:.2f}"
    return (
        f"{100 * (found.value / truth - 1):+6.2f} % [{100 * (low / truth - 1):+6.2f} {100 * (high / truth - 1):+6.2f}] "
        f"{'covered' if low <= truth <= high else 'MISSED'}; formal {100 * parts.formal:.2f} correlated "
        f"{100 * parts.correlated:.2f} bootstrap {100 * parts.bootstrap:.2f}{jackknife} antennas "
        f"{100 * parts.antennas:.2f} curve {100 * parts.range_model:.2f}; noise {found.noise_stddev_m:.3f} m; "
        f"{found.verdict}"
    )


if __name__ == "__main__":
    main()

"""Measure how time, memory and errors of scale, refinement, judgement and report grow with the number of keyframes.

    python -m tests.studies.growth [--num_keyframes 500 1000 2000] [--num_ranges_each 20] [--num_observations 200]
        [--profile] [--keep FOLDER]

A camera goes to and fro over a square field, in rows 4 m apart, with a keyframe at each metre and second. It sees
the same points from other rows again, so that the map has loops everywhere. The lengths of the tracks are drawn from
those of COLMAP's own map of the hand-held room; a track goes on in the next row where the point is seen again. The
model is the true one with noisy features (0.7 pixels) in a world of its own: mapping is not part of the study.
Surveyed anchors stand 40 m apart; each keyframe has its ranges (stddev 0.1 m, an own bias of each anchor) to the four
nearest ones.

``rangesfm refine`` of each survey is a process of its own. Measured are its wall-clock time, also by stage, its
processor time and its peak memory; RMSE of the keyframes without alignment, scaled and refined; and the stated standard
deviation of the worst keyframe. Last comes the exponent of the processor time over the number of keyframes, by least
squares of logarithms. ``--profile`` prints the functions that take most of the time, ``--keep`` keeps the surveys.
"""

from __future__ import annotations

import argparse
import cProfile
import json
import os
import pstats
import subprocess
import sys
import tempfile
import time
from contextlib import redirect_stdout
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pycolmap
from scipy.spatial import KDTree
from tests.peak_memory import peak_bytes
from tests.simulated.files import write_anchors, write_model
from tests.simulated.model import Frames, random_similarity
from tests.simulated.path import look_at
from tests.simulated.surveys import drop_flat_points

from rangesfm.cli import main as run_command
from rangesfm.demo.simulated_radio import Radio, measure_ranges
from rangesfm.measurements.ranges.readers import write_ranges_csv
from rangesfm.util.geometry.moments import ByPhoto
from rangesfm.util.geometry.reference import Reference, write_reference

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

TAG_IN_CAM_M = (0.03, -0.12, -0.05)
ROW_M, ANCHOR_M, FARTHEST_M, NEAREST_M = 4.0, 40.0, 20.0, 1.5
NUM_NEAREST = 4
PIXEL_STDDEV = 0.7
IMAGE_SIZE, FOCAL_PX = (960, 640), 750.0
# Quantiles of the lengths of the 9598 tracks of the hand-held room's map (193 photos, 612 observations in each).
TRACK_SHARES, TRACK_LENGTHS = (0.0, 0.25, 0.5, 0.75, 0.9, 0.99, 1.0), (2, 3, 5, 10, 28, 119, 230)
STAGES = ("scale", "refinement", "judgement", "results")


def frames_of(num: int) -> Frames:
    """Return the true poses: to and fro over the field, looking ahead, a little up and down and to the sides."""
    num_in_row = max(round(np.sqrt(ROW_M * num)), 2)
    row, place = np.divmod(np.arange(num), num_in_row)
    is_back = row % 2 == 1
    along = np.where(is_back, num_in_row - 1 - place, place).astype(np.float64)
    phase = np.arange(float(num))
    centers = np.column_stack([along, ROW_M * row + 0.3 * np.sin(0.31 * phase), 1.7 + 0.3 * np.sin(0.23 * phase)])
    ahead = np.column_stack([np.where(is_back, -1.0, 1.0), 0.5 * np.sin(0.17 * phase), 0.1 * np.cos(0.29 * phase)])
    return Frames(phase, centers, look_at(centers, centers + ahead), FOCAL_PX, IMAGE_SIZE)


def tracks_of(frames: Frames, num_observations: int, rng: np.random.Generator) -> tuple[Array, list[Indices]]:
    """Draw points over the field and the frames that see each, in the order of time.

    Returns:
        (p, 3) points, and the frames of each.
    """
    low, high = frames.centers.min(axis=0) - FARTHEST_M, frames.centers.max(axis=0) + FARTHEST_M
    low[2], high[2] = 0.0, 5.0
    tree = KDTree(frames.centers)
    points, seen_by, num_left = list[Array](), list[Indices](), num_observations * len(frames.centers)
    while num_left > 0:
        for point in rng.uniform(low, high, (1000, 3)):
            near = np.sort(np.array(tree.query_ball_point(point, FARTHEST_M), dtype=np.int64))
            seen = near[frames.sees(point[None], near, NEAREST_M)[0]]
            length = int(np.interp(rng.random(), TRACK_SHARES, TRACK_LENGTHS))
            first = int(rng.integers(max(len(seen) - length, 0) + 1))
            if len(of_point := seen[first : first + length]) > 1:
                points.append(point)
                seen_by.append(of_point)
                num_left -= len(of_point)
    return np.array(points), seen_by


def simulate(folder: Path, num: int, num_ranges_each: int, num_observations: int, seed: int) -> None:
    """Write model, log, anchors, times and truth."""
    rng = np.random.default_rng(seed)
    frames = frames_of(num)
    points, seen_by = tracks_of(frames, num_observations, rng)
    made = frames.seeing(points, seen_by, PIXEL_STDDEV, random_similarity(rng), rng)
    drop_flat_points(made.reconstruction)
    write_model(made.reconstruction, folder / "sparse", made.timestamps_s, folder / "images.csv")
    write_ranges(folder, frames, num_ranges_each, rng)
    write_reference(Reference(frames.centers, ByPhoto(tuple(made.timestamps_s))), folder / "reference.csv")


def write_ranges(folder: Path, frames: Frames, num_each: int, rng: np.random.Generator) -> None:
    size = frames.centers.max(axis=0)
    along, across = (np.linspace(-2, end + 2, max(round(end / ANCHOR_M), 1) + 1) for end in size[:2])
    grid = np.array([(x, y, 0.5 + 3 * ((i + j) % 2)) for i, x in enumerate(along) for j, y in enumerate(across)])
    anchors = {f"A{k}": place for k, place in enumerate(grid)}
    keyframe = np.repeat(np.arange(len(frames.centers)), num_each)
    tags = frames.centers + frames.world_from_cam @ np.array(TAG_IN_CAM_M)
    nearest = KDTree(grid).query(tags, k=NUM_NEAREST)[1]
    anchor = nearest[keyframe, np.tile(np.arange(num_each), len(tags)) % NUM_NEAREST]
    biases = dict(zip(anchors, (0.03 * rng.standard_normal(len(grid))).tolist()))
    radio = Radio(range_stddev_m=0.1, range_bias_m=biases)
    log = measure_ranges(keyframe.astype(np.float64), tags[keyframe], anchor, anchors, radio, seed=1)
    write_ranges_csv(log, folder / "uwb.csv")
    write_anchors(folder / "anchors.csv", anchors)


def refine(folder: Path, *, with_profile: bool) -> None:
    """Refine a simulated survey in this process; print its seconds, processor seconds and peak megabytes."""
    tag = ",".join(map(str, TAG_IN_CAM_M))
    flags = ["--ranges", "uwb.csv", "--anchors", "anchors.csv", "--images", "images.csv", "--tag_in_cam", tag]
    flags += ["--ranges_time_offset", "0", "--reference", "reference.csv", "--quiet", "--output_path", "out"]
    command = ["refine", "--input_path", "sparse", *flags]
    os.chdir(folder)
    profile, begin = cProfile.Profile(), time.perf_counter()
    with redirect_stdout(sys.stderr):
        status = profile.runcall(run_command, command) if with_profile else run_command(command)
    cost = time.perf_counter() - begin, time.process_time(), peak_bytes() / 1e6
    if with_profile:
        pstats.Stats(profile, stream=sys.stderr).sort_stats("cumulative").print_stats("rangesfm|built-in", 90)
    if status:
        raise SystemExit(status)
    print(json.dumps(cost))


def refined(folder: Path, *, with_profile: bool) -> tuple[float, float, float]:
    """Return seconds, processor seconds and peak megabytes of ``rangesfm refine``, in a process of its own."""
    command = [sys.executable, "-m", "tests.studies.growth", "--refine", str(folder)]
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
    done = subprocess.run(
        [*command, *(["--profile"] if with_profile else [])],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        raise SystemExit(f"{folder} failed\n{done.stderr[-3000:]}")
    if with_profile:
        print(done.stderr)
    seconds, processor_s, peak_mb = json.loads(done.stdout.splitlines()[-1])
    return seconds, processor_s, peak_mb


def row_of(folder: Path) -> str:
    """Return the seconds of each stage, and the errors of the result."""
    result = json.loads((folder / "out" / "result.json").read_text(encoding="utf-8"))
    seconds = "".join(f"{result['seconds'].get(stage, 0.0):9.1f}" for stage in STAGES)
    scaled, refined_map = result["comparison"][1:3]
    place = "-" if result["place"] is None else f"{result['place']['worst_keyframe_stddev_m']:.3f}"
    return (
        f"{seconds}  {scaled['rmse_m']:8.3f} {refined_map['rmse_m']:8.3f} {refined_map['scale_error_percent']:+8.3f}"
        f" {place:>8} {result['refine']['iterations']:5}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--num_keyframes", type=int, nargs="+", default=[500, 1000, 2000])
    parser.add_argument("--num_ranges_each", type=int, default=20)
    parser.add_argument("--num_observations", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--profile", action="store_true")
    parser.add_argument("--keep", type=Path, help="folder for the simulated surveys, which are used again")
    parser.add_argument("--refine", type=Path, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.refine:
        refine(args.refine, with_profile=args.profile)
        return
    print(
        "keyframes  ranges  track   made s   all s   cpu s   peak MB" + "".join(f"{stage[:8]:>9}" for stage in STAGES)
    )
    print(f"{'scaled m  refined m  scale %  worst m  iterations':>150}")
    points = []
    for num in args.num_keyframes:
        with tempfile.TemporaryDirectory() as name:
            folder = (args.keep or Path(name)) / f"{num}_{args.num_ranges_each}_{args.num_observations}_{args.seed}"
            begin = time.perf_counter()
            if not (folder / "reference.csv").is_file():
                folder.mkdir(parents=True)
                simulate(folder, num, args.num_ranges_each, args.num_observations, args.seed)
            made_s = time.perf_counter() - begin
            length = pycolmap.Reconstruction(folder / "sparse").compute_mean_track_length()
            seconds, processor_s, peak_mb = refined(folder, with_profile=args.profile)
            points.append((num, processor_s))
            counts = f"{num:9} {num * args.num_ranges_each:7} {length:7.1f} {made_s:8.1f}"
            print(f"{counts} {seconds:7.1f} {processor_s:7.1f} {peak_mb:9.0f}{row_of(folder)}", flush=True)
    if len(points) > 1:
        nums, seconds_of = np.log(np.array(points)).T
        print(
            f"processor time grows as the number of keyframes to the power of {np.polyfit(nums, seconds_of, 1)[0]:.2f}"
        )


if __name__ == "__main__":
    main()

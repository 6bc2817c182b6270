"""How the cost of mapping grows with the number of photos: in one piece, and in overlapping submaps.

    python -m tests.studies.submaps [--num_photos 125 250 500] [--max_one_piece 2000]
        [--max_refined 2000] [--submap_size 100] [--overlap 20]

Simulated keyframes, half a metre apart on one wide round: features with noise, each seen in at most 8 photos in a row,
go into a COLMAP database with their matches; nothing is rendered. They are mapped by pycolmap's incremental mapping

- in one piece, and
- in submaps, as ``rangesfm run --submap_size`` does: stretches in the order of time, each sharing ``--overlap`` photos
  with the one before and each a process of its own; joined by the photos that they share, and refined as a whole.

Each process takes one thread; its processor seconds and its peak memory are its own account. Both maps then go through
``rangesfm refine`` with the same ranges to eight surveyed anchors (stddev 0.1 m, 2 Hz each): RMSE is of the keyframe
centres against the truth, without alignment, scaled and refined. Last, the exponent of the cost over the photos, by
least squares of the logarithms.

On one core of a busy machine (pycolmap 4.2.1, submaps of 100 that share 20):

    photos   one piece        submaps   planning + mapping + joining   largest process
       500      18.4 s         14.9 s         0.9 +  12.5 +  1.6 s            199 MB
      1000                     32.6 s         0.9 +  26.6 +  5.1 s            253 MB
      5000                    151.0 s         2.6 + 127.1 + 21.3 s            688 MB

so that submaps grow as the number of photos to the power of 1.0. The joining at 5000 was measured again on the same
submaps, after its solver had been changed: COLMAP's iterative one, its choice from 1000 photos on, took 131.6 s.

A million photos, on paper. Mapping: 12 500 submaps of 2 s each are 7 hours of one core, shared by as many cores as
there are; a submap knows its own photos only, so that its memory does not grow. Features and sequential matching, which
this study leaves out, take a fixed time for each photo; one process does them. Joining: laying the submaps onto each
other took 0.6 ms a photo, so ten minutes; the refinement as a whole 3.6 ms a photo, an hour if it needs no more
iterations than at 5000. That is the term in doubt: the longer the chain, the more slowly it bends, and the more
iterations that takes. Joining is also what does not fit: it holds 0.11 MB a photo (of 80 features; real photos have ten
times as many or more), which is 110 GB for a million, and a terabyte with real features. From some ten thousand photos
on, parts of a survey are better mapped as surveys of their own, and joined by the anchors that they share (``rangesfm
join``).
"""

from __future__ import annotations

import argparse
import json
import os
import pickle
import resource
import subprocess
import sys
import tempfile
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from tests.peak_memory import peak_bytes
from tests.simulated.model import synthetic_model
from tests.simulated.path import loop_path
from tests.simulated_database import camera_options, matched_photos, write_database

from rangesfm.demo.ranges import Radio, simulate_ranges
from rangesfm.geometry.reference import Reference, write_reference
from rangesfm.options import MapperOptions
from rangesfm.progress import SilentProgress
from rangesfm.ranging.readers.canonical import write_ranges_csv
from rangesfm.vision.mapping import map_incrementally, pipeline_options, write_models
from rangesfm.vision.submap_joining import join_submaps
from rangesfm.vision.submap_refinement import refine_joined
from rangesfm.vision.submaps import Submap, plan_submaps

TAG_IN_CAM_M = (0.03, -0.12, -0.05)
_STEP_M = 0.5
_CIRCUMFERENCE_PER_AXIS = 5.53  # of an ellipse whose axes are as 4 to 3
_MAX_TRACK_LENGTH = 8
_NUM_OBSERVATIONS = 80
_NUM_ANCHORS = 8
_SILENT = SilentProgress()


@dataclass(frozen=True)
class Cost:
    """Processor seconds, and the largest peak of memory of one process."""

    seconds: float = 0.0
    peak_mb: float = 0.0

    def __add__(self, other: Cost) -> Cost:
        return Cost(self.seconds + other.seconds, max(self.peak_mb, other.peak_mb))


def simulate(folder: Path, num_photos: int, seed: int) -> None:
    """A database with features and matches, a radio log, anchors, times and the truth."""
    axis = num_photos * _STEP_M / _CIRCUMFERENCE_PER_AXIS
    times = np.arange(num_photos, dtype=np.float64)
    path = loop_path(
        num_photos + 1.0,
        start_s=-1.0,
        semi_axes_m=(axis, 0.75 * axis),
        num_turns=0.97,
        height_amplitude_m=2.0,
        seed=seed,
    )
    made = synthetic_model(
        times,
        path.centers(times),
        path.world_from_cam(times),
        num_observations=_NUM_OBSERVATIONS,
        max_track_length=_MAX_TRACK_LENGTH,
        pixel_stddev=0.7,
        seed=seed,
    )
    write_database(folder / "database.db", made.reconstruction)
    angles = 2 * np.pi * np.arange(_NUM_ANCHORS) / _NUM_ANCHORS
    heights = np.where(np.arange(_NUM_ANCHORS) % 2, 0.5, 6.0 + 0.05 * axis)
    positions = np.column_stack([1.1 * axis * np.cos(angles), 0.85 * axis * np.sin(angles), heights])
    anchors = {f"A{i}": position for i, position in enumerate(positions)}
    radio = Radio(rate_hz=2.0, range_stddev_m=0.1)
    write_ranges_csv(simulate_ranges(path, anchors, TAG_IN_CAM_M, radio, seed=seed).log, folder / "uwb.csv")
    rows = [f"{name},{x!r},{y!r},{z!r}\n" for name, (x, y, z) in zip(anchors, positions.tolist())]
    (folder / "anchors.csv").write_text("anchor_id,x_m,y_m,z_m\n" + "".join(rows))
    rows = [f"{name},{time!r}\n" for name, time in made.timestamps_s.items()]
    (folder / "images.csv").write_text("image_name,timestamp_s\n" + "".join(rows))
    write_reference(Reference(made.centers_m, image_names=tuple(made.timestamps_s)), folder / "reference.csv")


def map_in_one_piece(folder: Path, output: Path) -> None:
    """All photos by pycolmap's incremental mapping."""
    database = folder / "database.db"
    options = pipeline_options(camera_options(database), _mapper(), seed=0)
    map_incrementally(database, matched_photos(database).photos, output, folder / "snapshots", options, _SILENT)


def plan(folder: Path, output: Path, size: int, overlap: int) -> None:
    """Write the submaps, ready to be mapped, to ``output``."""
    database = folder / "database.db"
    mapper = _mapper().changed(submap_size=size, submap_overlap=overlap)
    submaps = plan_submaps(matched_photos(database), database, output, camera_options(database), mapper, seed=0)
    (output / "submaps.pickle").write_bytes(pickle.dumps(submaps))


def planned(output: Path) -> tuple[Submap, ...]:
    submaps: tuple[Submap, ...] = pickle.loads((output / "submaps.pickle").read_bytes())
    return submaps


def join(folder: Path, output: Path) -> None:
    """The submaps that were mapped, as the end of a mapping in submaps."""
    database = folder / "database.db"
    models = join_submaps([model for submap in planned(output) for model in submap.models()], seed=0)
    options = pipeline_options(camera_options(database), _mapper(), seed=0)
    refine_joined(database, folder, models, options, _SILENT)
    write_models(models, output / "sparse")


def _mapper() -> MapperOptions:
    return MapperOptions(pipeline={"extract_colors": False}, num_threads=1)


def run(*arguments: object) -> Cost:
    """One step of this script in a process of its own, with one thread."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "GLOG_minloglevel": "2"}
    done = subprocess.run(
        [sys.executable, "-m", "tests.studies.submaps", *map(str, arguments)],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        raise SystemExit(f"{arguments} failed\n{done.stderr[-2000:]}")
    return Cost(*json.loads(done.stdout.splitlines()[-1]))


def refined(folder: Path, model: Path, output: Path) -> str:
    """RMSE of the map with the estimated scale, and refined, metres; or why there is none."""
    tag = ",".join(map(str, TAG_IN_CAM_M))
    flags = ["--ranges", "uwb.csv", "--anchors", "anchors.csv", "--images", "images.csv", "--tag_in_cam", tag]
    flags += ["--ranges_time_offset", "0", "--reference", "reference.csv", "--num_threads", "1", "--quiet"]
    command = [sys.executable, "-m", "rangesfm", "refine", "--input_path", str(model), *flags]
    command += ["--output_path", str(output)]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    if done.returncode:
        return done.stderr.strip()[-200:]
    rows: list[dict[str, float]] = json.loads((output / "result.json").read_text())["comparison"]
    return " -> ".join(f"{row['rmse_m']:.3f}" for row in rows[1:])


def study(num_photos: int, size: int, overlap: int, *, one_piece: bool, refine: bool, seed: int) -> dict[str, Cost]:
    """Costs by way of mapping; prints a row for each.

    Args:
        refine: whether the maps are refined with ranges, and compared with the truth.
    """
    costs: dict[str, Cost] = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        simulate(folder, num_photos, seed)
        if one_piece:
            costs["one piece"] = run("--map", folder, folder / "one")
            _say(num_photos, "one piece", costs["one piece"], folder, folder / "one" / "0", refine=refine)
        output = folder / "submaps"
        output.mkdir()
        planning = run("--plan", folder, output, size, overlap)
        num_submaps, mapping = len(planned(output)), Cost()
        for k in range(num_submaps):
            mapping += run("--submap", output, k)
        joining = run("--join", folder, output)
        costs["submaps"] = planning + mapping + joining
        what = f"{num_submaps} submaps"
        _say(num_photos, what, costs["submaps"], folder, output / "sparse" / "0", refine=refine)
        for step, cost in (("planning", planning), ("mapping", mapping), ("joining", joining)):
            print(f"{'':7}{step:34} {cost.seconds:9.1f} s {cost.peak_mb:8.0f} MB", flush=True)
    return costs


def _say(num_photos: int, what: str, cost: Cost, folder: Path, model: Path, *, refine: bool) -> None:
    num = pycolmap.Reconstruction(model).num_reg_images()
    row = f"{num_photos:6} {what:34} {cost.seconds:9.1f} s {cost.peak_mb:8.0f} MB {num:6} registered"
    print(row, end="   " if refine else "\n", flush=True)
    if refine:
        print(f"RMSE {refined(folder, model, folder / 'refined')} m", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--num_photos", type=int, nargs="+", default=[125, 250, 500])
    parser.add_argument("--max_one_piece", type=int, default=10**9, help="more photos are mapped in submaps only")
    parser.add_argument("--max_refined", type=int, default=10**9, help="more photos are mapped only")
    parser.add_argument("--submap_size", type=int, default=100)
    parser.add_argument("--overlap", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    costs: dict[str, list[tuple[int, float]]] = defaultdict(list)
    for num_photos in arguments.num_photos:
        found = study(
            num_photos,
            arguments.submap_size,
            arguments.overlap,
            one_piece=num_photos <= arguments.max_one_piece,
            refine=num_photos <= arguments.max_refined,
            seed=arguments.seed,
        )
        for way, cost in found.items():
            costs[way].append((num_photos, cost.seconds))
    for way, points in costs.items():
        if len(points) > 1:
            nums, seconds = np.log(np.array(points)).T
            exponent = np.polyfit(nums, seconds, 1)[0]
            print(f"{way}: processor time grows as the number of photos to the power of {exponent:.2f}")


def step() -> None:
    """One process of the study; its last line is what it cost."""
    if sys.argv[1] == "--map":
        map_in_one_piece(Path(sys.argv[2]), Path(sys.argv[3]))
    elif sys.argv[1] == "--plan":
        plan(Path(sys.argv[2]), Path(sys.argv[3]), int(sys.argv[4]), int(sys.argv[5]))
    elif sys.argv[1] == "--submap":
        planned(Path(sys.argv[2]))[int(sys.argv[3])].map(_SILENT)
    else:
        join(Path(sys.argv[2]), Path(sys.argv[3]))
    used = resource.getrusage(resource.RUSAGE_SELF)
    print(json.dumps([used.ru_utime + used.ru_stime, peak_bytes() / 1e6]))


_STEPS = ("--map", "--plan", "--submap", "--join")

if __name__ == "__main__":
    if sys.argv[1:2] and sys.argv[1] in _STEPS:
        step()
    else:
        main()

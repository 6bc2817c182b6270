"""Measure how the cost of mapping grows with the number of photos, for COLMAP's three mappers.

    python -m tests.studies.mappers [--num_photos 125 250 500] [--methods incremental global hierarchical]
        [--leaf_size 100] [--max_refined 2000]

Simulated keyframes, half a metre apart on one wide round: noisy features, each seen in at most 8 photos in a row, go
into a COLMAP database with their matches; nothing is rendered. Each mapping is a process of its own with one thread,
and its processor seconds and peak memory are measured alone. Hierarchical mapping takes clusters of ``--leaf_size``
photos that share 20. The RMSE is that of the keyframe centres against the truth: after the best similarity; and, for up
to ``--max_refined`` photos, without any alignment after ``rangesfm refine`` with ranges to eight surveyed anchors
(stddev 0.1 m, 2 Hz each), scaled and refined. Last comes the exponent of the cost over the number of photos, by least
squares of logarithms.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from tests.peak_memory import peak_bytes
from tests.simulated.looped import matches_in, write_matches
from tests.simulated.model import synthetic_model
from tests.simulated.path import loop_path

from rangesfm.demo.simulated_radio import Radio, simulate_ranges
from rangesfm.mapper_options import MapperOptions
from rangesfm.measurements.ranges.readers import write_ranges_csv
from rangesfm.options import CameraOptions
from rangesfm.progress import Progress
from rangesfm.sfm.mapping import map_photos, mapping_options, read_mapped_models
from rangesfm.sfm.photo_files import Photos
from rangesfm.sfm.rigs import NO_RIGS
from rangesfm.sfm.steps import Workspace
from rangesfm.util.geometry.moments import ByPhoto
from rangesfm.util.geometry.reference import Reference, read_reference, write_reference

TAG_IN_CAM_M = (0.03, -0.12, -0.05)
_STEP_M = 0.5
_CIRCUMFERENCE_PER_AXIS = 5.53  # for an ellipse whose axes are as 4 to 3
_MAX_TRACK_LENGTH = 8
_NUM_OBSERVATIONS = 80
_PIXEL_STDDEV = 0.7
_NUM_ANCHORS = 8
_OVERLAP = 20
METHODS = ("incremental", "global", "hierarchical")


def simulate(folder: Path, num_photos: int, seed: int) -> None:
    """Write a database with features and verified matches, a radio log, anchors, times and the truth."""
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
        pixel_stddev=_PIXEL_STDDEV,
        seed=seed,
    )
    model = made.reconstruction
    write_matches(folder / "database.db", model, matches_in(model))
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = seed
    # Global mapping begins with the relative poses.
    pycolmap.geometric_verification(folder / "database.db", two_view_geometry_options=verification)
    angles = 2 * np.pi * np.arange(_NUM_ANCHORS) / _NUM_ANCHORS
    heights = np.where(np.arange(_NUM_ANCHORS) % 2, 0.5, 6.0 + 0.05 * axis)
    positions = np.column_stack([1.1 * axis * np.cos(angles), 0.85 * axis * np.sin(angles), heights])
    anchors = {f"A{i}": position for i, position in enumerate(positions)}
    radio = Radio(rate_hz=2.0, range_stddev_m=0.1)
    write_ranges_csv(simulate_ranges(path, anchors, TAG_IN_CAM_M, radio, seed=seed), folder / "uwb.csv")
    rows = [f"{name},{x!r},{y!r},{z!r}\n" for name, (x, y, z) in zip(anchors, positions.tolist())]
    (folder / "anchors.csv").write_text("anchor_id,x_m,y_m,z_m\n" + "".join(rows))
    rows = [f"{name},{time!r}\n" for name, time in made.timestamps_s.items()]
    (folder / "images.csv").write_text("image_name,timestamp_s\n" + "".join(rows))
    write_reference(Reference(made.centers_m, ByPhoto(tuple(made.timestamps_s))), folder / "reference.csv")


def map_database(folder: Path, method: str, leaf_size: int) -> None:
    """Map all photos of a simulated database; its models replace those of an earlier method in ``sparse``."""
    database = folder / "database.db"
    with pycolmap.Database.open(database) as opened:
        names = tuple(image.name for image in sorted(opened.read_all_images(), key=lambda image: image.image_id))
        (known,) = opened.read_all_cameras()
    camera = CameraOptions(model=known.model_name, params=tuple(known.params.tolist()), refine_intrinsics=False)
    clusters = {"clustering_options": {"leaf_max_num_images": leaf_size, "image_overlap": _OVERLAP}}
    no_colors = {"extract_colors": False}
    pipelines: dict[str, dict[str, Any]] = {
        "incremental": no_colors,
        "global": {},
        "hierarchical": {"incremental_options": no_colors, **clusters},
    }
    mapper = MapperOptions(pipeline=pipelines[method], num_threads=1).changed(method=method)
    options = mapping_options(camera, mapper, NO_RIGS, 0, database)
    photos = Photos(folder, names, ((known.width, known.height),) * len(names), {})
    map_photos(Workspace(folder, Progress()), photos, options)


def cost_of(*arguments: object) -> tuple[float, float]:
    """Return the processor seconds and peak megabytes of one mapping, in a process of its own with one thread."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "GLOG_minloglevel": "2"}
    command = [sys.executable, "-m", "tests.studies.mappers", "--map", *map(str, arguments)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"{arguments} failed\n{done.stderr[-2000:]}")
    seconds, peak_mb = json.loads(done.stdout.splitlines()[-1])
    return seconds, peak_mb


def _own_cost() -> list[float]:
    """Return the cost of this process, or of the child that did the mapping."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return [sum(u.ru_utime + u.ru_stime for u in used), max(peak_bytes() / 1e6, used[1].ru_maxrss / 1e3)]


def rmse_m(folder: Path, model: pycolmap.Reconstruction) -> float:
    """Return the RMSE of the keyframe centres after the best similarity, metres."""
    truth = read_reference(folder / "reference.csv")
    place = dict(zip(truth.moments.image_name, truth.positions_m, strict=True))
    images = [image for image in model.images.values() if image.has_pose]
    found = np.array([image.projection_center() for image in images])
    wanted = np.array([place[image.name] for image in images])
    world_from_sfm = pycolmap.estimate_sim3d(found, wanted)
    assert world_from_sfm is not None
    errors = np.array([world_from_sfm * center for center in found]) - wanted
    return float(np.sqrt(np.mean(np.sum(errors**2, axis=1))))


def refined(folder: Path, model: Path, output: Path) -> str:
    """Return the RMSE of the map with the estimated scale, and refined, metres; or why there is none."""
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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--num_photos", type=int, nargs="+", default=[125, 250, 500])
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=METHODS)
    parser.add_argument("--leaf_size", type=int, default=100)
    parser.add_argument("--max_refined", type=int, default=10**9, help="more photos are mapped only")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    costs: dict[str, list[tuple[int, float]]] = defaultdict(list)
    for num_photos in arguments.num_photos:
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            simulate(folder, num_photos, arguments.seed)
            for method in arguments.methods:
                seconds, peak_mb = cost_of(folder, method, arguments.leaf_size)
                costs[method].append((num_photos, seconds))
                models = read_mapped_models(folder / "sparse")
                sizes = "+".join(str(model.num_reg_images()) for model in models)
                row = f"{num_photos:6} {method:12} {seconds:8.1f} s {peak_mb:7.0f} MB   {sizes} registered"
                print(f"{row}   RMSE {rmse_m(folder, models[0]):.3f}", end="", flush=True)
                does_refine = num_photos <= arguments.max_refined
                end = refined(folder, folder / "sparse" / "0", folder / f"{method}_refined") if does_refine else ""
                print(f", {end} m" if end else " m", flush=True)
    for method, points in costs.items():
        if len(points) > 1:
            nums, seconds_of = np.log(np.array(points)).T
            exponent = np.polyfit(nums, seconds_of, 1)[0]
            print(f"{method}: processor time grows as the number of photos to the power of {exponent:.2f}")


if __name__ == "__main__":
    if sys.argv[1:2] == ["--map"]:
        map_database(Path(sys.argv[2]), sys.argv[3], int(sys.argv[4]))
        print(json.dumps(_own_cost()))
    else:
        main()

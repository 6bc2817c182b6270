"""How the cost of mapping grows with the number of photos: in one piece, and in overlapping submaps.

    python tests/studies/submaps.py [--num_photos 125 250 500] [--max_one_piece 2000] [--submap_size 100]
        [--overlap 20]

Simulated keyframes, half a metre apart on one wide round: features with noise, each seen in at most 8 photos in a row,
go into a COLMAP database with their matches; nothing is rendered. They are mapped by pycolmap's incremental mapping

- in one piece, and
- in windows in the order of time, each sharing ``--overlap`` photos with the one before, each a process of its own. A
  window is laid onto the one before by COLMAP's robust similarity of the photos that they share; tracks that hold the
  same feature of a shared photo become one, and a bundle adjustment of all follows.

Each process takes one thread; its processor seconds and its peak memory are its own account. Both maps then go through
``rangesfm refine`` with the same ranges to eight surveyed anchors (stddev 0.1 m, 2 Hz each): RMSE is of the keyframe
centres against the truth, without alignment, scaled and refined. Last, the exponent of the cost over the photos, by
least squares of the logarithms.
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
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap

from rangesfm.ranging.readers.canonical import write_ranges_csv
from rangesfm.reference import Reference, write_reference
from rangesfm.simulate.model import synthetic_model
from rangesfm.simulate.path import loop_path
from rangesfm.simulate.ranges import Radio, simulate_ranges
from rangesfm.vision.database import create_database

TAG_IN_CAM_M = (0.03, -0.12, -0.05)
_STEP_M = 0.5
_CIRCUMFERENCE_PER_AXIS = 5.53  # of an ellipse whose axes are as 4 to 3
_MAX_TRACK_LENGTH = 8
_NUM_OBSERVATIONS = 80
_NUM_ANCHORS = 8


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
    _write_database(folder / "database.db", made.reconstruction)
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


def _write_database(path: Path, truth: pycolmap.Reconstruction) -> None:
    """The features of a model, and as matches what its tracks say."""
    names = [image.name for _, image in sorted(truth.images.items())]
    camera = pycolmap.Camera(next(iter(truth.cameras.values())).todict())
    camera.has_prior_focal_length = True
    create_database(path, names, camera)
    matches: dict[tuple[int, int], list[tuple[int, int]]] = defaultdict(list)
    for point in truth.points3D.values():
        seen = sorted((element.image_id, element.point2D_idx) for element in point.track.elements)
        for i, (first, at_first) in enumerate(seen):
            for second, at_second in seen[i + 1 :]:
                matches[first, second].append((at_first, at_second))
    with pycolmap.Database.open(path) as database, pycolmap.DatabaseTransaction(database):
        for image_id, image in truth.images.items():
            database.write_keypoints(image_id, np.array([point.xy for point in image.points2D], dtype=np.float32))
        for (first, second), pairs in sorted(matches.items()):
            found = np.array(pairs, dtype=np.uint32)
            database.write_matches(first, second, found)
            geometry = pycolmap.TwoViewGeometry(
                config=pycolmap.TwoViewGeometryConfiguration.CALIBRATED, inlier_matches=found
            )
            database.write_two_view_geometry(first, second, geometry)


def map_photos(folder: Path, output: Path, first: int, last: int) -> None:
    """The largest model of the photos from ``first`` to before ``last``."""
    with pycolmap.Database.open(folder / "database.db") as database:
        names = [image.name for image in sorted(database.read_all_images(), key=lambda image: image.name)]
    options = pycolmap.IncrementalPipelineOptions(
        num_threads=1, random_seed=0, extract_colors=False, ba_refine_focal_length=False, ba_refine_extra_params=False
    )
    options.image_names = names[first:last]
    output.mkdir(parents=True)
    with tempfile.TemporaryDirectory() as scratch:
        models = pycolmap.incremental_mapping(folder / "database.db", folder, scratch, options)
    if not models:
        raise SystemExit(f"no model of photos {first} to {last}")
    max(models.values(), key=lambda model: model.num_reg_images()).write(output)


def join(parts: Sequence[Path], output: Path) -> None:
    """All windows in the world of the first, one track for each feature, adjusted together."""
    joined = pycolmap.Reconstruction(parts[0])
    for path in parts[1:]:
        part = pycolmap.Reconstruction(path)
        joined_from_part = pycolmap.align_reconstructions_via_reprojections(part, joined)
        if joined_from_part is None:
            raise SystemExit(f"{path} cannot be laid onto those before it")
        part.transform(joined_from_part)
        _add(joined, part)
    options = pycolmap.BundleAdjustmentOptions(refine_focal_length=False, refine_extra_params=False)
    options.ceres.solver_options.num_threads = 1
    pycolmap.bundle_adjustment(joined, options)
    joined.update_point_3d_errors()
    output.mkdir(parents=True)
    joined.write(output)


def _add(joined: pycolmap.Reconstruction, part: pycolmap.Reconstruction) -> None:
    """Photos that both have keep the pose they had; a track with a feature of a known point becomes a part of it."""
    for image_id in sorted(set(part.reg_image_ids()) - set(joined.reg_image_ids())):
        image = part.image(image_id)
        copy = pycolmap.Image(
            name=image.name,
            keypoints=np.array([point.xy for point in image.points2D]),
            camera_id=image.camera_id,
            image_id=image_id,
        )
        joined.add_image_with_trivial_frame(copy, image.cam_from_world())
    for point in part.points3D.values():
        elements = [(element.image_id, element.point2D_idx) for element in point.track.elements]
        seen = [joined.image(image_id).points2D[index] for image_id, index in elements]
        known = {feature.point3D_id for feature in seen if feature.has_point3D()}
        new = [
            pycolmap.TrackElement(*element)
            for element, feature in zip(elements, seen, strict=True)
            if not feature.has_point3D()
        ]
        if not known:
            joined.add_point3D(point.xyz, pycolmap.Track(new))
        elif len(known) == 1:
            (point_id,) = known
            for element in new:
                joined.add_observation(point_id, element)


def windows(num_photos: int, size: int, overlap: int) -> list[tuple[int, int]]:
    """In the order of time; the last is no shorter than the others."""
    starts = list(range(0, max(num_photos - size, 0) + 1, size - overlap))
    if starts[-1] + size < num_photos:
        starts.append(num_photos - size)
    return [(start, min(start + size, num_photos)) for start in starts]


def run(*arguments: object) -> Cost:
    """One step of this script in a process of its own, with one thread."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "GLOG_minloglevel": "2"}
    done = subprocess.run(
        [sys.executable, __file__, *map(str, arguments)], env=environment, capture_output=True, text=True, check=False
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


def study(num_photos: int, size: int, overlap: int, *, one_piece: bool, seed: int) -> dict[str, Cost]:
    """Costs by way of mapping; prints a row for each."""
    costs: dict[str, Cost] = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        simulate(folder, num_photos, seed)
        if one_piece:
            costs["one piece"] = run("--map", folder, folder / "one", 0, num_photos)
            _say(num_photos, "one piece", costs["one piece"], folder, folder / "one")
        parts, mapping = [], Cost()
        for first, last in windows(num_photos, size, overlap):
            parts.append(folder / f"part_{first}")
            mapping += run("--map", folder, parts[-1], first, last)
        joining = run("--join", *parts, folder / "joined")
        costs["submaps"] = mapping + joining
        what = f"submaps ({len(parts)}; joining {joining.seconds:.1f} s)"
        _say(num_photos, what, costs["submaps"], folder, folder / "joined")
    return costs


def _say(num_photos: int, what: str, cost: Cost, folder: Path, model: Path) -> None:
    num = pycolmap.Reconstruction(model).num_reg_images()
    rmse = refined(folder, model, folder / f"refined_{model.name}")
    print(
        f"{num_photos:6} {what:34} {cost.seconds:9.1f} s {cost.peak_mb:8.0f} MB {num:6} registered   RMSE {rmse} m",
        flush=True,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--num_photos", type=int, nargs="+", default=[125, 250, 500])
    parser.add_argument("--max_one_piece", type=int, default=10**9, help="more photos are mapped in submaps only")
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
        folder, output, first, last = sys.argv[2:]
        map_photos(Path(folder), Path(output), int(first), int(last))
    else:
        paths = [Path(name) for name in sys.argv[2:]]
        join(paths[:-1], paths[-1])
    used = resource.getrusage(resource.RUSAGE_SELF)
    print(json.dumps([used.ru_utime + used.ru_stime, used.ru_maxrss / 1024]))


if __name__ == "__main__":
    if sys.argv[1:2] in (["--map"], ["--join"]):
        step()
    else:
        main()

"""Compare rangesfm with what people would use instead, on the same maps and ranges.

    python -m tests.benchmarks.other_means [--data FOLDER --model FOLDER] [--methods NAME ...]

The data are a simulated room (120 keyframes, eight surveyed anchors, ranges of stddev 0.1 m with biases of 0.05 m,
every tenth of them too long by 0.5 m on average) and, with ``--data``, the folder ``room_env1`` that
``examples/public_data.py`` writes, with the unscaled ``--model`` that ``rangesfm run`` made of its photos. All are
given the anchors, the lever arm and the clocks' offset. Each goes from the unscaled map to a map in metres by its own
means:

    refine          rangesfm refine
    scale           rangesfm scale: only a similarity
    two-candidate   rangesfm scale --scale_method two-candidate-unchecked, the paper's estimate
    alignment       positions of the tag by trilateration, at each photo from the ranges within 0.25 s, and COLMAP's
                    similarity to them, that of its model_aligner (pycolmap.align_reconstruction_to_locations)
    pose priors     the same positions as priors in COLMAP's bundle adjustment (create_pose_prior_bundle_adjuster)
    least squares   scipy's least_squares of all ranges over the seven numbers of a similarity, from the alignment on
    GTSAM           features and the ranges within 0.05 s of a photo as factors, from the alignment on; left out where
                    it is not installed (``pip install '.[benchmark]'``)

COLMAP knows no lever arm: its positions are taken for those of the camera. Scale error and RMSE without alignment are
those of the keyframe centres. The interval is the one that the method itself states; COLMAP and GTSAM state none for
the scale. Times are processor times.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import psutil
import pycolmap
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from tests.simulated.model import synthetic_model
from tests.simulated.path import loop_path
from tests.studies.real_room import interpolated

from rangesfm.colmap.transform import rescale
from rangesfm.demo.simulated_radio import Radio, simulate_ranges
from rangesfm.geometry.reference import Reference, read_reference, write_reference
from rangesfm.geometry.similarity import Similarity, align_points, rmse
from rangesfm.ranging.anchors.anchor_file import read_anchors
from rangesfm.ranging.readers import read_ranges, write_ranges_csv

Array = npt.NDArray[np.float64]

NEAR_S, AT_PHOTO_S, MIN_NUM_RANGES = 0.25, 0.05, 5
NORMAL_95 = 1.96
RANGE_STDDEV_M, LOSS_SCALE = 0.1, 2.4
SIMULATED_TAG_M = (0.03, -0.12, -0.05)


@dataclass(frozen=True)
class Given:
    """A map with its ranges, as files, and the truth.

    Attributes:
        folder: with images.csv, uwb.csv, anchors_antennas.csv and groundtruth.csv. model: the unscaled map.
        tag_in_cam_m: (3,).
        centers_m: true keyframe centres by name; those without truth are missing.
    """

    folder: Path
    model: Path
    tag_in_cam_m: tuple[float, ...]
    centers_m: dict[str, Array]

    @property
    def times(self) -> dict[str, float]:
        lines = (self.folder / "images.csv").read_text(encoding="utf-8").splitlines()[1:]
        return {name: float(at) for name, at in (line.split(",") for line in lines)}


@dataclass(frozen=True)
class Found:
    """A map in metres.

    Attributes:
        centers_m: by name. interval: half of the 95 % interval of the scale, as a share of it; None if not stated.
    """

    centers_m: dict[str, Array]
    interval: float | None = None


def simulated_room(folder: Path) -> Given:
    times, path = np.arange(120.0), loop_path(121.0, semi_axes_m=(1.6, 1.2), num_turns=4, start_s=-0.5)
    poses = times, path.centers(times), path.world_from_cam(times)
    made = synthetic_model(
        *poses, num_observations=120, pixel_stddev=0.6, max_track_length=30, depth_range_m=(1.0, 6.0)
    )
    made.reconstruction.write(_new(folder / "sparse"))
    anchors = {f"A{k}": np.array([x, y, z]) for k, (x, y, z) in enumerate(np.ndindex(2, 2, 2))}
    anchors = {name: np.array([-2.4, -2.4, 0.3]) + place * [4.8, 4.8, 2.0] for name, place in anchors.items()}
    biases = dict(zip(anchors, (0.05 * np.random.default_rng(1).standard_normal(8)).tolist()))
    radio = Radio(
        rate_hz=10, range_stddev_m=RANGE_STDDEV_M, range_bias_m=biases, obstructed_share=0.1, obstructed_mean_m=0.5
    )
    write_ranges_csv(simulate_ranges(path, anchors, SIMULATED_TAG_M, radio).log, folder / "uwb.csv")
    rows = [f"{name},{','.join(map(str, place.tolist()))}\n" for name, place in anchors.items()]
    (folder / "anchors_antennas.csv").write_text("anchor_id,x_m,y_m,z_m\n" + "".join(rows))
    lines = [f"{name},{at!r}\n" for name, at in made.timestamps_s.items()]
    (folder / "images.csv").write_text("image_name,timestamp_s\n" + "".join(lines))
    write_reference(Reference(made.centers_m, image_names=tuple(made.timestamps_s)), folder / "groundtruth.csv")
    return Given(folder, folder / "sparse", SIMULATED_TAG_M, dict(zip(made.timestamps_s, made.centers_m)))


def public_room(folder: Path, model: Path) -> Given:
    tag = json.loads((folder / "camera.json").read_text(encoding="utf-8"))["tag_in_cam_m"]
    given, truth = Given(folder, model, tuple(tag), {}), read_reference(folder / "groundtruth.csv")
    assert truth.timestamps_s is not None
    names, times = zip(*given.times.items(), strict=True)
    places = interpolated(truth.timestamps_s, truth.positions_m, np.array(times))
    return Given(folder, model, tuple(tag), {name: at for name, at in zip(names, places) if np.isfinite(at).all()})


def _new(folder: Path) -> Path:
    folder.mkdir()
    return folder


def by_command(given: Given, *words: str) -> Found:
    """Run a command of rangesfm on the map."""
    with tempfile.TemporaryDirectory() as scratch:
        tag = ",".join(map(str, given.tag_in_cam_m))
        files = ["--ranges", "uwb.csv", "--anchors", "anchors_antennas.csv", "--images", "images.csv"]
        command = [*words, "--input_path", str(given.model.resolve()), *files, "--tag_in_cam", tag]
        command += ["--ranges_time_offset", "0", "--no_report", "--quiet", "--output_path", f"{scratch}/out"]
        subprocess.run([sys.executable, "-m", "rangesfm", *command], cwd=given.folder, check=True, capture_output=True)
        result = json.loads((Path(scratch) / "out" / "result.json").read_text(encoding="utf-8"))
        name = "sparse_metric" if words[0] == "refine" else "sparse_scaled"
        metric = pycolmap.Reconstruction(Path(scratch) / "out" / name / "0")
    low, high = result["scale"]["interval_95"]
    return Found(centers_of(metric), None if len(words) > 1 else (high - low) / 2 / result["scale"]["value"])


def centers_of(model: pycolmap.Reconstruction) -> dict[str, Array]:
    return {image.name: np.asarray(image.projection_center()) for image in model.images.values() if image.has_pose}


@dataclass(frozen=True)
class Trilaterated:
    """The map, the ranges, and the positions of the tag at the photos, from their ranges alone."""

    given: Given
    model: pycolmap.Reconstruction
    time_s: Array
    range_m: Array
    anchors_m: Array
    places: dict[str, Array]

    @classmethod
    def of(cls, given: Given) -> Trilaterated:
        log = read_ranges(given.folder / "uwb.csv")
        position = {a.anchor_id: np.asarray(a.position_m) for a in read_anchors(given.folder / "anchors_antennas.csv")}
        anchors_m = np.array([position[name] for name in log.anchor_ids])[log.anchor_index]
        assert log.timestamp_s is not None
        model, times, places = pycolmap.Reconstruction(given.model), given.times, {}
        for image in model.images.values():
            near = np.abs(log.timestamp_s - times[image.name]) < NEAR_S
            if len(np.unique(log.anchor_index[near])) >= MIN_NUM_RANGES:
                places[image.name] = _place(anchors_m[near], log.range_m[near])
        return cls(given, model, log.timestamp_s, log.range_m, anchors_m, places)

    def aligned(self) -> Similarity:
        ransac = pycolmap.RANSACOptions(max_error=3 * RANGE_STDDEV_M, random_seed=0)
        found = pycolmap.align_reconstruction_to_locations(
            self.model, [*self.places], [*self.places.values()], 3, ransac
        )
        assert found is not None, "the similarity to the trilaterated positions exists"
        return Similarity(float(found.scale), found.rotation.matrix(), found.translation)


def _place(anchors_m: Array, range_m: Array) -> Array:
    def residuals(at: Array) -> Array:
        return np.asarray(np.linalg.norm(at - anchors_m, axis=1) - range_m)

    return np.asarray(least_squares(residuals, anchors_m.mean(axis=0), loss="soft_l1", f_scale=RANGE_STDDEV_M).x)


def by_alignment(given: Given) -> Found:
    start = Trilaterated.of(given)
    return Found(centers_of(rescale(start.model, start.aligned())))


def by_pose_priors(given: Given) -> Found:
    start = Trilaterated.of(given)
    model = rescale(start.model, start.aligned())
    options = pycolmap.BundleAdjustmentOptions(
        print_summary=False, refine_focal_length=False, refine_extra_params=False
    )
    config, cauchy = pycolmap.BundleAdjustmentConfig(), pycolmap.PosePriorBundleAdjustmentOptions()
    cauchy.ceres.prior_position_loss_function_type = pycolmap.LossFunctionType.CAUCHY
    priors = []
    for image in model.images.values():
        config.add_image(image.image_id)
        if image.name in start.places:
            prior = pycolmap.PosePrior(
                corr_data_id=image.data_id,
                position=start.places[image.name],
                position_covariance=RANGE_STDDEV_M**2 * np.eye(3),
                coordinate_system=pycolmap.PosePriorCoordinateSystem.CARTESIAN,
            )
            priors.append(prior)
    pycolmap.create_pose_prior_bundle_adjuster(options, cauchy, config, priors, model).solve()
    return Found(centers_of(model))


def by_least_squares(given: Given) -> Found:
    start = Trilaterated.of(given)
    begin, order = start.aligned(), sorted(start.model.images.values(), key=lambda image: given.times[image.name])
    times = np.array([given.times[image.name] for image in order])
    inside = (start.time_s > times[0]) & (start.time_s < times[-1])
    at, measured, anchors_m = start.time_s[inside], start.range_m[inside], start.anchors_m[inside]
    centers = np.array([image.projection_center() for image in order])
    between = np.column_stack([np.interp(at, times, axis) for axis in centers.T])
    nearest = np.abs(at[:, None] - times).argmin(axis=1)
    arms = np.array([image.cam_from_world().rotation.matrix().T @ given.tag_in_cam_m for image in order])[nearest]

    def residuals(x: Array) -> Array:
        turn = Rotation.from_rotvec(x[1:4]).as_matrix()
        tags = (np.exp(x[0]) * between + arms) @ turn.T + x[4:]
        return np.asarray(np.linalg.norm(tags - anchors_m, axis=1) - measured)

    first = [np.log(begin.scale), *Rotation.from_matrix(begin.rotation).as_rotvec(), *begin.translation]
    found = least_squares(residuals, first)
    variance = 2 * found.cost / (len(at) - 7) * np.linalg.inv(found.jac.T @ found.jac)[0, 0]
    turn = Rotation.from_rotvec(found.x[1:4]).as_matrix()
    metric = rescale(start.model, Similarity(float(np.exp(found.x[0])), turn, found.x[4:]))
    return Found(centers_of(metric), NORMAL_95 * float(np.sqrt(variance)))


def by_gtsam(given: Given) -> Found:
    import gtsam

    start = Trilaterated.of(given)
    model = rescale(start.model, start.aligned())
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    (camera,) = model.cameras.values()
    calibration = _gtsam_camera(gtsam, camera)
    keys = {image_id: key for key, image_id in enumerate(sorted(model.images))}
    for image_id, key in keys.items():
        pose = model.image(image_id).cam_from_world().inverse()
        values.insert(key, gtsam.Pose3(gtsam.Rot3(pose.rotation.matrix()), pose.translation))
    pixel = gtsam.noiseModel.Robust.Create(
        gtsam.noiseModel.mEstimator.Cauchy.Create(LOSS_SCALE), gtsam.noiseModel.Unit.Create(2)
    )
    for number, (_, point) in enumerate(sorted(model.points3D.items()), start=len(keys)):
        values.insert(number, point.xyz)
        for element in point.track.elements:
            xy = model.image(element.image_id).point2D(element.point2D_idx).xy
            graph.add(gtsam.GenericProjectionFactorCal3DS2(xy, pixel, keys[element.image_id], number, calibration))
    noise = gtsam.noiseModel.Robust.Create(
        gtsam.noiseModel.mEstimator.Cauchy.Create(LOSS_SCALE), gtsam.noiseModel.Isotropic.Sigma(1, RANGE_STDDEV_M)
    )
    tag, places = gtsam.Pose3(gtsam.Rot3(), np.array(given.tag_in_cam_m)), np.unique(start.anchors_m, axis=0)
    first_anchor = len(keys) + model.num_points3D()
    for k, place in enumerate(places):
        values.insert(first_anchor + k, place)
        graph.add(gtsam.NonlinearEqualityPoint3(first_anchor + k, place))
    for image_id, key in keys.items():
        for row in np.flatnonzero(np.abs(start.time_s - given.times[model.image(image_id).name]) < AT_PHOTO_S):
            k = int(np.abs(places - start.anchors_m[row]).sum(axis=1).argmin())
            graph.add(gtsam.RangeFactorWithTransform3D(key, first_anchor + k, start.range_m[row], noise, tag))
    result = gtsam.LevenbergMarquardtOptimizer(graph, values, gtsam.LevenbergMarquardtParams()).optimize()
    return Found({model.image(i).name: result.atPose3(key).translation() for i, key in keys.items()})


def _gtsam_camera(gtsam: Any, camera: pycolmap.Camera) -> Any:
    """Return a pinhole camera with COLMAP's OPENCV distortion, which GTSAM has too."""
    distortion = camera.params[4:] if camera.model.name == "OPENCV" else np.zeros(4)
    (fx, fy), (cx, cy) = (
        (camera.focal_length_x, camera.focal_length_y),
        (camera.principal_point_x, camera.principal_point_y),
    )
    return gtsam.Cal3DS2(fx, fy, 0.0, cx, cy, *distortion)


METHODS: dict[str, Callable[[Given], Found]] = {
    "refine": lambda given: by_command(given, "refine"),
    "scale": lambda given: by_command(given, "scale"),
    "two-candidate": lambda given: by_command(given, "scale", "--scale_method", "two-candidate-unchecked"),
    "alignment": by_alignment,
    "pose priors": by_pose_priors,
    "least squares": by_least_squares,
    "GTSAM": by_gtsam,
}


def processor_s() -> float:
    """Return the processor time of this process and of its children that have ended, seconds."""
    times = psutil.Process().cpu_times()
    return times.user + times.system + times.children_user + times.children_system


def rows(given: Given, methods: Sequence[str]) -> Iterator[str]:
    """Yield a row of the table for each method."""
    for name in methods:
        begin = processor_s()
        try:
            found = METHODS[name](given)
        except subprocess.CalledProcessError as error:
            yield f"{name:14}  refused: {error.stderr.decode().strip().splitlines()[-1]}"
            continue
        except ImportError:
            continue
        seconds = processor_s() - begin
        names = sorted(found.centers_m.keys() & given.centers_m.keys())
        centers, truth = (np.array([of[name] for name in names]) for of in (found.centers_m, given.centers_m))
        scale_error = 1 / align_points(centers, truth).scale - 1
        interval = "      -" if found.interval is None else f"{100 * found.interval:7.2f}"
        yield f"{name:14}{100 * scale_error:+9.2f}{interval}{rmse(centers - truth):10.3f}{seconds:10.1f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path)
    parser.add_argument("--model", type=Path)
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=[*METHODS])
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        surveys = {"simulated room": simulated_room(Path(scratch))}
        if args.data is not None:
            surveys[args.data.name] = public_room(args.data, args.model)
        for name, given in surveys.items():
            print(f"{name}\nmethod          scale %  +-95 %    RMSE m     cpu s")
            for row in rows(given, args.methods):
                print(row, flush=True)


if __name__ == "__main__":
    main()

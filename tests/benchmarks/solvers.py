"""Compare solvers of the same bundle adjustment with ranges: time, memory and error.

    python -m tests.benchmarks.solvers [--num_keyframes 50 200 600 2000] [--num_ranges 1 10 100] [--num_rounds 3]
        [--solvers cpp free between]

The problem: keyframes in sequence with 200 observations each, features in at most 8 photos, stddev 0.5 px; ranges
(stddev 0.1 m) from each keyframe to four anchors, each with a Cauchy loss; the first pose is held and the start is
perturbed. The solvers:

    none      pycolmap's bundle adjustment without ranges, with its own trust region
    cpp       rangesfm's costs, the ranges of a keyframe to an anchor in one residual block
    free      the same with unknown anchors
    between   the same ranges spread between the keyframes, each acting on two poses
    python    the residual of `cpp` as a Python cost function, one per range
    gtsam     projection and range factors, Levenberg-Marquardt with its defaults (``pip install '.[benchmark]'``;
              left out where it is not installed)
    scipy     least_squares with the sparsity of the Jacobian; up to 50 keyframes, one observation in five

Each case runs in a process of its own with one thread. The solvers take turns in each round. Times are medians of
processor time. The time of an iteration is that of six iterations minus that of one, from the same start, divided by
the difference; this is tried three times, and again until 3 s have passed. The total is the time from the model in
memory to the solution: building the problem and solving it. Ceres uses its direct solver for all, as the refinement
does; pycolmap by itself takes the iterative one beyond 1000 photos, which is slower here. Memory is the peak of the
process beyond what the imports took: model, problem and solver. The RMSE is of the keyframe centres, without alignment.
There is no limit on the times.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pycolmap
from scipy.spatial.transform import Rotation
from tests.peak_memory import peak_bytes
from tests.simulated.model import synthetic_model
from tests.simulated.path import sequence_path

from rangesfm import ceres
from rangesfm.geometry.similarity import IDENTITY
from rangesfm.geometry.trajectory import pose_of

Array = npt.NDArray[np.float64]

INTERVAL_S = 0.5
NUM_OBSERVATIONS = 200
FOCAL_PX, PRINCIPAL_POINT_PX = 750.0, (480.0, 320.0)
PIXEL_STDDEV, RANGE_STDDEV_M = 0.5, 0.1
RANGE_STDDEV = RANGE_STDDEV_M / PIXEL_STDDEV  # residuals are in pixels
LOSS_SCALE = 2.4 * PIXEL_STDDEV
TAG_IN_CAM_M = np.array([0.05, -0.12, -0.03])
NUM_ANCHORS = 4
FEW_ITERATIONS, MORE_ITERATIONS, MAX_ITERATIONS = 1, 6, 100
MIN_TRIALS, MIN_SECONDS = 3, 3.0
TOLERANCE = 1e-8
SOLVERS = ("none", "cpp", "free", "between", "python", "gtsam", "scipy")
MAX_SCIPY_KEYFRAMES, SCIPY_THINNING = 50, 5
# A Python cost function takes some 20 microseconds: more ranges would take too long.
MAX_PYTHON_RANGES = 60_000


@dataclass(frozen=True)
class Case:
    """The solver and the size of the problem, for one process."""

    solver: str
    num_keyframes: int
    num_ranges: int


@dataclass(frozen=True)
class Outcome:
    """The measurements of one process; times in seconds."""

    iteration: float
    build: float
    total: float
    num_iterations: int
    memory_mb: float
    rmse_m: float
    final_cost: float


@dataclass(frozen=True)
class Ranges:
    """Ranges of stddev ``RANGE_STDDEV_M``, at keyframes or between each and the next."""

    keyframe: npt.NDArray[np.int64]
    weight: Array
    anchor: npt.NDArray[np.int64]
    range_m: Array
    offset_m: Array


@dataclass(frozen=True)
class Survey:
    """A perturbed model, its ranges and the truth."""

    reconstruction: pycolmap.Reconstruction
    anchors_m: Array
    at_keyframes: Ranges
    between: Ranges
    centers_m: Array


def make_survey(num_keyframes: int, num_ranges: int) -> Survey:
    times = INTERVAL_S * np.arange(num_keyframes, dtype=np.float64)
    path = sequence_path(float(times[-1]) + INTERVAL_S, seed=1)
    model = synthetic_model(
        times,
        path.centers(times),
        path.world_from_cam(times),
        num_observations=NUM_OBSERVATIONS,
        max_track_length=8,
        pixel_stddev=PIXEL_STDDEV,
        metric_from_sfm=IDENTITY,
    )
    rng = np.random.default_rng(0)
    perturb(model.reconstruction, rng)
    along = path.centers(np.linspace(0.1, 0.9, NUM_ANCHORS) * times[-1])
    anchors = along + rng.choice([-1, 1], (NUM_ANCHORS, 1)) * [0, 12, 0] + rng.uniform(-2, 4, (NUM_ANCHORS, 3))

    def ranges(spread: bool) -> Ranges:
        keyframe = np.repeat(np.arange(1, num_keyframes - 1), num_ranges)
        weight = rng.random(len(keyframe)) if spread else np.zeros(len(keyframe))
        anchor = np.tile(np.arange(num_ranges) % NUM_ANCHORS, num_keyframes - 2)
        tags_at = path.centers(times) + path.world_from_cam(times) @ TAG_IN_CAM_M
        line = (1 - weight)[:, None] * tags_at[keyframe] + weight[:, None] * tags_at[keyframe + 1]
        when = times[keyframe] + weight * INTERVAL_S
        tags = path.centers(when) + path.world_from_cam(when) @ TAG_IN_CAM_M
        distance = np.linalg.norm(tags - anchors[anchor], axis=1)
        noise = RANGE_STDDEV_M * rng.standard_normal(len(keyframe))
        return Ranges(keyframe, weight, anchor, np.maximum(distance + noise, 0.01), tags - line)

    return Survey(model.reconstruction, anchors, ranges(False), ranges(True), model.centers_m)


def perturb(reconstruction: pycolmap.Reconstruction, rng: np.random.Generator) -> None:
    for point in reconstruction.points3D.values():
        point.xyz = point.xyz + 0.05 * rng.standard_normal(3)
    for frame_id in sorted(reconstruction.reg_frame_ids())[1:]:
        pose_of(reconstruction.frame(frame_id)).params[4:] += 0.02 * rng.standard_normal(3)


def write_survey(survey: Survey, folder: Path) -> None:
    """Write a survey as a COLMAP model and as arrays, so that each solver starts from the form that suits it best."""
    (folder / "model").mkdir()
    survey.reconstruction.write(folder / "model")
    images = survey.reconstruction.images
    observations = [
        (element.image_id - 1, index, *images[element.image_id].points2D[element.point2D_idx].xy)
        for index, point in enumerate(survey.reconstruction.points3D.values())
        for element in point.track.elements
    ]
    np.savez(
        folder / "survey.npz",
        observations=np.array(observations),
        points=np.array([point.xyz for point in survey.reconstruction.points3D.values()]),
        poses=np.array(poses_of(survey.reconstruction)),
        anchors=survey.anchors_m,
        centers=survey.centers_m,
        **{f"at_{name}": value for name, value in vars(survey.at_keyframes).items()},
        **{f"between_{name}": value for name, value in vars(survey.between).items()},
    )


def poses_of(reconstruction: pycolmap.Reconstruction) -> list[Array]:
    return [pose_of(reconstruction.frame(i)).params for i in sorted(reconstruction.reg_frame_ids())]


def ranges_in(arrays: Any, kind: str) -> Ranges:
    return Ranges(*(arrays[f"{kind}_{name}"] for name in Ranges.__dataclass_fields__))


# A solver: maps the largest number of iterations to the iterations done, build seconds, solve seconds, final cost and
# centres.
Solve = Callable[[int], tuple[int, float, float, float, Array]]


def ceres_solver(case: Case, folder: Path, arrays: Any) -> Solve:
    ceres.check_compatibility()

    def solve(max_num_iterations: int) -> tuple[int, float, float, float, Array]:
        # read from disk rather than copied, because memory is measured
        reconstruction = pycolmap.Reconstruction(folder / "model")
        start = time.process_time()
        adjuster = bundle_adjuster(reconstruction, case, max_num_iterations)
        blocks = add_ranges(adjuster, reconstruction, case, arrays)
        built = time.process_time()
        summary: Any = adjuster.solve()
        done = time.process_time()
        num = summary.ceres_summary.num_successful_steps + summary.ceres_summary.num_unsuccessful_steps
        centers = centers_of(np.array(poses_of(reconstruction)))
        del blocks
        return num, built - start, done - built, summary.ceres_summary.final_cost, centers

    return solve


def bundle_adjuster(
    reconstruction: pycolmap.Reconstruction, case: Case, max_num_iterations: int
) -> pycolmap.CeresBundleAdjuster:
    options = pycolmap.BundleAdjustmentOptions(
        print_summary=False, refine_focal_length=False, refine_extra_params=False
    )
    solver = options.ceres.solver_options
    solver.num_threads = 1
    solver.max_num_iterations = max_num_iterations
    solver.function_tolerance = TOLERANCE if max_num_iterations == MAX_ITERATIONS else 0.0
    solver.gradient_tolerance = solver.parameter_tolerance = 0.0
    if case.solver != "none":
        solver.initial_trust_region_radius = 1e10
    options.ceres.solver_options = solver
    # The direct solver for all, as in the refinement: the iterative one, which COLMAP takes from 1000 photos on,
    # converges slowly along a path.
    options.ceres.max_num_images_direct_sparse_cpu_solver = max(1000, reconstruction.num_reg_images())
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in reconstruction.reg_image_ids():
        config.add_image(image_id)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.UNSPECIFIED)
    config.set_constant_rig_from_world_pose(min(reconstruction.reg_frame_ids()))
    return pycolmap.create_default_ceres_bundle_adjuster(options, config, reconstruction)


def add_ranges(
    adjuster: pycolmap.CeresBundleAdjuster, reconstruction: pycolmap.Reconstruction, case: Case, arrays: Any
) -> Any:
    if case.solver == "none":
        return None
    ranges = ranges_in(arrays, "between" if case.solver == "between" else "at")
    anchors, biases = list(arrays["anchors"].copy()), [np.zeros(1) for _ in arrays["anchors"]]
    poses = poses_of(reconstruction)
    if case.solver == "python":
        add_python_ranges(adjuster, ranges, poses, anchors)
    else:
        placed = ceres.PlacedRanges(
            range_m=ranges.range_m,
            stddev_m=np.full(len(ranges.range_m), RANGE_STDDEV),
            before=ranges.keyframe,
            after=ranges.keyframe + (case.solver == "between"),
            weight=ranges.weight,
            offset_in_world_m=ranges.offset_m,
            anchor_index=ranges.anchor,
            tag_index=np.zeros(len(ranges.range_m), dtype=np.int64),
        )
        blocks = ceres.RangeBlocks(poses, anchors, biases, [TAG_IN_CAM_M])
        ceres.add_ranges(adjuster, placed, blocks, loss_scale=LOSS_SCALE)
    hold_or_tie(adjuster, reconstruction, anchors, biases, case.solver == "free")
    return anchors, biases


def hold_or_tie(
    adjuster: pycolmap.CeresBundleAdjuster,
    reconstruction: pycolmap.Reconstruction,
    anchors: list[Array],
    biases: list[Array],
    free: bool,
) -> None:
    problem = adjuster.problem
    short = sorted(reconstruction.points3D.items(), key=lambda item: (item[1].track.length(), item[0]))
    for anchor, bias, (_, point) in zip(anchors, biases, short[: len(anchors)], strict=True):
        for block in (anchor, bias):
            if problem.has_parameter_block(block) and not (free and block is anchor):
                problem.set_parameter_block_constant(block)
        if free and problem.has_parameter_block(anchor):
            ceres.keep_from_elimination(adjuster, anchor, point.xyz)


def add_python_ranges(
    adjuster: pycolmap.CeresBundleAdjuster, ranges: Ranges, poses: list[Array], anchors: list[Array]
) -> None:
    import pyceres

    class PythonRange(pyceres.CostFunction):  # type: ignore[misc]
        def __init__(self, range_m: float) -> None:
            super().__init__()
            self.range_m = range_m
            self.set_num_residuals(1)
            self.set_parameter_block_sizes([7, 3])

        def Evaluate(self, parameters: Any, residuals: Any, jacobians: Any) -> bool:  # noqa: N802
            (x, y, z, w, *t), anchor = parameters[0].tolist(), parameters[1]
            rotation = quaternion_matrix(x, y, z, w)
            d = TAG_IN_CAM_M - t
            between = d @ rotation - anchor
            distance = np.sqrt(between @ between)
            residuals[0] = (distance - self.range_m) / RANGE_STDDEV
            if jacobians is not None:
                direction = between / (distance * RANGE_STDDEV)
                if jacobians[0] is not None:
                    jacobians[0][:] = pose_gradient((x, y, z), w, rotation, d, direction)
                if jacobians[1] is not None:
                    jacobians[1][:] = -direction
            return True

    loss = pyceres.CauchyLoss(LOSS_SCALE)
    for range_m, keyframe, anchor in zip(ranges.range_m, ranges.keyframe, ranges.anchor, strict=True):
        ceres.add_residual_block(adjuster, PythonRange(range_m), loss, [poses[keyframe], anchors[anchor]])


def quaternion_matrix(x: float, y: float, z: float, w: float) -> Array:
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def pose_gradient(vector: Any, w: float, rotation: Array, d: Array, direction: Array) -> Array:
    """(7,) derivative of direction . R^T d, with d = tag - t, by [qx qy qz qw tx ty tz]."""
    u = np.array(vector)
    cross = np.array(
        [
            direction[1] * d[2] - direction[2] * d[1],
            direction[2] * d[0] - direction[0] * d[2],
            direction[0] * d[1] - direction[1] * d[0],
        ]
    )
    of_vector = 2 * (w * cross + (u @ d) * direction + (u @ direction) * d - 2 * (direction @ d) * u)
    return np.concatenate([of_vector, [2 * (u @ cross)], -(rotation @ direction)])


def gtsam_solver(case: Case, folder: Path, arrays: Any) -> Solve:
    import gtsam

    def solve(max_num_iterations: int) -> tuple[int, float, float, float, Array]:
        start = time.process_time()
        graph, values = gtsam_problem(gtsam, arrays)
        parameters = gtsam.LevenbergMarquardtParams()
        parameters.setMaxIterations(max_num_iterations)
        parameters.setRelativeErrorTol(TOLERANCE if max_num_iterations == MAX_ITERATIONS else 0.0)
        parameters.setAbsoluteErrorTol(0.0)
        built = time.process_time()
        optimizer = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters)
        result = optimizer.optimize()
        done = time.process_time()
        centers = np.array([result.atPose3(k).translation() for k in range(len(arrays["poses"]))])
        return optimizer.iterations(), built - start, done - built, optimizer.error(), centers

    return solve


def gtsam_problem(gtsam: Any, arrays: Any) -> tuple[Any, Any]:
    num_poses, num_points = len(arrays["poses"]), len(arrays["points"])
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for key, pose in enumerate(arrays["poses"]):
        rotation = Rotation.from_quat(pose[:4]).as_matrix().T
        values.insert(key, gtsam.Pose3(gtsam.Rot3(rotation), -rotation @ pose[4:]))
    for key, point in enumerate(np.concatenate([arrays["points"], arrays["anchors"]]), start=num_poses):
        values.insert(key, point)
    graph.add(gtsam.NonlinearEqualityPose3(0, values.atPose3(0)))
    camera, pixel = gtsam.Cal3_S2(FOCAL_PX, FOCAL_PX, 0.0, *PRINCIPAL_POINT_PX), gtsam.noiseModel.Unit.Create(2)
    for frame, point, x, y in arrays["observations"]:
        key = num_poses + int(point)
        graph.add(gtsam.GenericProjectionFactorCal3_S2(np.array([x, y]), pixel, int(frame), key, camera))
    ranges, first_anchor = ranges_in(arrays, "at"), num_poses + num_points
    used = np.unique(ranges.anchor)
    for k, anchor in enumerate(arrays["anchors"]):
        if k in used:
            graph.add(gtsam.NonlinearEqualityPoint3(first_anchor + k, anchor))
        else:
            values.erase(first_anchor + k)
    cauchy = gtsam.noiseModel.mEstimator.Cauchy.Create(LOSS_SCALE)
    noise = gtsam.noiseModel.Robust.Create(cauchy, gtsam.noiseModel.Isotropic.Sigma(1, RANGE_STDDEV))
    tag = gtsam.Pose3(gtsam.Rot3(), TAG_IN_CAM_M)
    for keyframe, k, range_m in zip(ranges.keyframe, ranges.anchor, ranges.range_m, strict=True):
        graph.add(gtsam.RangeFactorWithTransform3D(int(keyframe), first_anchor + int(k), range_m, noise, tag))
    return graph, values


def scipy_solver(case: Case, folder: Path, arrays: Any) -> Solve:
    from scipy.optimize import least_squares
    from scipy.sparse import coo_matrix

    seen = arrays["observations"]
    seen = seen[seen[:, 1].astype(int) % SCIPY_THINNING == 0]
    frame, (ids, point) = seen[:, 0].astype(int), np.unique(seen[:, 1].astype(int), return_inverse=True)
    ranges, poses = ranges_in(arrays, "at"), arrays["poses"]
    num = len(poses)
    first = np.concatenate([np.zeros(6), np.zeros(6 * (num - 1)), arrays["points"][ids].ravel()])[6:]

    def unpack(x: Array) -> tuple[Rotation, Array, Array]:
        steps = np.concatenate([np.zeros(6), x[: 6 * (num - 1)]]).reshape(num, 6)
        rotation = Rotation.from_rotvec(steps[:, :3]) * Rotation.from_quat(poses[:, :4])
        return rotation, poses[:, 4:] + steps[:, 3:], x[6 * (num - 1) :].reshape(-1, 3)

    def residuals(x: Array) -> Array:
        rotation, t, points = unpack(x)
        in_cam = rotation[frame].apply(points[point]) + t[frame]
        pixels = FOCAL_PX * in_cam[:, :2] / in_cam[:, 2:] + PRINCIPAL_POINT_PX - seen[:, 2:]
        tags = rotation.inv().apply(TAG_IN_CAM_M - t)[ranges.keyframe]
        error = np.linalg.norm(tags - arrays["anchors"][ranges.anchor], axis=1) - ranges.range_m
        scaled = error / RANGE_STDDEV
        robust = np.sign(scaled) * LOSS_SCALE * np.sqrt(np.log1p((scaled / LOSS_SCALE) ** 2))
        return np.concatenate([pixels.ravel(), robust])

    rows, columns = [], []
    for axis in range(2):
        row = 2 * np.arange(len(seen)) + axis
        for keys, offset, size in ((frame - 1, 0, 6), (point, 6 * (num - 1), 3)):
            rows.append(np.repeat(row[keys >= 0], size))
            columns.append((offset + size * keys[keys >= 0][:, None] + np.arange(size)).ravel())
    rows.append(np.repeat(2 * len(seen) + np.arange(len(ranges.range_m)), 6))
    columns.append((6 * (ranges.keyframe - 1)[:, None] + np.arange(6)).ravel())
    row, column = np.concatenate(rows), np.concatenate(columns)
    sparsity = coo_matrix((np.ones(len(row)), (row, column)), shape=(2 * len(seen) + len(ranges.range_m), len(first)))

    def solve(max_num_iterations: int) -> tuple[int, float, float, float, Array]:
        start = time.process_time()
        tolerance = TOLERANCE if max_num_iterations == MAX_ITERATIONS else 1e-15
        found = least_squares(
            residuals, first, jac_sparsity=sparsity, ftol=tolerance, xtol=1e-15, gtol=1e-15, max_nfev=max_num_iterations
        )
        rotation, t, _ = unpack(found.x)
        seconds = time.process_time() - start
        return found.nfev, 0.0, seconds, float(found.cost), -rotation.inv().apply(t)

    return solve


def centers_of(poses: Array) -> Array:
    centers: Array = -Rotation.from_quat(poses[:, :4]).inv().apply(poses[:, 4:])
    return centers


def measure(case: Case, folder: Path) -> Outcome:
    if case.solver == "gtsam":
        import gtsam  # noqa: F401
    before = peak_bytes()
    with np.load(folder / "survey.npz") as archive:
        arrays = dict(archive)
    make = {"gtsam": gtsam_solver, "scipy": scipy_solver}.get(case.solver, ceres_solver)
    solve = make(case, folder, arrays)
    iteration = iteration_seconds(solve)
    num, build, seconds, cost, centers = solve(MAX_ITERATIONS)
    return Outcome(
        iteration=iteration,
        build=build,
        total=build + seconds,
        num_iterations=num,
        memory_mb=(peak_bytes() - before) / 1e6,
        rmse_m=float(np.sqrt(np.mean(np.sum((centers - arrays["centers"]) ** 2, axis=1)))),
        final_cost=cost,
    )


def iteration_seconds(solve: Solve) -> float:
    """Return the median time of an iteration, repeating short trials until the time is known well enough."""
    trials: list[float] = []
    start = time.process_time()
    while len(trials) < MIN_TRIALS or time.process_time() - start < MIN_SECONDS:
        few, more = solve(FEW_ITERATIONS), solve(MORE_ITERATIONS)
        trials.append((more[2] - few[2]) / max(more[0] - few[0], 1))
    return float(np.median(trials))


def cases(num_keyframes: int, num_ranges: int, wanted: Sequence[str]) -> list[Case]:
    left_out = set(SOLVERS) - {"none", *wanted}
    if num_keyframes > MAX_SCIPY_KEYFRAMES:
        left_out.add("scipy")
    if num_keyframes * num_ranges > MAX_PYTHON_RANGES:
        left_out.add("python")
    if importlib.util.find_spec("gtsam") is None:
        left_out.add("gtsam")
    return [Case(solver, num_keyframes, num_ranges) for solver in SOLVERS if solver not in left_out]


def run(case: Case, folder: Path) -> Outcome:
    command = [
        sys.executable,
        "-m",
        "tests.benchmarks.solvers",
        "--case",
        json.dumps(asdict(case)),
        "--folder",
        str(folder),
    ]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True, cwd=Path(__file__).parents[2])
    return Outcome(**json.loads(done.stdout.splitlines()[-1]))


def print_table(outcomes: dict[Case, list[Outcome]]) -> None:
    without = next(found for case, found in outcomes.items() if case.solver == "none")
    for case, found in outcomes.items():
        ratios = [mine.iteration / theirs.iteration for mine, theirs in zip(found, without, strict=True)]
        totals = [mine.total / theirs.total for mine, theirs in zip(found, without, strict=True)]
        middle = {name: float(np.median([getattr(one, name) for one in found])) for name in vars(found[0])}
        print(
            f"{case.num_keyframes:9d} {case.num_ranges:6d}  {case.solver:8} {1e3 * middle['iteration']:9.1f} "
            f"{np.median(ratios):6.2f} {middle['build']:8.2f} {middle['total']:8.2f} {np.median(totals):6.2f} "
            f"{middle['num_iterations']:6.0f} {middle['memory_mb']:8.0f} {middle['rmse_m']:8.4f} "
            f"{middle['final_cost']:12.1f}",
            flush=True,
        )


def main() -> None:
    parser = argparse.ArgumentParser(description="Solvers of bundle adjustment with ranges, side by side.")
    parser.add_argument("--num_keyframes", type=int, nargs="+", default=[50, 200, 600])
    parser.add_argument("--num_ranges", type=int, nargs="+", default=[1, 10, 100], help="at each keyframe")
    parser.add_argument("--num_rounds", type=int, default=3)
    parser.add_argument("--solvers", nargs="+", choices=SOLVERS, default=SOLVERS, help="beside `none`")
    parser.add_argument("--case", help=argparse.SUPPRESS)
    parser.add_argument("--folder", type=Path, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.case:
        print(json.dumps(asdict(measure(Case(**json.loads(arguments.case)), arguments.folder))))
        return
    print("keyframes ranges  solver   ms/iter.  ratio  build s  total s  ratio  iter.  peak MB   RMSE m         cost")
    for num_keyframes in arguments.num_keyframes:
        for num_ranges in arguments.num_ranges:
            with tempfile.TemporaryDirectory() as folder:
                write_survey(make_survey(num_keyframes, num_ranges), Path(folder))
                chosen = cases(num_keyframes, num_ranges, arguments.solvers)
                outcomes: dict[Case, list[Outcome]] = {case: [] for case in chosen}
                for _ in range(arguments.num_rounds):
                    for case, found in outcomes.items():
                        found.append(run(case, Path(folder)))
                print_table(outcomes)


if __name__ == "__main__":
    main()

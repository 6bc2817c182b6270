"""One scene with every kind of measurement: a curved chain of photos, anchors, lengths, marks and positions."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import pycolmap
import pytest
from scipy.spatial.transform import Rotation
from tests.known_errors import known_errors
from tests.simulated.model import SyntheticModel, synthetic_model
from tests.simulated.path import lap_path

from rangesfm.measurements.gravity import UpwardDirection
from rangesfm.measurements.imu.inertial_motions import (
    CLOCK,
    CROSS_AXES,
    GRAVITY,
    MOUNTING,
    SCALE_ERRORS,
    GravityLength,
    InertialMotions,
    bias_block,
    velocity_block,
)
from rangesfm.measurements.imu.motion import Mounting
from rangesfm.measurements.imu.preintegration import preintegrate
from rangesfm.measurements.imu.sensor_prior import SensorPrior
from rangesfm.measurements.kind import LEAST_SQUARES, MapState, Measurements
from rangesfm.measurements.lengths.cost import Lengths
from rangesfm.measurements.lengths.tape import Marker
from rangesfm.measurements.places import AntennaPlaces
from rangesfm.measurements.points import NamedPoints
from rangesfm.measurements.positions.cost import AntennaPositions, MarkedPositions
from rangesfm.measurements.prior import Prior
from rangesfm.measurements.ranges.anchors.anchor import AnchorEstimate
from rangesfm.measurements.ranges.association import associate
from rangesfm.measurements.ranges.cost import Ranges
from rangesfm.measurements.ranges.radio import ranges_of_map
from rangesfm.measurements.ranges.range_log import RangeLog
from rangesfm.options import RefineOptions
from rangesfm.util.geometry.gravity import Gravity
from rangesfm.util.geometry.poses import Poses, model_poses
from rangesfm.util.geometry.robust_statistics import RobustLoss
from rangesfm.util.geometry.similarity import IDENTITY
from rangesfm.util.geometry.trajectory import Trajectory, trajectory_from_reconstruction

Array = npt.NDArray[np.float64]
KINDS = (
    "range",
    "position",
    "length",
    "length by radio",
    "control point",
    "gravity",
    "prior",
    "inertial",
    "bias walk",
    "gravity length",
)
ARM_M = np.array([0.2, -0.3, 0.1])


@dataclass(frozen=True)
class Scene:
    """A metric map with measurements that it does not quite fit.

    Attributes:
        model: the map. path: of its keyframes. kinds: measurements by name.
        state: of the map, with marks where their rays meet.
    """

    model: pycolmap.Reconstruction
    path: Trajectory
    markers: dict[str, Marker]
    kinds: dict[str, Measurements]
    state: MapState


@pytest.fixture(scope="module")
def scene() -> Scene:
    rng, num = np.random.default_rng(5), 12
    curve, times = lap_path(30.0, share=0.1), np.linspace(0.0, 6.0, num)
    made = synthetic_model(
        times,
        curve.centers(times),
        curve.world_from_cam(times),
        num_observations=30,
        max_track_length=6,
        depth_range_m=(3.0, 12.0),
        metric_from_sfm=IDENTITY,
        seed=1,
    )
    path = trajectory_from_reconstruction(made.reconstruction, made.timestamps_s)
    poses = model_poses(made.reconstruction, path.frame_ids)
    markers = {f"M{k}": marker for k, marker in enumerate(_markers(made, 3))}
    ranges, motions = _ranges(path, rng), _motions(path, rng)
    points = NamedPoints.in_model(made.reconstruction, markers, ranges.placed_anchors, path.frame_ids)
    kinds: dict[str, Measurements] = {
        "range": ranges,
        "position": _positions(path, rng),
        "length": Lengths(
            ((path.image_names[0], path.image_names[7]), ("M0", "M1"), ("A0", "A2"), ("M2", path.image_names[3])),
            points, rng.uniform(2, 6, 4), rng.uniform(0.01, 0.1, 4), {},
        ),
        "length by radio": Lengths(
            (("A0", "A1"), ("A1", "A2")), points, rng.uniform(3, 9, 2), np.array([0.1, 0.2]), {},
            bias_stddev_m=0.1, loss=RobustLoss(3.0, is_bounded=True),
        ),
        "control point": MarkedPositions(
            ("M0", "M2"), points, rng.normal(0, 3, (2, 3)), np.array([0.02, 0.05]), {"M0": np.diag([1e-4, 2e-4, 3e-4])}
        ),
        "gravity": UpwardDirection(Gravity(poses.world_from_rig[0].T @ [0.0, 0.6, 0.8], 0.05)),
        "prior": Prior(
            ((("bias", "A0"), ("bias", "A1"), ("bias", "A2")),),
            rng.normal(0, 0.1, (1, 3, 1)),
            rng.normal(0, 5, (1, 3, 3)),
        ),
        "inertial": motions,
        "bias walk": [*motions.priors()][-1],
        "gravity length": GravityLength(),
    }  # fmt: skip
    blocks = {name: at + rng.normal(0, 0.1, at.shape) for kind in kinds.values() for name, at in kind.blocks.items()}
    return Scene(made.reconstruction, path, markers, kinds, MapState(poses, blocks))


def _markers(made: SyntheticModel, num: int) -> Iterator[Marker]:
    """Yield marks of the points with the longest tracks, a little off, as people click."""
    model, rng = made.reconstruction, np.random.default_rng(1)
    for point in sorted(model.points3D.values(), key=lambda point: -point.track.length())[:num]:
        exact = marker_of(model, point)
        yield replace(exact, pixels=exact.pixels + rng.normal(0, 0.5, exact.pixels.shape))


def marker_of(model: pycolmap.Reconstruction, point: pycolmap.Point3D) -> Marker:
    """Return the marks of a point in all photos that see it."""
    images = [model.image(element.image_id) for element in point.track.elements]
    pixels = np.array([image.project_point(point.xyz) for image in images])
    return Marker(tuple(image.name for image in images), pixels, (0,) * len(images))


def _ranges(path: Trajectory, rng: np.random.Generator) -> Ranges:
    num = 30
    anchors = tuple(
        AnchorEstimate(f"A{k}", at, 0.1, at, 0.1, 0.0, 0.0, 0.1)
        for k, at in enumerate(path.centers[:3] + rng.normal(0, 6, (3, 3)))
    )
    times = rng.uniform(0.1, 5.9, num)
    log = RangeLog.from_arrays([f"A{k % 3}" for k in range(num)], rng.uniform(3, 9, num), timestamp_s=times)
    placed = associate(log, path, ARM_M)
    bow = rng.normal(0, 0.1, (num, 3))  # the path is hardly curved between its keyframes
    placed = replace(placed, centers=placed.centers + bow, center_offsets=placed.center_offsets + bow)
    options = RefineOptions(lever_arm_stddev_m=0.1, time_offset_stddev_s=0.1, short_range_stddev_m=0.1)
    ranges = ranges_of_map(path, placed, IDENTITY, ARM_M, anchors, known_errors(placed, 0.1), options)
    loose = replace(ranges.errors, loss=LEAST_SQUARES, share=rng.uniform(0.5, 1.5, len(ranges.rows)))
    return replace(ranges, errors=loose, shared_errors_m=rng.normal(0, 0.1, (num, 8)))


def _positions(path: Trajectory, rng: np.random.Generator) -> AntennaPositions:
    before = np.array([3, 0, 8, 0, 5, 9])
    after = before + np.array([1, 1, 1, 1, 0, 1])
    fraction = np.where(after > before, rng.uniform(0.1, 0.9, 6), 0.0)
    places = AntennaPlaces(
        before, after, fraction, path.times_s[after] - path.times_s[before],
        (after > before)[:, None] * rng.normal(0, 0.1, (6, 3)),
    )  # fmt: skip
    roots = np.linalg.inv(np.linalg.cholesky([0.1**2 * np.eye(3) + np.outer(v, v) for v in rng.normal(0, 0.1, (6, 3))]))
    return AntennaPositions(
        tuple("abcdef"), places, path.centers[before] + rng.normal(0, 0.3, (6, 3)), roots, np.zeros(6), np.arange(6),
        ARM_M, 0.1, 0.1, LEAST_SQUARES, inflation=1.2,
    )  # fmt: skip


def _motions(path: Trajectory, rng: np.random.Generator) -> InertialMotions:
    """Return the motions of a sensor between photos, of which one is missing."""
    log_s, num = np.linspace(-0.1, 6.1, 100), len(path)
    intervals = preintegrate(log_s, rng.normal(0, 0.1, (100, 3)), rng.normal(0, 1, (100, 3)) + 9.8, path.times_s)
    intervals = intervals.subset(np.delete(np.arange(num - 1), 4))
    start = {velocity_block(photo): rng.normal(0, 1, 3) for photo in range(num)}
    start |= {bias_block(k): rng.normal(0, 0.1, 6) for k in range(3)}
    start |= {
        GRAVITY: np.array([1.0, -9.0, 4.0]),
        SCALE_ERRORS: np.zeros(6),
        CROSS_AXES: np.zeros(6),
        CLOCK: np.zeros(1),
        MOUNTING: np.zeros(6),
    }
    stretch = np.arange(len(intervals)) * 3 // len(intervals)
    roots, mounting = rng.normal(0, 3, (len(intervals), 9, 9)), Mounting(path.world_from_cam[5], ARM_M)
    prior = SensorPrior(clock_s=0.01, turn_rad=0.02, arm_m=0.03)
    walk = rng.uniform(0.01, 0.1, (2, 6))
    return InertialMotions(intervals, roots, stretch, walk, mounting, prior, start, LEAST_SQUARES)


def moved(poses: Poses, frame: int, step: Array) -> Poses:
    """Return the poses after a turn of a rig in its own frame and a shift of its origin."""
    turns, centers = poses.world_from_rig.copy(), poses.centers.copy()
    turns[frame] = turns[frame] @ Rotation.from_rotvec(step[:3]).as_matrix()
    centers[frame] += step[3:]
    return Poses(turns, centers)

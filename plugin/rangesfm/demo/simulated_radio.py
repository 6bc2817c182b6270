"""Simulated range log along a known path, with noise, biases, obstructed and lost ranges, and a clock of its own."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from rangesfm.arrays import Array
from rangesfm.measurements.ranges.range_log import RangeLog

# Shortest range that a radio measures; ranges in a log are positive.
_MIN_RANGE_M = 0.01


@dataclass(frozen=True)
class CameraPath:
    """Camera pose as a function of time on the camera's clock.

    Attributes:
        start_s, end_s: first and last time at which it is defined.
        position: spline of the projection centre, metres.
        rotation: spline of world_from_cam.
    """

    start_s: float
    end_s: float
    position: CubicSpline
    rotation: RotationSpline

    @classmethod
    def through(cls, times_s: Array, centers_m: Array, world_from_cam: Array) -> CameraPath:
        """Return a smooth path through n poses.

        Args:
            times_s: (n,) times, strictly increasing, n >= 2.
            centers_m: (n, 3) projection centres, metres.
            world_from_cam: (n, 3, 3) rotations.
        """
        rotations = Rotation.from_matrix(world_from_cam)
        return cls(
            float(times_s[0]), float(times_s[-1]), CubicSpline(times_s, centers_m), RotationSpline(times_s, rotations)
        )

    def centers(self, times_s: Array) -> Array:
        """Return the projection centres (n, 3) in the world at n times, metres."""
        return np.asarray(self.position(times_s))

    def world_from_cam(self, times_s: Array) -> Array:
        """Return the rotations world_from_cam (n, 3, 3) at n times."""
        return np.asarray(self.rotation(times_s).as_matrix())


@dataclass(frozen=True)
class Radio:
    """Error model of a simulated radio.

    Attributes:
        rate_hz: ranges to each anchor per second; the anchors take turns.
        range_stddev_m: standard deviation of the Gaussian noise.
        range_bias_m: bias of the ranges to each anchor, by anchor id (positive: too long); 0 where not given.
        obstructed_share: share of ranges without line of sight.
        obstructed_mean_m: mean of their additional error, which is positive and exponentially distributed.
        lost_share: share of ranges that never arrive.
        time_offset_s: image time = range time + offset.
        resolution_m: ranges are multiples of it; 0: not rounded.
    """

    rate_hz: float = 10.0
    range_stddev_m: float = 0.0
    range_bias_m: Mapping[str, float] = field(default_factory=dict)
    obstructed_share: float = 0.0
    obstructed_mean_m: float = 1.0
    lost_share: float = 0.0
    time_offset_s: float = 0.0
    resolution_m: float = 0.0


def simulate_ranges(
    path: CameraPath,
    anchors_m: Mapping[str, Sequence[float] | Array],
    tag_in_cam_m: Sequence[float] | Array,
    radio: Radio,
    seed: int = 0,
) -> RangeLog:
    """Simulate ranges at the radio's rate along a whole path; the log has the times of the radio's clock.

    Args:
        anchors_m: position (3,) of each anchor in the world, by id, metres.
        tag_in_cam_m: (3,) lever arm of the tag in the camera frame, metres.
    """
    num_rounds = int((path.end_s - path.start_s) * radio.rate_hz)
    turn = np.arange(num_rounds * len(anchors_m))
    times = path.start_s + turn / (radio.rate_hz * len(anchors_m))
    tags = path.centers(times) + path.world_from_cam(times) @ np.asarray(tag_in_cam_m, dtype=np.float64)
    return measure_ranges(times, tags, turn % len(anchors_m), anchors_m, radio, seed)


def measure_ranges(
    times_s: Array,
    tags_m: Array,
    anchor_index: npt.NDArray[np.int64],
    anchors_m: Mapping[str, Sequence[float] | Array],
    radio: Radio,
    seed: int,
) -> RangeLog:
    """Simulate the radio's measurement of n distances; the radio's rate is not used.

    Args:
        times_s: (n,) times on the camera's clock.
        tags_m: (n, 3) positions of the moving antenna in the world, metres.
        anchor_index: (n,) index of each distance's anchor in ``anchors_m``.
        anchors_m: position (3,) of each anchor in the world, by id, metres.
    """
    rng = np.random.default_rng(seed)
    ids = np.array(list(anchors_m))
    positions = np.array([anchors_m[name] for name in anchors_m], dtype=np.float64)
    biases = np.array([radio.range_bias_m.get(name, 0.0) for name in anchors_m])
    distances = np.linalg.norm(tags_m - positions[anchor_index], axis=1)
    is_obstructed = rng.random(len(times_s)) < radio.obstructed_share
    ranges = distances + biases[anchor_index] + radio.range_stddev_m * rng.standard_normal(len(times_s))
    ranges += is_obstructed * rng.exponential(radio.obstructed_mean_m, len(times_s))
    if radio.resolution_m > 0:
        ranges = np.round(radio.resolution_m * np.rint(ranges / radio.resolution_m), 12)
    ranges = np.maximum(ranges, max(_MIN_RANGE_M, radio.resolution_m))
    arrived = rng.random(len(times_s)) >= radio.lost_share
    return RangeLog.from_arrays(
        ids[anchor_index[arrived]], ranges[arrived], timestamp_s=times_s[arrived] - radio.time_offset_s
    )

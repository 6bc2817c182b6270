"""The stddev of a time offset is honest on short logs whose errors last for seconds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation

from rangesfm.demo.simulated_radio import CameraPath, Radio, simulate_ranges
from rangesfm.errors import GeometryError
from rangesfm.measurements.ranges.range_log import RangeLog
from rangesfm.measurements.ranges.time_offset import estimate_time_offset
from rangesfm.util.geometry.trajectory import Trajectory

Array = npt.NDArray[np.float64]

TAG_IN_CAM_M = (0.1, -0.05, 0.03)
OFFSET_S = 12.3
DURATION_S = 20.0
CORRELATION_S = 2.0
NUM_SEEDS = 6


def walk(seed: int) -> CameraPath:
    """A path with a new direction about every two seconds."""
    rng = np.random.default_rng([seed, 1])
    times = np.arange(0.0, DURATION_S + 2.0, 2.0)
    centers = rng.normal(0, 1, (len(times), 3)) * [1.8, 1.8, 0.4]
    rotations = Rotation.from_rotvec(rng.normal(0, 0.4, (len(times), 3))).as_matrix()
    return CameraPath.through(times, centers, rotations)


def photos_of(path: CameraPath, seed: int) -> Trajectory:
    """A keyframe a second, in a world of another scale."""
    rng = np.random.default_rng([seed, 2])
    times = np.arange(0.1, DURATION_S, 1.0)
    centers = path.centers(times) + 0.005 * rng.standard_normal((len(times), 3))
    names = tuple(f"{number:04d}.jpg" for number in range(len(times)))
    return Trajectory(np.arange(len(times)), names, times, centers / 0.45, path.world_from_cam(times))


def log_of(path: CameraPath, num_anchors: int, seed: int) -> RangeLog:
    """Ranges with white noise, slow errors, and some that are far too long."""
    rng = np.random.default_rng([seed, 3])
    positions = rng.uniform([-5, -5, 0], [5, 5, 2.5], (num_anchors, 3))
    anchors = {f"A{number}": position for number, position in enumerate(positions)}
    radio = Radio(rate_hz=5, range_stddev_m=0.06, obstructed_share=0.1, obstructed_mean_m=0.7, time_offset_s=OFFSET_S)
    log = simulate_ranges(path, anchors, TAG_IN_CAM_M, radio, seed)
    slow = np.zeros(len(log))
    for anchor in range(num_anchors):
        rows = np.flatnonzero(log.anchor_index == anchor)
        slow[rows] = 0.08 * exponentially_correlated(log.timestamp_s[rows] / CORRELATION_S, rng)
    return replace(log, range_m=np.maximum(log.range_m + slow, 0.05))


def exponentially_correlated(times: Array, rng: np.random.Generator) -> Array:
    """(n,) process of stddev 1 whose correlation falls to 1/e over a time of 1."""
    kept = np.exp(-np.diff(times, prepend=-np.inf))
    fresh = np.sqrt(1 - kept**2) * rng.standard_normal(len(times))
    values = np.zeros(len(times))
    for i in range(len(times)):
        values[i] = (kept[i] * values[i - 1] if i else 0.0) + fresh[i]
    return values


@pytest.mark.parametrize("num_anchors", [1, 4])
def test_offset_of_a_short_log_with_errors_that_stay_is_as_certain_as_it_is_said_to_be(num_anchors: int) -> None:
    errors, stddevs = [], []
    for seed in range(NUM_SEEDS):
        path = walk(seed)
        try:
            log = log_of(path, num_anchors, seed)
            found = estimate_time_offset(log, photos_of(path, seed), TAG_IN_CAM_M, seed=seed)
        except GeometryError:
            continue
        errors.append(found.value_s - OFFSET_S)
        stddevs.append(found.stddev_s)
    assert len(errors) >= NUM_SEEDS - 1
    scaled = np.array(errors) / stddevs
    # With residuals summed over blocks, and without the jackknife's steps, both are 1.6 to 1.9.
    assert 0.4 < np.sqrt(np.mean(scaled**2)) < 1.4
    assert np.mean(np.abs(scaled) < 1.96) >= 0.8
    assert np.median(stddevs) < 0.03

"""Measure how honest the stddev of an estimated time offset is, on short logs with errors that last for seconds.

    python -m tests.studies.clock_coverage [--num_seeds 40] [--durations_s 20 40 60 190] [--num_anchors 1 4 8]

A hand-held walk in a room of about 8 x 8 m, a photo a second, five ranges a second to each of some anchors at unknown
positions. The ranges have white noise, a slow error as from multipath and antenna patterns (exponentially correlated
over ``--correlation_s``, independent for each anchor), and some are far too long. For every length of the log and
number of anchors it prints how many logs were refused, the true root mean square error of the offset, the median stated
stddev, the share of estimates whose error is within 1.96 stated stddevs (95 % if honest), and the root mean square of
the errors in stddevs (1 if honest).
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from rangesfm.demo.simulated_radio import CameraPath, Radio, simulate_ranges
from rangesfm.errors import GeometryError
from rangesfm.geometry.trajectory import Trajectory
from rangesfm.ranging.clock.time_offset import estimate_time_offset
from rangesfm.ranging.range_log import RangeLog

Array = npt.NDArray[np.float64]

TAG_IN_CAM_M = (0.1, -0.05, 0.03)
OFFSET_S = 12.3
PHOTO_STDDEV_M = 0.005


def walk(duration_s: float, seed: int) -> CameraPath:
    """A path with a new direction about every two seconds."""
    rng = np.random.default_rng([seed, 1])
    times = np.arange(0.0, duration_s + 2.0, 2.0)
    centers = rng.normal(0, 1, (len(times), 3)) * [1.8, 1.8, 0.4]
    rotations = Rotation.from_rotvec(rng.normal(0, 0.4, (len(times), 3))).as_matrix()
    return CameraPath.through(times, centers, rotations)


def photos_of(path: CameraPath, duration_s: float, seed: int) -> Trajectory:
    """A keyframe a second, in a world of another scale."""
    rng = np.random.default_rng([seed, 2])
    times = np.arange(0.1, duration_s, 1.0)
    centers = path.centers(times) + PHOTO_STDDEV_M * rng.standard_normal((len(times), 3))
    names = tuple(f"{number:04d}.jpg" for number in range(len(times)))
    return Trajectory(np.arange(len(times)), names, times, centers / 0.45, path.world_from_cam(times))


def log_of(path: CameraPath, num_anchors: int, correlation_s: float, seed: int) -> RangeLog:
    """Ranges with white noise, slow errors, and some that are far too long."""
    rng = np.random.default_rng([seed, 3])
    positions = rng.uniform([-5, -5, 0], [5, 5, 2.5], (num_anchors, 3))
    anchors = {f"A{number}": position for number, position in enumerate(positions)}
    radio = Radio(rate_hz=5, range_stddev_m=0.06, obstructed_share=0.1, obstructed_mean_m=0.7, time_offset_s=OFFSET_S)
    log = simulate_ranges(path, anchors, TAG_IN_CAM_M, radio, seed).log
    assert log.timestamp_s is not None
    slow = np.zeros(len(log))
    for anchor in range(num_anchors):
        rows = np.flatnonzero(log.anchor_index == anchor)
        slow[rows] = 0.08 * exponentially_correlated(log.timestamp_s[rows] / correlation_s, rng)
    return replace(log, range_m=np.maximum(log.range_m + slow, 0.05))


def exponentially_correlated(times: Array, rng: np.random.Generator) -> Array:
    """(n,) process of stddev 1 whose correlation falls to 1/e over a time of 1."""
    kept = np.exp(-np.diff(times, prepend=-np.inf))
    fresh = np.sqrt(1 - kept**2) * rng.standard_normal(len(times))
    values = np.zeros(len(times))
    for i in range(len(times)):
        values[i] = (kept[i] * values[i - 1] if i else 0.0) + fresh[i]
    return values


def estimates(duration_s: float, num_anchors: int, correlation_s: float, num_seeds: int) -> tuple[Array, Array]:
    """(k,) errors and (k,) stated stddevs of the estimates that were not refused, seconds."""
    errors, stddevs = [], []
    for seed in range(num_seeds):
        path = walk(duration_s, seed)
        log = log_of(path, num_anchors, correlation_s, seed)
        try:
            found = estimate_time_offset(log, photos_of(path, duration_s, seed), TAG_IN_CAM_M, seed=seed)
        except GeometryError:
            continue
        errors.append(found.value_s - OFFSET_S)
        stddevs.append(found.stddev_s)
    return np.array(errors), np.array(stddevs)


def row(duration_s: float, num_anchors: int, correlation_s: float, num_seeds: int) -> str:
    """One line of the table."""
    errors, stddevs = estimates(duration_s, num_anchors, correlation_s, num_seeds)
    head = f"{duration_s:10.0f} {num_anchors:7d} {num_seeds - len(errors):7d}/{num_seeds:<4d}"
    if not len(errors):
        return head
    scaled = errors / stddevs
    rms_s, stddev_s = np.sqrt(np.mean(errors**2)), np.median(stddevs)
    return (
        f"{head} {rms_s:9.4f} {stddev_s:9.4f} {100 * np.mean(np.abs(scaled) < 1.96):9.0f} "
        f"{np.sqrt(np.mean(scaled**2)):8.2f} {np.abs(scaled).max():7.1f}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--num_seeds", type=int, default=40)
    parser.add_argument("--durations_s", type=float, nargs="+", default=[20.0, 40.0, 60.0, 190.0])
    parser.add_argument("--num_anchors", type=int, nargs="+", default=[1, 4, 8])
    parser.add_argument("--correlation_s", type=float, default=2.0)
    options = parser.parse_args()
    print("duration_s anchors refused/of    rms_s  stddev_s  covered_%  rms_z   max_z")
    for duration_s in options.durations_s:
        for num_anchors in options.num_anchors:
            print(row(duration_s, num_anchors, options.correlation_s, options.num_seeds), flush=True)


if __name__ == "__main__":
    main()

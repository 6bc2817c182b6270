"""Measure how long it takes to place a million ranges on a path of a thousand keyframes.

    python -m tests.benchmarks.association [NUM_RANGES [NUM_KEYFRAMES]]

The keyframes are a walk at 2 Hz. The ranges to eight anchors are spread over it, either in order of time or shuffled.
For comparison, the same data are processed by the least work that any such method needs: sorting the times and
interpolating three coordinates linearly (numpy.argsort and numpy.interp). Times are processor times, so that other
programs do not count; run it with OMP_NUM_THREADS=1. The last column is the largest distance of a found place from the
true path.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable

import numpy as np
import numpy.typing as npt
from tests.simulated.path import loop_path

from rangesfm.geometry.trajectory import Trajectory
from rangesfm.ranging.association import associate
from rangesfm.ranging.range_log import RangeLog

Array = npt.NDArray[np.float64]

_NUM_REPETITIONS = 5
_KEYFRAME_INTERVAL_S = 0.5
_TAG_IN_CAM_M = (0.05, -0.12, -0.03)


def best_of(work: Callable[[], object]) -> float:
    seconds = []
    for _ in range(_NUM_REPETITIONS):
        start = time.process_time()
        work()
        seconds.append(time.process_time() - start)
    return min(seconds)


def sort_and_interpolate(times: Array, keyframe_times: Array, centers: Array) -> Array:
    order = np.argsort(times, kind="stable")
    places = np.empty((len(times), 3))
    for axis in range(3):
        places[order, axis] = np.interp(times[order], keyframe_times, centers[:, axis])
    return places


def main() -> None:
    num_ranges, num_keyframes = (
        int(sys.argv[k]) if len(sys.argv) > k else default for k, default in ((1, 1_000_000), (2, 1000))
    )
    path = loop_path(_KEYFRAME_INTERVAL_S * num_keyframes, num_turns=_KEYFRAME_INTERVAL_S * num_keyframes / 40)
    keyframe_times: Array = path.start_s + _KEYFRAME_INTERVAL_S * np.arange(num_keyframes, dtype=np.float64)
    names = tuple(f"{k:06d}.jpg" for k in range(num_keyframes))
    centers, turns = path.centers(keyframe_times), path.world_from_cam(keyframe_times)
    trajectory = Trajectory(np.arange(num_keyframes), names, keyframe_times, centers, turns)
    rng = np.random.default_rng(1)
    in_order = np.sort(rng.uniform(keyframe_times[0], keyframe_times[-1], num_ranges))
    print(f"{num_ranges} ranges, {num_keyframes} keyframes, best of {_NUM_REPETITIONS}")
    print(f"{'ranges':14}  {'sort, interp s':>14}  {'associate s':>11}  {'ratio':>6}  {'off m':>7}")
    for name, times in (("in order", in_order), ("in no order", rng.permutation(in_order))):
        log = RangeLog.from_arrays(
            [f"A{k % 8}" for k in range(num_ranges)], np.full(num_ranges, 5.0), timestamp_s=times
        )
        least = best_of(lambda: sort_and_interpolate(times, keyframe_times, centers))  # noqa: B023
        taken = best_of(lambda: associate(log, trajectory, _TAG_IN_CAM_M))  # noqa: B023
        found = associate(log, trajectory, _TAG_IN_CAM_M)
        off = float(np.max(np.linalg.norm(found.centers - path.centers(times), axis=1)))
        print(f"{name:14}  {least:14.3f}  {taken:11.3f}  {taken / least:6.1f}  {off:7.3f}")


if __name__ == "__main__":
    main()

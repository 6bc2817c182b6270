"""Measure how long exact consensus over the scale takes for a million ranges, beside sorting as many numbers.

python -m tests.benchmarks.consensus [NUM_RANGES]
"""

from __future__ import annotations

import sys
import time

import numpy as np

from rangesfm.scale.range_equation import RangeProblem
from rangesfm.scale.starts import consensus_scales

_NUM_REPETITIONS = 5
_SCALE = 2.0


def range_problem(num: int) -> RangeProblem:
    """Ranges to four anchors with noise of 0.1 m, three in ten of them too long."""
    rng = np.random.default_rng(0)
    centers = rng.normal(size=(num, 3)) * [2.0, 2.0, 0.4]
    levers = 0.1 * rng.normal(size=(num, 3))
    anchors = np.array([[6.0, 0.0, 2.0], [-6.0, 1.0, 0.4], [1.0, 6.0, 3.0], [0.0, -6.0, 0.2]])
    index = rng.integers(0, 4, num)
    ranges = np.linalg.norm(_SCALE * centers + levers - anchors[index], axis=1) + 0.1 * rng.normal(size=num)
    ranges += (rng.random(num) < 0.3) * rng.exponential(2.0, num)
    return RangeProblem(
        centers=centers,
        tag_from_center=levers,
        anchor_index=index,
        range_m=np.maximum(ranges, 0.05),
        stddev_m=np.full(num, 0.1),
        anchor_mean_m=anchors,
        anchor_stddev_m=np.zeros(4),
        bias_mean_m=np.zeros(4),
        bias_stddev_m=np.zeros(4),
        common_bias_stddev_m=0.0,
        frame_is_free=False,
    )


def main() -> None:
    num = int(sys.argv[1]) if len(sys.argv) > 1 else 1_000_000
    problem, numbers = range_problem(num), np.random.default_rng(1).random(num)
    consensus, sorting = [], []
    for _ in range(_NUM_REPETITIONS):
        start = time.process_time()
        scale = consensus_scales(problem)[0]
        middle = time.process_time()
        np.sort(numbers)
        consensus.append(middle - start)
        sorting.append(time.process_time() - middle)
    print(f"{num} ranges: {scale:.4f} m per unit ({_SCALE} is true); processor seconds, best of {_NUM_REPETITIONS}")
    print(f"consensus {min(consensus):.3f}, np.sort {min(sorting):.3f}, ratio {min(consensus) / min(sorting):.1f}")


if __name__ == "__main__":
    main()

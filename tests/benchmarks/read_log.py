"""Measure how long a log of a million lines takes to read, beside numpy and pandas.

python -m tests.benchmarks.read_log [NUM_LINES]
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Callable
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from rangesfm.ranging.readers import read_ranges

_NUM_REPETITIONS = 5


def write_log(path: Path, num: int) -> None:
    """Write a log of eight anchors at 1 kHz, with times since 1970 in microseconds and ranges in millimetres."""
    random = np.random.default_rng(1)
    times = (1.7e9 + np.arange(num) * 1e-3 + random.uniform(0, 1e-3, num)).tolist()
    ranges = random.uniform(1, 50, num).tolist()
    anchors = random.integers(0, 8, num).tolist()
    with path.open("w") as file:
        file.write("timestamp_s,anchor_id,range_m\n")
        file.writelines(f"{t:.6f},{anchor},{range_m:.3f}\n" for t, anchor, range_m in zip(times, anchors, ranges))


def best_of(read: Callable[[], object]) -> float:
    seconds = []
    for _ in range(_NUM_REPETITIONS):
        start = time.perf_counter()
        read()
        seconds.append(time.perf_counter() - start)
    return min(seconds)


def contenders(path: Path) -> dict[str, Callable[[], object]]:
    """Readers of the same file, by name; pandas only where it is installed."""
    readers: dict[str, Callable[[], object]] = {
        "rangesfm.read_ranges": lambda: read_ranges(path),
        "numpy.loadtxt, all numbers": lambda: np.loadtxt(path, delimiter=",", skiprows=1),
        "numpy.loadtxt, text ids": lambda: np.loadtxt(path, delimiter=",", skiprows=1, dtype="f8,U16,f8"),
    }
    if find_spec("pandas") is not None:
        pandas = import_module("pandas")
        readers["pandas.read_csv, text ids"] = lambda: pandas.read_csv(path, dtype={"anchor_id": str})
    return readers


def main() -> None:
    num = int(sys.argv[1]) if len(sys.argv) > 1 else 1_000_000
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "log.csv"
        write_log(path, num)
        print(f"{num} lines, best of {_NUM_REPETITIONS}")
        print(f"{'reader':28}  {'s':>6}")
        for name, read in contenders(path).items():
            print(f"{name:28}  {best_of(read):6.3f}")


if __name__ == "__main__":
    main()

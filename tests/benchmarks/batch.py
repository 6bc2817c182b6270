"""Compare how long many demo surveys take on several workers and one after another.

python -m tests.benchmarks.batch [--num_surveys 16] [--num_photos 40] [--small] [--num_workers 2] [--kill]

Makes the surveys, runs each with ``rangesfm run`` one after another (all cores), then all of them with ``rangesfm
batch`` from scratch. Prints the seconds of both (wall clock and processor time), their ratio, the number of cores, and
the machine's load before each. With ``--kill`` one worker is killed while it works, and the rows of the table are
counted.
"""

from __future__ import annotations

import argparse
import csv
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import psutil
from tests.simulated.small_demo import make_small_demo

from rangesfm.demo.survey import TIME_OFFSET_S, make_demo_survey

_FLAGS = ("--ranges_time_offset", str(TIME_OFFSET_S))  # short surveys do not determine it


def make_surveys(folder: Path, arguments: argparse.Namespace) -> list[Path]:
    make = make_small_demo if arguments.small else make_demo_survey
    return [
        make(folder / f"yard{seed:02d}", num_photos=arguments.num_photos, seed=seed).folder
        for seed in range(arguments.num_surveys)
    ]


def seconds_of(folder: Path, *arguments: str, kill_after_s: float | None = None) -> float:
    """Return the wall-clock time of a command, and kill one of its workers meanwhile if asked."""
    begin = time.monotonic()
    process = subprocess.Popen(
        [sys.executable, "-m", "rangesfm", *arguments], cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    if kill_after_s is not None:
        threading.Timer(kill_after_s, kill_a_worker, [process.pid]).start()
    _, errors = process.communicate()
    if process.returncode:
        raise SystemExit(f"exit status {process.returncode} of {arguments}\n{errors.decode()}")
    return time.monotonic() - begin


def kill_a_worker(pid: int) -> None:
    """Kill a worker that has a survey: a child of the command with a child of its own."""
    workers = [child for child in psutil.Process(pid).children() if child.children()]
    print(f"killing worker {workers[0].pid}", flush=True)
    workers[0].kill()


def processor_seconds() -> float:
    """Return the processor time of all child processes that have ended."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def say(what: str, seconds: float, processor_s: float, load: float) -> None:
    print(f"{what:20} {seconds:8.1f} s, processors {processor_s:8.1f} s, load before {load:.1f}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--num_surveys", type=int, default=16)
    parser.add_argument("--num_photos", type=int, default=40)
    parser.add_argument("--small", action="store_true", help="photos of 360 x 240 pixels")
    parser.add_argument("--num_workers", type=int, default=2)
    parser.add_argument("--kill", action="store_true")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        surveys = make_surveys(folder, arguments)
        load, used_s = os.getloadavg()[0], processor_seconds()
        one_by_one = sum(seconds_of(survey, "run", "survey.toml", *_FLAGS) for survey in surveys)
        say("one after another", one_by_one, processor_seconds() - used_s, load)
        for survey in surveys:
            shutil.rmtree(survey / "out")
        load, used_s = os.getloadavg()[0], processor_seconds()
        files = [f"{survey.name}/survey.toml" for survey in surveys]
        kill_after_s = 0.25 * one_by_one if arguments.kill else None
        num_workers = str(arguments.num_workers)
        together = seconds_of(folder, "batch", *files, *_FLAGS, "--num_workers", num_workers, kill_after_s=kill_after_s)
        say(f"on {num_workers} workers", together, processor_seconds() - used_s, load)
        with (folder / "batch" / "batch.csv").open(newline="") as file:
            rows = list(csv.DictReader(file))
        print(f"ratio {together / one_by_one:.2f} on {os.cpu_count()} cores")
        print(f"{len(rows)} rows, {sum(row['status'] == 'done' for row in rows)} done, attempts", end=" ")
        print(*(row["num_attempts"] for row in rows))


if __name__ == "__main__":
    main()

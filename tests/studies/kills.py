"""Send SIGKILL at random moments of the pipeline, and run into the same folder after each.

    python -m tests.studies.kills [--num_kills 50] [--seed 0] [--survey FOLDER]

A small survey of the demo's yard. Every second run that is killed starts in an empty folder, the others in one that
holds a result with a slightly different camera. The moment is drawn evenly over the time that an undisturbed run takes
there. A killed run must leave no result, the old one or the new one, each with all its models and tables. The run after
it must end as an undisturbed one does (scale and camera centres to 1e-9) and leave nothing half-written.

Prints a line for each kill: the moment, the step that was killed, and what it left. Exit status 1 if anything differs.
"""

from __future__ import annotations

import argparse
import csv
import json
import math
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from tests.outputs import paths_below
from tests.simulated.small_demo import make_small_demo

from rangesfm.colmap.model_files import read_model
from rangesfm.demo.survey import TIME_OFFSET_S
from rangesfm.util.geometry.trajectory import trajectory_from_reconstruction

TOLERANCE = 1e-9
# All steps depend on the camera; the demo's has a focal length of 280.8 pixels.
OTHER_CAMERA = ("--camera_model", "SIMPLE_RADIAL", "--camera_params", "281,180,120,-0.04")
MODELS = ("sparse", "sparse_scaled", "sparse_metric")
# Tables print 6 digits, and the last may round either way.
TABLE_TOLERANCE = 1e-5


@dataclass(frozen=True)
class Undisturbed:
    """Complete results, and how long their runs took.

    Attributes:
        old, new: folders of results with two cameras.
        seconds: duration of a run for the new result: in an empty folder (False), or in that of the old one (True).
    """

    old: Path
    new: Path
    seconds: dict[bool, float]


def start(survey: Path, output: Path, *flags: str) -> subprocess.Popen[str]:
    """Start a run that gives the same map each time."""
    flags = ("--ranges_time_offset", str(TIME_OFFSET_S), "--reproducible", *flags)
    command = [sys.executable, "-m", "rangesfm", "run", "survey.toml", *flags, "--output_path", str(output)]
    return subprocess.Popen(command, cwd=survey, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def run(survey: Path, output: Path, *flags: str) -> float:
    """Run to the end, and return the seconds that it took."""
    begin = time.monotonic()
    process = start(survey, output, *flags)
    _, errors = process.communicate()
    if process.returncode:
        raise SystemExit(f"exit status {process.returncode} in {output}\n{errors}")
    return time.monotonic() - begin


def undisturbed(survey: Path, folder: Path) -> Undisturbed:
    old, new, onto_old = (folder / name for name in ("old", "new", "onto_old"))
    run(survey, old, *OTHER_CAMERA)
    shutil.copytree(old, onto_old)
    seconds = {False: run(survey, new), True: run(survey, onto_old)}
    if differences(new, old) == []:
        raise SystemExit("the two cameras give one result: nothing could be told apart")
    if differ := differences(new, onto_old):
        raise SystemExit(f"undisturbed runs differ: {differ}")
    return Undisturbed(old, new, seconds)


def differences(whole: Path, other: Path) -> list[str]:
    """List what differs between a result and the complete one."""
    found = []
    scales = [json.loads((path / "result.json").read_text())["scale"]["value"] for path in (whole, other)]
    if not math.isclose(*scales, rel_tol=TOLERANCE):
        found.append(f"scale {scales[1]!r} instead of {scales[0]!r}")
    for name in MODELS:
        if not (other / name / "0").is_dir():
            found.append(f"{name} is missing")
            continue
        first, second = (trajectory_from_reconstruction(read_model(path / name / "0")) for path in (whole, other))
        same_names = first.image_names == second.image_names
        if not same_names or not np.allclose(first.centers, second.centers, rtol=TOLERANCE, atol=TOLERANCE):
            found.append(name)
    for name in sorted(path.name for path in whole.glob("*.csv")):
        if not (other / name).is_file() or not _same_table(whole / name, other / name):
            found.append(name)
    return found


def names_in(folder: Path) -> set[str]:
    """Return the names of all files and folders below a folder."""
    return {path.relative_to(folder).as_posix() for path in paths_below(folder)}


def _same_table(first: Path, second: Path) -> bool:
    rows = [list(csv.reader(path.read_text().splitlines())) for path in (first, second)]
    if [len(row) for row in rows[0]] != [len(row) for row in rows[1]]:
        return False
    return all(_same_cell(*cells) for pair in zip(*rows, strict=True) for cells in zip(*pair, strict=True))


def _same_cell(first: str, second: str) -> bool:
    try:
        return first == second or math.isclose(
            float(first), float(second), rel_tol=TABLE_TOLERANCE, abs_tol=TABLE_TOLERANCE
        )
    except ValueError:
        return False


def killed(process: subprocess.Popen[str], after_s: float) -> str | None:
    """Kill a process after some seconds; return the step it was in, or None if it had already ended."""
    try:
        process.wait(timeout=after_s)
    except subprocess.TimeoutExpired:
        process.kill()
    _, errors = process.communicate()
    if process.returncode == 0:
        return None
    steps = [line.removesuffix(" ...").split()[-1] for line in errors.splitlines() if line.endswith(" ...")]
    return steps[-1] if steps else "start"


def left_by_killed(output: Path, whole: Undisturbed) -> str:
    """Return a word for what is there now; a mixture of both results is described by its differences."""
    if not (output / "result.json").exists():
        return "none"
    from_old, from_new = differences(whole.old, output), differences(whole.new, output)
    if from_old and from_new:
        return f"MIXED (from the old: {from_old}, from the new: {from_new})"
    return "new" if from_old else "old"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--num_kills", type=int, default=50, metavar="N")
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="of the moments (default: 0)")
    parser.add_argument("--survey", type=Path, metavar="FOLDER", help="of a demo survey (default: makes one)")
    arguments = parser.parse_args()
    rng = np.random.default_rng(arguments.seed)
    left, num_wrong = Counter[str](), 0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        survey = arguments.survey
        if survey is None:
            survey = make_small_demo(folder / "yard").folder
        whole = undisturbed(survey.resolve(), folder)
        while left.total() < arguments.num_kills:
            onto_old, output = left.total() % 2 == 1, folder / "out"
            shutil.rmtree(output, ignore_errors=True)
            if onto_old:
                shutil.copytree(whole.old, output)
            after_s = rng.uniform(0.0, whole.seconds[onto_old])
            step = killed(start(survey, output), after_s)
            if step is None:
                continue  # too late: try another moment
            what = left_by_killed(output, whole)
            run(survey, output)
            wrong = differences(whole.new, output) + sorted(names_in(output) - names_in(whole.new))
            num_wrong += bool(wrong) or what.startswith("MIXED")
            left[what.partition(" ")[0]] += 1
            print(
                f"{left.total():3} {after_s:6.2f} s  {step:12} left: {what:6} then: {wrong or 'the same'}", flush=True
            )
    print(f"{left.total()} kills, left {dict(left)}, {num_wrong} wrong")
    return 1 if num_wrong else 0


if __name__ == "__main__":
    sys.exit(main())

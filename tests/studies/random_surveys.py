"""Draw whole small surveys at random over everything that a user may have, and run a command on each.

    python -m tests.studies.random_surveys [--num 100] [--first_seed 0] [--seed N] [--workers 1] [--pairs] [--out FILE]

``tests.studies.drawn_surveys`` says what is drawn. ``--seed N`` repeats one survey, prints what its command prints, and
with ``--keep FOLDER`` leaves its files there. With ``--out`` each outcome is a line of a file, and seeds that are there
already are not run again.

With ``--pairs`` each honest survey that gives a scale is run again without one kind of measurement, or with its anchors
unknown. What is added should not widen the interval by more than a tenth, unless the verdict says why.

Each command must end with an exit status of the contract, without an internal error or a word of a library, and must
write finite numbers. An honest survey must not be refused as bad input. Of the honest ones, the true scale must be in
the 95 % interval in at least 93 %, and outside of it with the verdict "good" in at most 2 %; likewise the true place of
the map in the site. Prints how the commands ended, these shares, and the seeds of each kind of failure. Exit status 1
if any of this is not so.
"""

from __future__ import annotations

import argparse
import io
import json
import os
import shutil
import sys
import tempfile
import time
import warnings
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pycolmap
from tests.studies.drawn_surveys import DrawnSurvey, draw
from tests.studies.hostile import OWN_WORDS, STATUSES
from tests.studies.kept_runs import KeptRuns

from rangesfm.cli import main as rangesfm
from rangesfm.util.geometry.similarity import align_points
from rangesfm.util.geometry.trajectory import trajectory_from_reconstruction

Array = npt.NDArray[np.float64]
Line = dict[str, Any]

# Flags of each kind of measurement.
FLAGS = {
    "anchors": ("--anchors", "--anchor_frame"),
    "positions": ("--positions", "--antenna_in_cam"),
    "points": ("--points",),
    "distances": ("--distances",),
}
WIDENED = 1.1
LEAST_COVERED, MOST_GOOD_AND_OUTSIDE = 0.93, 0.02
# Of the largest of three coordinates in stddevs, with 95 % probability.
THREE_95 = 2.388


def told(seed: int, keep: Path | None = None, *, echo: bool = False, pairs: bool = False) -> Line:
    """Draw a survey, run its command, and return how that ended."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "survey"
        folder.mkdir()
        try:
            survey = draw(seed, folder)
            start = time.perf_counter()
            status, output, errors = run(survey)
            seconds = time.perf_counter() - start
            line = {"seed": seed, "words": ", ".join(survey.words), "mistake": survey.mistake, "status": status}
            line |= {"seconds": seconds, "said": errors.strip().splitlines()[-1:] if status else []}
            line |= judged(survey, status, errors)
            if pairs and survey.is_honest and "off" in line:
                line["without"] = dict(halves_without(survey))
        finally:
            if keep is not None:
                shutil.copytree(folder, keep, dirs_exist_ok=True)
    if echo:
        print(line["words"], " ".join(["rangesfm", *survey.command]), output, errors, sep="\n")
    return line


def halves_without(survey: DrawnSurvey) -> Iterator[tuple[str, float]]:
    """Run the survey again without each kind of measurement; yield it with half the width of the interval then."""
    command = survey.command
    given = {kind: flags for kind, flags in FLAGS.items() if flags[0] in command}
    for kind, flags in given.items():
        kept = [k for k in range(len(command)) if not command[k].startswith(flags) and command[k - 1] not in flags]
        less = [command[k] for k in kept]
        if not {"--points", "--distances"} & {*less} and "--markers" in less:
            at = less.index("--markers")
            less = less[:at] + less[at + 2 :]
        less += ["--anchor_frame", "unknown"] if kind == "anchors" else []
        found = judged(survey, *run(replace(survey, command=less))[::2])
        if "half" in found:
            yield kind, found["half"]


def run(survey: DrawnSurvey) -> tuple[int, str, str]:
    """Run the survey's command in its folder; return its exit status, its output, and its error output.

    It runs in this process, which saves the imports. Every warning is shown, and what libraries in C write is caught.
    """
    before = Path.cwd()
    with warnings.catch_warnings(), redirect_stdout(io.StringIO()) as out, redirect_stderr(io.StringIO()) as err:
        for category in (UserWarning, RuntimeWarning, SyntaxWarning):  # those that users see, also for the second time
            warnings.simplefilter("always", category)
        os.chdir(survey.folder)
        try:
            with file_as_stderr(survey.folder / "stderr.txt"):
                status = rangesfm(survey.command)
        finally:
            os.chdir(before)
    of_libraries = (survey.folder / "stderr.txt").read_text(encoding="utf-8", errors="replace")
    return status, out.getvalue(), err.getvalue() + of_libraries


@contextmanager
def file_as_stderr(path: Path) -> Iterator[None]:
    """Let what libraries write on standard error lead to a file."""
    kept = os.dup(2)
    with path.open("w", encoding="utf-8") as file:
        os.dup2(file.fileno(), 2)
        try:
            yield
        finally:
            os.dup2(kept, 2)
            os.close(kept)


def judged(survey: DrawnSurvey, status: int, errors: str) -> Line:
    """Return what is wrong with how a command ended, and the errors of its result."""
    wrong = [f"status {status}"] if status not in STATUSES else []
    wrong += [f"says {words!r}" for words in OWN_WORDS if words in errors]
    if status != 0:
        return {"wrong": wrong}
    text = (survey.folder / "out" / "result.json").read_text(encoding="utf-8")
    result = json.loads(text)
    wrong += [f"numbers: {word} in result.json" for word in ("NaN", "Infinity") if word in text]
    scale, place = result["scale"], result["place"]
    path = trajectory_from_reconstruction(final_map(survey.folder / "out"), None)
    row = {name: k for k, name in enumerate(survey.names)}
    order = [row[name] for name in path.image_names]
    if not np.isfinite(path.centers).all() or scale["interval_95"] is None:
        return {"wrong": [*wrong, "numbers: no finite map or no interval"]}
    # The truth of the map that was handed over, bends included.
    true_scale = align_points(survey.sfm_centers, survey.centers_m).scale
    low, high = scale["interval_95"]
    off = float(np.log(scale["value"] / true_scale))
    line: Line = {
        "wrong": wrong,
        "off": off,
        "half": float(np.log(high / low) / 2),
        "covered": bool(low <= true_scale <= high),
        "good": scale["verdict"] == "good",
        "reasons": scale["reasons"],
    }
    if place is None or result["frame"] != "site":
        return line
    off_m = path.centers - survey.centers_m[order]
    in_stddevs = float(np.max(np.abs(np.mean(off_m, axis=0)) / np.maximum(place["stddev_m"], 1e-4)))
    return {
        **line,
        "place_off_m": float(np.linalg.norm(np.mean(off_m, axis=0))),
        "rmse_m": float(np.sqrt(np.mean(np.sum(off_m**2, axis=1)))),
        "in_stddevs": in_stddevs,
        "placed": in_stddevs < THREE_95,
        "worst_in_stddevs": float(np.max(np.linalg.norm(off_m, axis=1)) / place["worst_keyframe_stddev_m"]),
        "place_good": place["verdict"] == "good",
    }


def final_map(folder: Path) -> pycolmap.Reconstruction:
    refined = folder / "sparse_metric" / "0"
    return pycolmap.Reconstruction(refined if refined.exists() else folder / "sparse_scaled" / "0")


def widened(line: Line) -> list[str]:
    """Return the kinds of measurement that widen the interval without a word about it."""
    is_said = any("less certain" in reason for reason in line.get("reasons", ()))
    return [
        kind
        for kind, half in line.get("without", {}).items()
        if line["half"] > WIDENED * half and not (is_said and kind == "anchors")
    ]


def failures(line: Line) -> list[str]:
    """Return the kinds of failure of a survey."""
    found = [*line["wrong"]]
    if line["mistake"] != "none":
        return found
    if line["status"] == 2:
        return [*found, "honest input refused"]
    for what, covered, good in (("scale", "covered", "good"), ("place", "placed", "place_good")):
        if not line.get(covered, True):
            found.append(f"{what} outside, {'good' if line[good] else 'doubtful'}")
    return [*found, *(f"wider with {kind}" for kind in widened(line))]


def share(lines: Sequence[Line], key: str) -> float:
    return float(np.mean([line[key] for line in lines])) if lines else float("nan")


def report(lines: Sequence[Line]) -> tuple[list[str], bool]:
    """Return the summary as lines, and whether all is as it must be."""
    ended = Counter(("honest" if line["mistake"] == "none" else "mistaken", line["status"]) for line in lines)
    texts = [
        f"{len(lines)} surveys: " + ", ".join(f"{n} {who} with status {s}" for (who, s), n in sorted(ended.items()))
    ]
    is_well = not any(line["wrong"] or (line["mistake"] == "none" and line["status"] == 2) for line in lines)
    honest = [line for line in lines if line["mistake"] == "none" and "off" in line]
    for what, covered, good, off in (
        ("scale", "covered", "good", "off"),
        ("place", "placed", "place_good", "place_off_m"),
    ):
        judged_lines = [line for line in honest if covered in line]
        if not judged_lines:
            continue
        num_false = sum(not line[covered] and line[good] for line in judged_lines)
        texts.append(
            f"{what}: {len(judged_lines)} honest, covered {100 * share(judged_lines, covered):.1f} %, good "
            f"{100 * share(judged_lines, good):.0f} %, good and outside {num_false}, median error "
            f"{float(np.median([abs(line[off]) for line in judged_lines])):.4f}"
        )
        is_well &= share(judged_lines, covered) >= LEAST_COVERED
        is_well &= num_false <= MOST_GOOD_AND_OUTSIDE * len(judged_lines)
    if honest:
        texts.append(
            f"half width of the interval, median: {100 * float(np.median([line['half'] for line in honest])):.2f} %"
        )
    by_kind: dict[str, list[int]] = {}
    for line in lines:
        for kind in failures(line):
            by_kind.setdefault(kind, []).append(line["seed"])
    texts += [f"{kind}: {len(seeds)}: {' '.join(map(str, sorted(seeds)))}" for kind, seeds in sorted(by_kind.items())]
    seconds = [line["seconds"] for line in lines]
    texts.append(f"seconds: median {float(np.median(seconds)):.1f}, sum {sum(seconds):.0f}")
    return texts, is_well


def outcomes(seeds: Sequence[int], num_workers: int, *, pairs: bool) -> Iterator[Line]:
    """Yield the outcomes of surveys as they come."""
    if num_workers == 1:
        yield from map(partial(told, pairs=pairs), seeds)
        return
    with ProcessPoolExecutor(num_workers, get_context("spawn")) as pool:
        for future in as_completed([pool.submit(told, seed, pairs=pairs) for seed in seeds]):
            yield future.result()


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--num", type=int, default=100)
    parser.add_argument("--first_seed", type=int, default=0)
    parser.add_argument("--seed", type=int, help="of one survey, which alone is run")
    parser.add_argument("--keep", type=Path, help="folder for the files of the survey of --seed")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--pairs", action="store_true", help="run each also without one kind of measurement")
    parser.add_argument("--out", type=Path, help="lines of surveys, which are not run again")
    asked = parser.parse_args(arguments)
    if asked.seed is not None:
        line = told(asked.seed, asked.keep, echo=True, pairs=asked.pairs)
        print(json.dumps(line), *failures(line), sep="\n")
        return int(bool(failures(line)))
    kept = KeptRuns(asked.out, "seed")
    seeds = [seed for seed in range(asked.first_seed, asked.first_seed + asked.num) if not kept.has(seed=seed)]
    for line in outcomes(seeds, asked.workers, pairs=asked.pairs):
        kept.run(line.copy, seed=line["seed"])
        if found := failures(line):
            print(f"{line['seed']}: {'; '.join(found)}: {line['words']}", flush=True)
    texts, is_well = report(sorted(kept.rows, key=lambda line: int(line["seed"])))
    print(*texts, sep="\n")
    return int(not is_well)


if __name__ == "__main__":
    sys.exit(main())

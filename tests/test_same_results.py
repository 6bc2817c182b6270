"""Golden results of small surveys of all kinds: a change of any number fails, whether intended or not.

If the change is intended, write the results anew, and read the difference before you commit it:

    WRITE_RESULTS=1 pytest tests/test_same_results.py
"""

from __future__ import annotations

import csv
import json
import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import pycolmap
import pytest
from tests.conftest import ANCHORS_M, TAG_IN_CAM_M, Command, WalkedSurvey

from rangesfm.geometry.reference import Reference, write_reference
from rangesfm.geometry.trajectory import trajectory_from_reconstruction
from rangesfm.vision.image_times import read_image_times_csv

Array = npt.NDArray[np.float64]
Log = dict[str, Any]
Numbers = dict[str, Any]

FILE = Path(__file__).parent / "same_results.json"
# The relative tolerance, and the absolute one near zero. Processors and versions of solvers differ by less, mistakes by
# more.
TOLERANCE, NOTHING = 1e-4, 1e-6
# Only the likeliest tests are compared, because the order of the others depends on small differences.
NUM_TESTS = 6
# Keys that depend on the machine, or on the arguments of the command.
LEFT_OUT = ("seconds", "settings", "inputs", "versions", "message", "words", "final_cost", "bend_m")


class Case(NamedTuple):
    """A command on a survey after a change of its files."""

    command: str
    flags: Sequence[str]
    change: Callable[[Log], None]


def erring(log: Log) -> None:
    """Add errors like those of real radios: lasting for seconds, depending on distance, different for each anchor."""
    rng, times, ranges = np.random.default_rng(4), log["timestamp_s"], log["range_m"]
    for k, name in enumerate(ANCHORS_M):
        rows = log["anchor_id"] == name
        lasting = np.interp(times[rows], np.arange(99.0, 144.0, 3.0), 0.05 * rng.normal(size=15))
        ranges[rows] += lasting + 0.03 * (k - 1) + 0.08 * np.sin(ranges[rows]) * (k == 2)


def obstructed(log: Log) -> None:
    erring(log)
    rng = np.random.default_rng(6)
    wrong = rng.random(len(log["range_m"])) < 0.3
    log["range_m"][wrong] += rng.exponential(1.0, int(wrong.sum()))


def stepping(log: Log) -> None:
    erring(log)
    log["range_m"][(log["anchor_id"] == "A2") & (log["timestamp_s"] > 121)] += 0.9


def stretched(log: Log) -> None:
    erring(log)
    log["range_m"][log["anchor_id"] == "A4"] *= 1.15


def drifting(log: Log) -> None:
    erring(log)
    log["timestamp_s"] += 2e-3 * (log["timestamp_s"] - 120)


def slipping(log: Log) -> None:
    erring(log)
    log["timestamp_s"][log["timestamp_s"] > 124] += 0.8


def by_photo(log: Log) -> None:
    erring(log)
    numbers = np.clip(np.round(log.pop("timestamp_s") + 2.0 - 100), 0, 39).astype(int)
    log["image_name"] = np.array([f"frame_{number + 1:05d}.jpg" for number in numbers])


SITE, UNKNOWN = ("--anchors", "anchors.csv"), ("--anchor_frame", "unknown")
IN_CAMERA = ("--anchors", "anchors_first_camera.csv", "--anchor_frame", "first_camera")
CASES = {
    "surveyed": Case("refine", (*SITE, "--reference", "reference.csv"), erring),
    "surveyed, obstructed": Case("refine", SITE, obstructed),
    "surveyed, loosely": Case(
        "refine", (*SITE, "--lever_arm_stddev_m", "0.02", "--time_offset_stddev_s", "0.01"), erring
    ),
    "surveyed, a plane": Case("scale", ("--anchors", "flat.csv", "--camera_side", "above"), erring),
    "first camera": Case("refine", IN_CAMERA, erring),
    "first camera, offset": Case("scale", (*IN_CAMERA, "--ranges_time_offset", "auto"), drifting),
    "unknown": Case("refine", UNKNOWN, erring),
    "unknown, one": Case("scale", (*UNKNOWN, "--use_anchors", "A1"), obstructed),
    "unknown, offset": Case("scale", (*UNKNOWN, "--ranges_time_offset", "auto"), erring),
    "unknown and taped": Case("refine", (*UNKNOWN, "--distances", "taped.csv"), erring),
    "some unknown": Case("scale", ("--anchors", "some.csv"), erring),
    "by photo": Case("refine", SITE, by_photo),
    "a step": Case("scale", SITE, stepping),
    "a stretch": Case("scale", SITE, stretched),
    "a slipped clock": Case("scale", SITE, slipping),
    "an anchor typed wrong": Case("refine", ("--anchors", "typed.csv"), erring),
    "two candidates": Case("scale", (*IN_CAMERA, "--scale_method", "two-candidate"), erring),
}


def read_log(path: Path) -> Log:
    rows = list(csv.DictReader(path.read_text().splitlines()))
    log: Log = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    return {name: log[name].astype(float) if name.endswith(("_s", "_m")) else log[name] for name in log}


def write_log(path: Path, log: Log) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        csv.writer(file).writerows([list(log), *zip(*(values.tolist() for values in log.values()), strict=True)])


def write_anchors(path: Path, **changed: tuple[float, float, float] | None) -> None:
    """Write the anchors with some positions changed (None: unknown)."""
    places = {name: at or ("", "", "") for name, at in (ANCHORS_M | changed).items()}
    rows = [f"{name},{x},{y},{z},0.02\n" for name, (x, y, z) in places.items()]
    path.write_text("anchor_id,x_m,y_m,z_m,position_stddev_m\n" + "".join(rows))


@pytest.fixture
def survey(own_survey: WalkedSurvey) -> WalkedSurvey:
    folder = own_survey.folder
    write_anchors(folder / "some.csv", A4=None)
    write_anchors(folder / "typed.csv", A3=(6.0, 5.6, 0.7))
    write_anchors(folder / "flat.csv", **{name: (x, y, 0.5) for name, (x, y, _) in ANCHORS_M.items()})
    (folder / "taped.csv").write_text("from,to,distance_m,stddev_m\nA1,A2,12.17,0.02\n")
    return own_survey


def found_by(case: Case, survey: WalkedSurvey, command: Command) -> Numbers:
    log = read_log(survey.folder / "uwb.csv")
    case.change(log)
    write_log(survey.folder / "uwb.csv", log)
    flags = [*survey.flags, *case.flags, "--no_report", "--quiet", "--output_path", "out"]
    command(case.command, *flags, cwd=survey.folder)
    result = json.loads((survey.folder / "out" / "result.json").read_text())
    tests = sorted(result.pop("tests") or [], key=lambda test: -test["statistic"])[:NUM_TESTS]
    result["tests"] = {f"{test['name']} {test['subject']}": test for test in tests}
    return dict(leaves(result))


def leaves(value: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the numbers and words with their paths."""
    if isinstance(value, dict):
        for key, inner in value.items():
            if key not in LEFT_OUT:
                yield from leaves(inner, f"{path}.{key}" if path else key)
    elif isinstance(value, list):
        for number, inner in enumerate(value):
            yield from leaves(inner, f"{path}[{number}]")
    else:
        yield path, value


def is_same(found: Any, before: Any, nothing: float) -> bool:
    if isinstance(before, float) and isinstance(found, float | int):
        return bool(found == pytest.approx(before, rel=TOLERANCE, abs=nothing))
    return bool(found == before)


def compare(name: str, found: Numbers, nothing: float = NOTHING) -> None:
    known = json.loads(FILE.read_text()) if FILE.exists() else {}
    if os.environ.get("WRITE_RESULTS"):
        known[name] = {path: float(f"{x:.7g}") if isinstance(x, float) else x for path, x in found.items()}
        FILE.write_text(json.dumps({key: known[key] for key in sorted(known)}, indent=0) + "\n")
        return
    assert found.keys() == known[name].keys()
    pairs = {path: (found[path], before) for path, before in known[name].items()}
    assert not {path: pair for path, pair in pairs.items() if not is_same(*pair, nothing)}


@pytest.mark.parametrize("name", CASES)
def test_a_survey_gives_what_it_gave(name: str, survey: WalkedSurvey, rangesfm_command: Command) -> None:
    compare(name, found_by(CASES[name], survey, rangesfm_command))


def write_known(survey: WalkedSurvey) -> tuple[str, ...]:
    """Write the true path of the camera, and return the flags that use it."""
    times = read_image_times_csv(survey.folder / "images.csv").by_name()
    placed = survey.site_from_sfm
    path = trajectory_from_reconstruction(pycolmap.Reconstruction(survey.folder / "sparse" / "0"), times)
    path = path.transformed(placed.scale, placed.rotation, placed.translation)
    known = Reference(path.centers, timestamps_s=path.timestamps_s, world_from_cam=path.world_from_cam)
    write_reference(known, survey.folder / "known.csv")
    tag = ",".join(map(str, TAG_IN_CAM_M))
    return ("--positions", "known.csv", "--tag_in_cam", tag, "--time_offset", "2", "--max_interpolation_gap_s", "1.5")


@pytest.mark.parametrize(
    ("command", "flags", "last_digit"),
    [
        ("trilaterate", ("--side", "A1=below,A2=above,A3=below,A4=above"), 1e-4),
        ("ranges calibrate", SITE, 1e-5),
    ],
)
def test_a_table_says_what_it_said(
    command: str, flags: tuple[str, ...], last_digit: float, survey: WalkedSurvey, rangesfm_command: Command
) -> None:
    """The last digit may differ, because it may be rounded either way."""
    log = read_log(survey.folder / "uwb.csv")
    obstructed(log)
    write_log(survey.folder / "uwb.csv", log)
    known = write_known(survey)
    rangesfm_command(*command.split(), "uwb.csv", *flags, *known, "--output_path", "found.csv", cwd=survey.folder)
    rows = list(csv.DictReader((survey.folder / "found.csv").read_text().splitlines()))
    numbers = {f"{number}.{key}": text for number, row in enumerate(rows) for key, text in row.items()}
    compare(command, {path: number_in(text) for path, text in numbers.items()}, 1.01 * last_digit)


def number_in(text: str) -> Any:
    try:
        return float(text)
    except ValueError:
        return text

"""Compare what small surveys of all kinds give with what they gave: the numbers that a user acts on, and the verdicts.

A number may differ by a tenth of its stddev, which no user would notice. If a larger change is intended, write the
numbers anew, and read the difference before you commit it:

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
from tests.conftest import ANCHORS_M, SITE_M, TAG_IN_CAM_M, Command, WalkedSurvey
from tests.pipeline.test_join_models import walk
from tests.pipeline.test_surveys_of_rigs import TAG_IN_CAM_M as RIG_TAG_IN_CAM_M
from tests.pipeline.test_surveys_of_rigs import stereo_survey
from tests.simulated.files import write_marks
from tests.simulated.looped import bent_laps, write_survey
from tests.simulated.surveys import TAG_IN_CAM_M as LAPS_TAG_IN_CAM_M

from rangesfm.sfm.image_times import read_image_times_csv
from rangesfm.util.geometry.moments import ByTime
from rangesfm.util.geometry.reference import Reference, write_reference
from rangesfm.util.geometry.trajectory import Trajectory, trajectory_from_reconstruction

Array = npt.NDArray[np.float64]
Log = dict[str, Any]
Number = Sequence[float]
Numbers = dict[str, Number]

FILE = Path(__file__).parent / "same_results.json"
# Of the stddev of a number: a change that no user would notice.
TOLERANCE = 0.1
# Of numbers that have no stddev of their own, such as reprojection errors.
SHARE_OF_OTHERS = 0.05


class Case(NamedTuple):
    """A command on a survey after a change of its files, its verdict, and words of its first reason."""

    command: str
    flags: Sequence[str]
    change: Callable[[Log], None]
    verdict: str = "good"
    reason: str = "the scale is known to"
    has_ranges: bool = True


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
POINTS = ("--points", "points.csv", "--markers", "markers.csv")
POSITIONS = ("--positions", "positions.csv", "--antenna_in_cam", "0.1,-0.3,0.05")
IN_CAMERA = ("--anchors", "anchors_first_camera.csv", "--anchor_frame", "first_camera")
CASES = {
    "surveyed, obstructed": Case("refine", SITE, obstructed),
    "surveyed, loosely": Case(
        "refine",
        (*SITE, "--lever_arm_stddev_m", "0.02", "--time_offset_stddev_s", "0.01", "--reference", "reference.csv"),
        erring,
    ),
    "surveyed, a plane": Case("scale", ("--anchors", "flat.csv", "--camera_side", "above"), erring),
    "first camera, offset": Case("refine", (*IN_CAMERA, "--ranges_time_offset", "auto"), drifting),
    "unknown": Case("refine", UNKNOWN, erring),
    "unknown, one": Case(
        "scale",
        (*UNKNOWN, "--use_anchors", "A1"),
        obstructed,
        "doubtful",
        "the ranges cannot show every mistake that matters",
    ),
    "unknown, offset": Case("scale", (*UNKNOWN, "--ranges_time_offset", "auto"), erring),
    "unknown and taped": Case("refine", (*UNKNOWN, "--distances", "taped.csv"), erring),
    "some unknown": Case("scale", ("--anchors", "some.csv"), erring),
    "by photo": Case("refine", SITE, by_photo),
    "a step": Case(
        "scale",
        SITE,
        stepping,
        "doubtful",
        "either the ranges to anchor A2 jumped ",
    ),
    "a slipped clock": Case("scale", SITE, slipping, "doubtful", "probably the clocks' offset jumped "),
    "an anchor typed wrong": Case(
        "refine", ("--anchors", "typed.csv"), erring, "doubtful", "probably anchor A3's y is given as 5008.600"
    ),
    "control points": Case("refine", POINTS, erring, has_ranges=False),
    "positions": Case("refine", POSITIONS, erring, has_ranges=False),
    "a tape alone": Case(
        "refine",
        ("--distances", "between_marks.csv", "--markers", "markers.csv"),
        erring,
        "doubtful",
        "the scale depends on one length that nothing checks",
        has_ranges=False,
    ),
    "everything": Case("refine", (*SITE, *POINTS, *POSITIONS, "--distances", "taped.csv"), erring),
    "two anchors and gravity": Case(
        "scale", ("--anchors", "anchors.csv", "--use_anchors", "A1,A2", "--up_in_first_camera", "{up}"), erring
    ),
}


PLAN = """
[anchors]
frame = "site"
position_stddev_m = 0.02
places = {A1 = [0.0, 0.0, 2.5], A2 = [12.0, 0.0, 0.5], A3 = [12.0, 8.0, 2.5], A4 = [0.0, 8.0, 0.5]}
[path]
waypoints = [[2, 2, 1.2], [10, 2, 1.6], [10, 6, 1.2], [2, 6, 1.8], [2, 2, 1.2]]
speed_m_per_s = 0.5
photo_rate_hz = 1.0
[radio]
rate_hz = 5.0
[tag]
tag_in_cam_m = [0.0, -0.1, 0.0]
"""


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


@pytest.fixture(scope="module")
def walked_survey(dense_survey: WalkedSurvey) -> WalkedSurvey:
    return dense_survey


@pytest.fixture
def survey(own_survey: WalkedSurvey) -> WalkedSurvey:
    folder = own_survey.folder
    write_anchors(folder / "some.csv", A4=None)
    x, y, z = ANCHORS_M["A3"]
    write_anchors(folder / "typed.csv", A3=(x, y + 0.6, z))
    write_anchors(folder / "flat.csv", **{name: (x, y, SITE_M[2] + 0.5) for name, (x, y, _) in ANCHORS_M.items()})
    (folder / "taped.csv").write_text("from,to,distance_m,stddev_m\nA1,A2,12.17,0.02\n")
    mark_points(own_survey)
    write_positions(own_survey)
    return own_survey


def mark_points(survey: WalkedSurvey) -> None:
    """Write marks of points of the map in their photos, their surveyed coordinates, and a length between two."""
    model, rng = pycolmap.Reconstruction(survey.folder / "sparse" / "0"), np.random.default_rng(7)
    seen = [i for i in sorted(model.point3D_ids()) if model.point3D(i).track.length() >= 6][::40][:6]
    points, places = "marker,x_m,y_m,z_m,stddev_m\n", {}
    for number, point_id in enumerate(seen):
        place = survey.site_from_sfm.apply(model.point3D(point_id).xyz[None])[0]
        places[f"M{number}"] = place
        x, y, z = (place + 0.01 * rng.standard_normal(3)).tolist()
        points += f"M{number},{x:.4f},{y:.4f},{z:.4f},0.01\n"
    write_marks(survey.folder / "markers.csv", model, {f"M{k}": point_id for k, point_id in enumerate(seen)})
    length_m = float(np.linalg.norm(places["M0"] - places["M1"]))
    (survey.folder / "points.csv").write_text(points)
    lengths = f"from,to,distance_m,stddev_m\nM0,M1,{length_m + 0.004:.4f},0.005\n"
    (survey.folder / "between_marks.csv").write_text(lengths)


def site_path(survey: WalkedSurvey) -> Trajectory:
    """Return the path of the camera in the site."""
    times = read_image_times_csv(survey.folder / "images.csv").by_name()
    path = trajectory_from_reconstruction(pycolmap.Reconstruction(survey.folder / "sparse" / "0"), times)
    placed = survey.site_from_sfm
    return path.transformed(placed)


def write_positions(survey: WalkedSurvey) -> None:
    """Write noisy positions of an antenna at the moments of the photos, by another clock."""
    path, rng = site_path(survey), np.random.default_rng(8)
    antennas = path.centers + path.world_from_cam @ [0.1, -0.3, 0.05] + 0.03 * rng.standard_normal((len(path), 3))
    write_reference(Reference(antennas, ByTime(path.times_s + 12.25)), survey.folder / "positions.csv")


def found_by(case: Case, survey: WalkedSurvey, command: Command) -> Numbers:
    log = read_log(survey.folder / "uwb.csv")
    case.change(log)
    write_log(survey.folder / "uwb.csv", log)
    given = survey.flags if case.has_ranges else ("--input_path", "sparse/0", "--images", "images.csv")
    up = ",".join(map(str, site_path(survey).world_from_cam[0, 2].tolist()))
    flags = (*given, *(flag.format(up=up) for flag in case.flags))
    words = {"verdict": case.verdict, "reason": case.reason}
    return result_of(case.command, *flags, cwd=survey.folder, run=command, **words)


def result_of(
    *arguments: str, cwd: Path, run: Command, verdict: str = "good", reason: str = "the scale is known to"
) -> Numbers:
    """Return the numbers of a command's result, after a look at its verdict and its first reason."""
    run(*arguments, "--no_report", "--quiet", "--output_path", "out", cwd=cwd)
    result = json.loads((cwd / "out" / "result.json").read_text())
    assert result["scale"]["verdict"] == verdict
    assert reason in result["scale"]["reasons"][0]
    return dict(numbers_of(result))


def numbers_of(result: dict[str, Any]) -> Iterator[tuple[str, Number]]:
    """Yield what a user acts on, each number with its stddev."""
    scale, place, offset = result["scale"], result["place"], result["time_offset"]
    yield "scale", (scale["value"], scale["stddev_empirical"])
    for end, value in zip(("low", "high"), scale["interval_95"], strict=True):
        yield f"scale, {end}", (value, scale["stddev_empirical"])
    relative = scale["stddev_empirical"] / scale["value"]
    at_m = np.array(result["metric_from_sfm"]["translation_m"])
    stddevs_m = [max(relative * float(np.linalg.norm(at_m)), 0.01)] * 3 if place is None else place["stddev_m"]
    for axis, value_m, stddev_m in zip("xyz", at_m.tolist(), stddevs_m, strict=True):
        yield f"map, {axis}", (value_m, stddev_m)
    if offset["estimated"]:
        yield "time offset", (offset["value_s"], offset["stddev_s"])
    estimated = {name: anchor for name, anchor in result["anchors"].items() if anchor["stddev_m"] > 0}
    for name, anchor in list(estimated.items())[:1]:
        for axis, value_m in zip("xyz", anchor["position_m"], strict=True):
            yield f"anchor {name}, {axis}", (value_m, anchor["stddev_m"])
    for kind, own in scale["by_kind"].items():
        yield f"scale by {kind}", (own["value"], own["stddev"])
    for model in result["models"]:
        placed, stddev = model["metric_from_sfm"], model["scale"]["stddev_empirical"]
        yield f"{model['name']}, scale", (placed["scale"], stddev * placed["scale"] / model["scale"]["value"])
        for axis, value_m in zip("xyz", placed["translation_m"], strict=True):
            yield (
                f"{model['name']}, {axis}",
                (value_m, max(stddev * float(np.linalg.norm(placed["translation_m"])), 0.01)),
            )
    if result["refine"] is not None:
        yield "reprojection", without_stddev(result["refine"]["reprojection_rms_px"], least=0.1)
    if result["loops"] is not None:
        yield "loops move", without_stddev(result["loops"]["moved_m"])
        yield "loops closed", without_stddev(result["loops"]["num_closed"])


def without_stddev(value: float, least: float = 0.0) -> Number:
    """Return a number that has no stddev of its own, with one that lets it change by ``SHARE_OF_OTHERS``.

    Args:
        least: smaller numbers may change as much as this one.
    """
    return value, SHARE_OF_OTHERS * max(value, least) / TOLERANCE


def compare(name: str, found: Numbers) -> None:
    known = json.loads(FILE.read_text()) if FILE.exists() else {}
    if os.environ.get("WRITE_RESULTS"):
        known[name] = {key: [round(x, 5) for x in number] for key, number in found.items()}
        lines = [f"{json.dumps(key)}: {json.dumps(known[key])}" for key in sorted(known)]
        FILE.write_text("{\n" + ",\n".join(lines) + "\n}\n")
        return
    before = known[name]
    assert found.keys() == before.keys()
    apart = {key: (found[key], before[key]) for key in before if is_apart(found[key], before[key])}
    assert not apart


def is_apart(found: Number, before: Number) -> bool:
    """Return whether a number or its stddev has changed by more than a tenth of the stddev it had."""
    (value, stddev), (old_value, old_stddev) = found, before
    return abs(value - old_value) > TOLERANCE * old_stddev or abs(stddev - old_stddev) > TOLERANCE * old_stddev


@pytest.mark.parametrize("name", CASES)
def test_a_survey_gives_what_it_gave(name: str, survey: WalkedSurvey, rangesfm_command: Command) -> None:
    compare(name, found_by(CASES[name], survey, rangesfm_command))


def write_known(survey: WalkedSurvey) -> tuple[str, ...]:
    """Write the true path of the camera, and return the flags that use it."""
    path = site_path(survey)
    known = Reference(path.centers, ByTime(path.times_s), path.world_from_cam)
    write_reference(known, survey.folder / "known.csv")
    tag = ",".join(map(str, TAG_IN_CAM_M))
    return ("--positions", "known.csv", "--tag_in_cam", tag, "--time_offset", "2", "--max_interpolation_gap_s", "1.5")


@pytest.mark.parametrize(
    ("command", "flags", "columns"),
    [
        (
            "trilaterate",
            ("--side", "A1=below,A2=above,A3=below,A4=above"),
            dict.fromkeys(("x_m", "y_m", "z_m"), "position_stddev_m"),
        ),
        ("ranges calibrate", SITE, {"error_m": "stddev_m"}),
    ],
)
def test_a_table_says_what_it_said(
    command: str, flags: tuple[str, ...], columns: dict[str, str], survey: WalkedSurvey, rangesfm_command: Command
) -> None:
    log = read_log(survey.folder / "uwb.csv")
    obstructed(log)
    write_log(survey.folder / "uwb.csv", log)
    known = write_known(survey)
    rangesfm_command(*command.split(), "uwb.csv", *flags, *known, "--output_path", "found.csv", cwd=survey.folder)
    rows = csv.DictReader((survey.folder / "found.csv").read_text().splitlines())
    compare(
        command,
        {
            f"{number}, {column}": (float(row[column]), float(row[stddev]))
            for number, row in enumerate(rows)
            for column, stddev in columns.items()
        },
    )


def test_closed_loops_give_what_they_gave(tmp_path: Path, rangesfm_command: Command) -> None:
    write_survey(bent_laps(), tmp_path)
    tag = ",".join(map(str, LAPS_TAG_IN_CAM_M))
    model = ("--input_path", "sparse", "--images", "images.csv", "--database_path", "database.db")
    radio = ("--ranges", "uwb.csv", "--tag_in_cam", tag, "--ranges_time_offset", "0")
    anchor = ("--anchors", "anchors.csv", "--anchor_frame", "first_camera")
    compare("loops", result_of("refine", *model, *radio, *anchor, cwd=tmp_path, run=rangesfm_command))


def test_a_rig_and_a_radio_give_what_they_gave(tmp_path: Path, rangesfm_command: Command) -> None:
    stereo_survey(tmp_path)
    tag = ",".join(map(str, RIG_TAG_IN_CAM_M))
    rig = ("--input_path", "sparse", "--rig_config_path", "rig_config.json", "--baseline_stddev_m", "0.003")
    radio = ("--ranges", "ranges.csv", "--tag_in_cam", tag, *SITE)
    compare("a rig and a radio", result_of("refine", *rig, *radio, cwd=tmp_path, run=rangesfm_command))


def test_joined_models_give_what_they_gave(tmp_path: Path, rangesfm_command: Command) -> None:
    halves = walk()
    halves.write(tmp_path)
    rng, log = np.random.default_rng(9), read_log(tmp_path / "uwb.csv")
    log["range_m"] += 0.05 * rng.standard_normal(len(log["range_m"]))
    write_log(tmp_path / "uwb.csv", log)
    tag = ",".join(map(str, TAG_IN_CAM_M))
    radio = ("--ranges", "uwb.csv", "--tag_in_cam", tag, "--ranges_time_offset", "0", *UNKNOWN)
    for part, day in zip(halves.parts, ("monday", "tuesday"), strict=True):
        (tmp_path / day).mkdir()
        part.sfm.write(tmp_path / day)
        flags = ("--input_path", day, "--images", "images.csv", *radio, "--output_path", f"{day}/out", "--no_report")
        rangesfm_command("scale", *flags, "--quiet", cwd=tmp_path)
    words = {"verdict": "doubtful", "reason": "beside the others, its size is known, +- 4.2 % (95 %)"}
    compare("joined", result_of("join", "monday/out", "tuesday/out", cwd=tmp_path, run=rangesfm_command, **words))


def test_a_plan_says_what_it_said(tmp_path: Path, rangesfm_command: Command) -> None:
    """Numbers of a plan are stddevs: each may change by a tenth of itself."""
    (tmp_path / "plan.toml").write_text(PLAN)
    rangesfm_command("plan", "plan.toml", "--output_path", "plan", "--quiet", cwd=tmp_path)
    plan = json.loads((tmp_path / "plan" / "plan.json").read_text())
    assert plan["verdict"] == plan["place"]["verdict"] == "good"
    found = {"scale": plan["scale_stddev"], "scale, formal": plan["scale_stddev_formal"]}
    found |= {f"scale by {name}": own for name, own in plan["by_kind"].items()}
    found |= {f"map, {axis}": own for axis, own in zip("xyz", plan["place"]["stddev_m"], strict=True)}
    found |= {name: plan["place"][f"{name}_stddev_deg"] for name in ("heading", "tilt")}
    found["worst keyframe"] = max(plan["keyframe_stddevs_m"])
    largest = max(plan["mistakes"], key=lambda mistake: mistake["effect_on_scale"] or 0.0)
    found[f"{largest['name']} {largest['subject']}".strip()] = largest["smallest_detectable"]
    found |= {advice["kind"]: advice["scale_stddev"] for advice in plan["advice_for_scale"][:2]}
    compare("plan", {name: (value, value) for name, value in found.items()})

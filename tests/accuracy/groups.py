"""Groups of surveys in the table of accuracy: what each runs, and the figures that it gives."""

from __future__ import annotations

import csv
import io
import json
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from tests.accuracy.figures import Figure, Values
from tests.benchmarks import reconstruction
from tests.simulated.surveys import SITES, simulated, surveyed
from tests.studies import drifting_maps, growth, known_positions, mistakes, random_surveys, real_logs
from tests.studies.kept_runs import KeptRuns
from tests.studies.measured_distances import KINDS

from rangesfm.demo.survey import PHOTOS
from rangesfm.options import CameraOptions
from rangesfm.sfm.image_times import list_images

EXAMPLES = Path(__file__).parents[2] / "examples"
FIRST_RANDOM = 30000

Cases = dict[str, Values]


@dataclass(frozen=True)
class Task:
    """Some cases of a group that are run together.

    Attributes:
        group, name: of the group and of these cases.
        run: returns values by case.
        seconds: how long it takes, roughly.
    """

    group: str
    name: str
    run: Callable[[], Cases]
    seconds: float


def cases_of(task: Task) -> Cases:
    """Run a task without what its study prints."""
    with redirect_stdout(io.StringIO()):
        return task.run()


@dataclass(frozen=True)
class Group:
    """Surveys of one kind.

    Attributes:
        words: description for people.
        tasks: lists what is to be run, given the folder of data, if any, and whether a part is enough.
        title: of a table with the values of each case; None: there is none.
    """

    name: str
    words: str
    figures: tuple[Figure, ...]
    tasks: Callable[[Path | None, bool], list[Task]]
    title: str | None = None


def scale_figures() -> tuple[Figure, ...]:
    """Figures that all groups have which state an interval of the scale."""
    return (
        Figure("scale covered", "covered", "mean", "%", "lower"),
        Figure("error", "error", "rms", "%", "higher"),
        Figure("in stated stddevs", "in_stddevs", "rms", "", "higher"),
        Figure("half width", "half_width", "median", "%", "higher"),
        Figure("mistake named", "named", "mean", "%", "higher"),
        Figure("refused", "refused", "mean", "%", "higher"),
    )


def of_interval(error: float, low: float, high: float, num_named: int) -> Values:
    """Return the values of ``scale_figures`` from the error and the interval about the estimate, as logarithms."""
    half_width = (high - low) / 2
    return {
        "covered": float(low <= -error <= high),
        "error": error,
        "in_stddevs": 1.96 * (error + (low + high) / 2) / half_width,
        "half_width": half_width,
        "named": float(num_named > 0),
        "refused": 0.0,
    }


REFUSED: Values = {"refused": 1.0}


def one_log(data: Path, name: str, with_single_anchors: bool) -> Cases:
    real, found = real_logs.RealLog.read(data, name), Cases()
    for case in real.cases():
        if with_single_anchors or not case.name.startswith("only"):
            row = real_logs.one_survey(name, case, real.placed(case, real.path), real.path)
            if row is None:
                found[f"{name}, {case.name}"] = REFUSED
                continue
            of_path = {} if row.away_m is None else {"rmse": row.away_m}
            found[f"{name}, {case.name}"] = {**of_interval(row.error, row.low, row.high, row.num_named), **of_path}
    return found


def log_tasks(data: Path | None, quick: bool) -> list[Task]:
    return [
        Task("real logs", name, partial(one_log, data, name, not quick), 40.0)
        for name, described in real_logs.SETS.items()
        if data is not None and (data / described["ranges"]).is_file()
    ]


def one_drifting_map(kind: str, seed: int, data: Path | None) -> Cases:
    line = drifting_maps.told(kind, seed, data)
    if line["refused"]:
        return {f"{kind} {seed}": REFUSED}
    is_nearer = line["refined_m"] is not None and line["refined_m"] < line["scaled_m"]
    low, high = -line["half_width"], line["half_width"]
    values = of_interval(line["log_error"], low, high, len(line["causes"]))
    values = {**values, "covered": float(line["covered"]), "in_stddevs": line["log_error"] / line["stddev"]}
    of_map = {
        "rmse": line["final_m"],
        "kept": float(line["kept"]) if is_nearer else None,
        "places": line["places_covered"],
    }
    return {f"{kind} {seed}": {**values, **of_map}}


def lap_tasks(_: Path | None, quick: bool) -> list[Task]:
    kinds = ("lap", "lap_unknown", "lap_site", "lap_radio", "hall", "poses")
    return [
        Task("drifting maps", f"{kind} {seed}", partial(one_drifting_map, kind, seed, None), 20.0)
        for k, kind in enumerate(kinds)
        for seed in range(k, k + (2 if quick else 5))
    ]


def desk_tasks(data: Path | None, quick: bool) -> list[Task]:
    if data is None or not (data / "slam_keyframes").is_dir():
        return []
    seeds = range(2 if quick else 6)
    return [
        Task("real keyframes", f"desk {seed}", partial(one_drifting_map, "desk", seed, data), 5.0) for seed in seeds
    ]


def one_known_survey(known: str, kind: str, seed: int) -> Cases:
    truth, survey = simulated(replace(KINDS[kind], anchor_frame="site"), seed)
    of_survey = known_positions.Known.of(known.split("+"), truth, survey, KINDS[kind].path(seed), seed)
    line = known_positions.told(of_survey, "none", KINDS[kind].pixel_stddev, seed)
    name = f"{known}, {kind} {seed}"
    if line["refused"]:
        return {name: REFUSED}
    off, in_stddevs, _ = line["scale"]
    return {
        name: {
            "covered": float(line["covered"]),
            "error": off,
            "in_stddevs": in_stddevs,
            "half_width": line["half"],
            "named": float(bool(line["named"])),
            "refused": 0.0,
            "rmse": line["rmse_m"],
            "places": line["placed"],
        }
    }


def known_tasks(_: Path | None, quick: bool) -> list[Task]:
    return [
        Task("known positions", f"{known}, {kind} {seed}", partial(one_known_survey, known, kind, seed), 8.0)
        for known, num in (("points", 6), ("positions", 6), ("positions+ranges+anchors", 3))
        for kind in known_positions.KINDS_OF_SURVEY
        for seed in range(1 if quick else num)
    ]


def mistakes_of_survey(site_number: int, seed: int, num: int) -> Cases:
    """Run a clean survey, and some kinds of mistakes drawn for this seed."""
    site = SITES[site_number]
    all_kinds = mistakes.kinds(list(site.anchors_m) if site.anchor_frame != "unknown" else [])
    drawn = np.random.default_rng([seed, site_number]).choice(len(all_kinds), num, replace=False)
    kept = KeptRuns(None, *mistakes.RUN_NAMES)
    mistakes.run_seed(kept, site.name, [(int(k), all_kinds[k]) for k in drawn], partial(surveyed, site), seed)
    return {f"{site.name}, {line['kind']} {seed}": of_mistake(line) for line in kept.rows}


def of_mistake(line: dict[str, Any]) -> Values:
    is_clean = line["kind"] == mistakes.CLEAN
    if line["refused"]:
        return {"refused": 1.0} if is_clean else {}
    is_good = not line["doubts"]
    good_and_wrong = float(is_good and (line["wrong"] or line["place"] > 3))
    if is_clean:
        return {
            "clean_named": float(line["found"]),
            "clean_doubted": float(not is_good),
            "good_and_wrong": good_and_wrong,
        }
    large = line["factor"] in (None, 2.0, 5.0)
    return {
        "found": float(line["found"]) if large else None,
        "first": float(line["is_first"]) if large else None,
        "good_and_wrong": good_and_wrong,
    }


def mistake_tasks(_: Path | None, quick: bool) -> list[Task]:
    return [
        Task("mistakes", f"{SITES[k].name} {seed}", partial(mistakes_of_survey, k, seed, 3), 15.0)
        for seed in range(2 if quick else 7)
        for k in range(len(SITES))
    ]


MISTAKE_FIGURES = (
    Figure("found", "found", "mean", "%", "lower"),
    Figure("named first", "first", "mean", "%", "lower"),
    Figure("good with a wrong scale or place", "good_and_wrong", "mean", "%", "higher"),
    Figure("named without one", "clean_named", "mean", "%", "higher"),
    Figure("doubtful without one", "clean_doubted", "mean", "%", "higher"),
)


def run_command(output_path: Path, *words: str) -> dict[str, Any] | None:
    """Run a command of the package that writes a result; return ``result.json``, or None if it is refused."""
    command = [sys.executable, "-m", "rangesfm", *words, "--no_report", "--quiet", "--output_path", str(output_path)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode not in (0, 3):
        raise RuntimeError(f"{' '.join(words)}: {done.stderr}")
    if done.returncode == 3:
        return None
    result: dict[str, Any] = json.loads((output_path / "result.json").read_text(encoding="utf-8"))
    return result


def of_result(result: dict[str, Any] | None) -> Values:
    """Return the values of a result that was compared with a reference."""
    if result is None:
        return REFUSED
    row, scale = result["comparison"][-1], result["scale"]
    error = float(np.log1p(row["scale_error_percent"] / 100))
    low, high = (float(np.log(end / scale["value"])) for end in scale["interval_95"])
    named = [test for test in result["tests"] or () if test["rejected"]]
    of_map = {name: row[f"{name}_m"] for name in ("rmse", "rmse_se3", "rmse_sim3")}
    return {**of_interval(error, low, high, len(named)), **of_map}


def room(data: Path, seed: int, with_single_anchors: bool) -> Cases:
    """Map the room from its photos, with all anchors surveyed, and refine that map by what else may be measured.

    That is ranges to unknown anchors, an inertial sensor alone, and the sensor beside the ranges to surveyed ones.
    """
    folder = data / "room_env1"
    with tempfile.TemporaryDirectory() as scratch:
        mapped, refined = Path(scratch) / "mapped", Path(scratch) / "refined"
        survey = [str(EXAMPLES / "handheld_room.toml"), "--base_path", str(folder), "--seed", str(seed)]
        result = run_command(mapped, "run", *survey)
        assert result is not None
        seconds = result["seconds"]
        before = sum(seconds.get(stage, 0.0) for stage in ("features", "matching", "mapping"))
        after = sum(seconds.values()) - before
        found: Cases = {f"surveyed {seed}": {**of_result(result), "after_mapping": after / before}}
        photos = ["--images", str(folder / "images.csv"), "--reference", str(folder / "groundtruth.csv")]
        of_map = ["refine", "--input_path", str(mapped / "sparse" / "0"), *photos]
        ranges = ["--ranges", str(folder / "uwb.csv"), "--ranges_time_offset", "0"]
        refine = [*of_map, *ranges, "--tag_in_cam", "-0.0012,-0.09,-0.0663", "--anchor_frame"]
        found[f"unknown {seed}"] = of_result(run_command(refined, *refine, "unknown"))
        for at in (path for path in (folder, data / "public" / "inrol_env1") if (path / "imu.txt").is_file()):
            sensor = ["--imu", str(at / "imu.txt"), "--imu_in_cam", "-0.0013,-0.08,-0.0664"]
            found[f"inertial sensor alone {seed}"] = of_result(run_command(refined, *of_map, *sensor))
            anchors = ["site", "--anchors", str(folder / "anchors_antennas.csv")]
            found[f"surveyed, inertial sensor {seed}"] = of_result(run_command(refined, *refine, *anchors, *sensor))
        with (folder / "anchors_antennas.csv").open(encoding="utf-8") as file:
            ids = [row["anchor_id"] for row in csv.DictReader(file)] if with_single_anchors else []
        for name in ids:
            found[f"only {name}, {seed}"] = of_result(run_command(refined, *refine, "unknown", "--use_anchors", name))
    return found


def room_tasks(data: Path | None, quick: bool) -> list[Task]:
    if quick or data is None or not (data / "room_env1").is_dir():
        return []
    return [
        Task("room", f"seed {seed}", partial(room, data, seed, seed == 0), 350.0 if seed == 0 else 250.0)
        for seed in range(3)
    ]


def tag_map(data: Path, stage: str, anchors: str | None, offset: str) -> Cases:
    folder = data / "starloc_tags"
    words = [stage, "--input_path", str(folder / "sparse" / "0"), "--tag_in_cam", "T1:0.0402,0.1402,-0.1812"]
    for flag, name in (("ranges", "ranges.csv"), ("images", "images.csv"), ("reference", "truth.csv")):
        words += [f"--{flag}", str(folder / name)]
    words += ["--ranges_time_offset", offset]
    words += ["--anchor_frame", "unknown"] if anchors is None else ["--anchors", str(folder / "anchors.csv")]
    if anchors not in (None, "all"):
        words += ["--anchor_frame", "unknown", "--use_anchors", str(anchors)]
    with tempfile.TemporaryDirectory() as scratch:
        result = run_command(Path(scratch) / "out", *words)
    return {f"{stage}, anchors {anchors or 'unknown'}, offset {offset}": of_result(result)}


def tag_tasks(data: Path | None, quick: bool) -> list[Task]:
    if data is None or not (data / "starloc_tags").is_dir():
        return []
    with (data / "starloc_tags" / "anchors.csv").open(encoding="utf-8") as file:
        ids = [row["anchor_id"] for row in csv.DictReader(file)]
    return [
        Task("camera and tags", f"{stage} {anchors} {offset}", partial(tag_map, data, stage, anchors, offset), 6.0)
        for stage in ("scale", "refine")
        for anchors in (None, "all", *([] if quick else ids))
        for offset in (("-0.039",) if quick else ("-0.039", "auto"))
    ]


def grown(num: int) -> Cases:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        growth.simulate(folder, num, 20, 200, 0)
        seconds, _, _ = growth.refined(folder, with_profile=False)
        result = json.loads((folder / "out" / "result.json").read_text(encoding="utf-8"))
    return {f"{num} keyframes": {**of_result(result), "seconds_each": seconds / num}}


def growth_tasks(_: Path | None, quick: bool) -> list[Task]:
    return [
        Task("growth", f"{num} keyframes", partial(grown, num), 0.1 * num) for num in ((500,) if quick else (500, 2000))
    ]


def random_surveys_from(first: int, num: int) -> Cases:
    """Run honest random surveys; what is drawn with a mistake is left out."""
    found: Cases = {}
    for seed in range(first, first + num):
        line = random_surveys.told(seed)
        if line["mistake"] == "none":
            found[str(seed)] = {"refused": 1.0} if "half" not in line else of_random(line)
    return found


def of_random(line: dict[str, Any]) -> Values:
    return {
        "covered": float(line["covered"]),
        "error": line["off"],
        "in_stddevs": 1.96 * line["off"] / line["half"],
        "half_width": line["half"],
        "good_and_wrong": float(line["good"] and not line["covered"]),
        "refused": 0.0,
    }


def random_tasks(_: Path | None, quick: bool) -> list[Task]:
    starts = range(FIRST_RANDOM, FIRST_RANDOM + (20 if quick else 80), 10)
    return [Task("random surveys", f"from {first}", partial(random_surveys_from, first, 10), 15.0) for first in starts]


def beside_pycolmap() -> Cases:
    """Take the demo's photos to a model by pycolmap's calls and by rangesfm in turn; the first round warms up."""
    names, camera = list_images(PHOTOS), CameraOptions()
    ratios: list[list[float]] = []
    for number in range(3):
        clocks = []
        for program in (reconstruction.by_pycolmap, reconstruction.by_rangesfm):
            with tempfile.TemporaryDirectory() as folder:
                efforts = program(PHOTOS, names, Path(folder), camera, 2, number)
            clocks.append([effort.processor_s for effort in efforts])
        ratios.append([ours / theirs for theirs, ours in zip(*clocks, strict=True)])
    stages = (*reconstruction.STAGES, "all")
    return {"demo": {stage: median(ratio[k] for ratio in ratios) for k, stage in enumerate(stages)}}


def speed_tasks(_: Path | None, quick: bool) -> list[Task]:
    return [] if quick else [Task("speed", "demo", beside_pycolmap, 90.0)]


REFUSED_SHARE = Figure("refused", "refused", "mean", "%", "higher")
RMSE = Figure("RMSE", "rmse", "median", "m", "higher")
PLACES = Figure("place covered", "places", "mean", "%", "lower")

GROUPS: Sequence[Group] = (
    Group(
        "real logs",
        "Real logs with truth, each with its anchors surveyed, known, unknown, and one alone",
        (*scale_figures(), RMSE),
        log_tasks,
    ),
    Group(
        "room",
        "The hand-held room from its photos, with ranges, an inertial sensor, and both; one anchor alone",
        (
            *scale_figures(),
            RMSE,
            Figure("after SE(3)", "rmse_se3", "median", "m", "higher"),
            Figure("after Sim(3)", "rmse_sim3", "median", "m", "higher"),
            Figure("time after the mapping over that until then", "after_mapping", "median", "%", None),
        ),
        room_tasks,
        "The hand-held room",
    ),
    Group(
        "camera and tags",
        "Maps of printed tags with real ranges, scaled and refined",
        (*scale_figures(), RMSE),
        tag_tasks,
    ),
    Group(
        "drifting maps",
        "Surveys whose maps drift: laps, halls, paths without points",
        (*scale_figures(), RMSE, PLACES, Figure("better refinements kept", "kept", "mean", "%", "lower")),
        lap_tasks,
    ),
    Group("real keyframes", "Real monocular keyframes with simulated ranges", (*scale_figures(), RMSE), desk_tasks),
    Group(
        "known positions",
        "Control points, positions, and positions with ranges",
        (*scale_figures(), RMSE, PLACES),
        known_tasks,
    ),
    Group(
        "random surveys",
        "Surveys drawn at random over all kinds of input, run by commands",
        (
            *scale_figures()[:4],
            Figure("good with a wrong scale", "good_and_wrong", "mean", "%", "higher"),
            REFUSED_SHARE,
        ),
        random_tasks,
    ),
    Group("mistakes", "Surveys with a mistake, and without one", MISTAKE_FIGURES, mistake_tasks),
    Group(
        "growth",
        "500 and 2000 keyframes with loops, refined",
        (*scale_figures(), RMSE, Figure("time for a keyframe", "seconds_each", "mean", "s", None)),
        growth_tasks,
        "Growth",
    ),
    Group(
        "speed",
        "Photos to model, processor time over that of pycolmap's own calls",
        tuple(Figure(stage, stage, "median", "", None) for stage in ("features", "matching", "mapping", "all")),
        speed_tasks,
    ),
)

"""Dump what is computed of ten surveys on one state of the program, and compare the dumps of two states.

    python -m tests.studies.golden_dumps dump FOLDER [--surveys FOLDER] [--only NAME ...]
    python -m tests.studies.golden_dumps compare FOLDER OTHER [--tolerance 1e-6]

For changes that are meant to change no number, such as a move of code. The surveys are files, as users have them.
``dump`` makes ten, writes them to ``FOLDER/surveys`` and runs them; with ``--surveys`` it runs those of an earlier
dump, or any other folders that have a ``survey.toml`` each. So both states run the same files, even if the simulation
has changed between them. The ten are:

- ``hall``: ranges to six surveyed anchors, of which a quarter is obstructed, and a map that drifts;
- ``room_unknown``: ranges to six unknown anchors;
- ``yard_loose``: four surveyed anchors, a radio with a clock of its own, and a lever arm that is known to 0.1 m;
- ``lap``: one anchor in the first camera's frame, and a path that drifts by 5 m, straightened in the keyframe graph;
- ``poses``: four surveyed anchors, and a drifting path without points, which is scaled only;
- ``yard_all``: ranges, positions of an antenna, control points and taped lengths together;
- ``room_positions``, ``yard_points``, ``yard_lengths``: positions, control points and lengths alone;
- ``loops``: two laps with one anchor, whose loops are closed by the matches of the model's database.

A dump has of each survey ``result.json``, the tables, and the poses and points of the models, all in full precision;
and what a move of code should not change either: equations, noise and covariances. Only the functions from
``metric_of`` to ``covariances_of`` know where the program keeps these. After a move, point them at the new places.

``compare`` names each array that differs, with the largest difference relative to its largest number, and all words
that differ. Exit status 1 if an array differs by more than the tolerance, or words do.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import fields, replace
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import numpy.typing as npt
import pycolmap
from tests.simulated import looped
from tests.simulated.files import write_anchors, write_model, write_rows
from tests.simulated.surveys import TAG_IN_CAM_M, MadeSurvey, simulated
from tests.studies.drifting_maps import hall, lap_of_drift, poses
from tests.studies.known_positions import POINT_STDDEV_M, RECEIVERS, points_of, track_of
from tests.studies.measured_distances import KINDS

import rangesfm
from rangesfm.measurements.joint_map import find_kind
from rangesfm.measurements.lengths.length_scale import LengthScale
from rangesfm.measurements.positions.position_scale import PositionScale
from rangesfm.measurements.positions.words import POSITIONS
from rangesfm.measurements.ranges.mistakes.linearized import linearized
from rangesfm.measurements.ranges.readers import write_ranges_csv
from rangesfm.measurements.ranges.scale.range_scale import RangeScale
from rangesfm.pipeline import result_records
from rangesfm.pipeline.metric_result import MetricResult
from rangesfm.pipeline.run_results import write_results
from rangesfm.result.result_folder import ResultFolder

Values = dict[str, npt.NDArray[Any]]
Tables = dict[str, dict[str, Any]]

OF_THE_RUN = {"computed", "inputs", "seconds", "settings", "versions"}
"""Keys in ``result.json`` of what tells of the run, not of the map."""
SEED = 1
NUM_LENGTHS = 3


# The surveys, as files.


def write_hall(folder: Path) -> Tables:
    survey, rng = hall(0), np.random.default_rng(1)
    num = len(survey.range_m)
    survey.range_m = survey.range_m + (rng.random(num) < 0.25) * rng.exponential(1.0, num)
    return written(survey, folder)


def write_room_unknown(folder: Path) -> Tables:
    return written(simulated(KINDS["room, six unknown anchors"], 0)[1], folder)


def write_yard_loose(folder: Path) -> Tables:
    survey = simulated(KINDS["yard"], 3)[1]
    survey.time_s = survey.time_s + 7.3
    tables = written(survey, folder)
    tables["tag"]["tag_in_cam_m"] = (TAG_IN_CAM_M + np.array([0.06, -0.04, 0.05])).tolist()
    tables["ranges"]["time_offset"] = "auto"
    tables["refine"]["lever_arm_stddev_m"] = 0.1
    return tables


def write_lap(folder: Path) -> Tables:
    return written(lap_of_drift(5.0, 4, with_radio=True), folder)


def write_poses(folder: Path) -> Tables:
    return written(poses(2), folder)


def write_known(kind: str, names: Sequence[str], folder: Path) -> Tables:
    """Write a survey with "ranges", "positions", "points" or "lengths", whose errors are the same whatever else is."""
    truth, survey = simulated(replace(KINDS[kind], anchor_frame="site"), SEED)
    rng = np.random.default_rng([SEED, 41])
    points, track = points_of(truth, rng), track_of(survey, KINDS[kind].path(SEED), rng)
    has_ranges = "ranges" in names
    (written if has_ranges else write_map)(survey, folder)
    tables = tables_of_files("site" if has_ranges else None)
    if "positions" in names:
        rows = np.column_stack([track.log.moments.timestamp_s, track.log.position_m])
        stated_m = float(np.hypot(RECEIVERS["positions"].noise_m, RECEIVERS["positions"].lasting_m))
        header = "timestamp_s,x_m,y_m,z_m,stddev_m"
        write_rows(folder / "positions.csv", header, [(*row, stated_m) for row in rows.tolist()])
        tables["positions"] = {"path": "positions.csv", "antenna_in_cam_m": TAG_IN_CAM_M.tolist()}
    if "points" in names:
        given = [(each.name, *each.position_m.tolist(), POINT_STDDEV_M, each.kind) for each in points.points]
        write_rows(folder / "points.csv", "marker,x_m,y_m,z_m,stddev_m,kind", given)
        tables["points"] = {"path": "points.csv"}
    if "lengths" in names:
        ends = zip(points.points[:NUM_LENGTHS], reversed(points.points), strict=False)
        taped = [(a.name, b.name, float(np.linalg.norm(a.position_m - b.position_m))) for a, b in ends]
        write_rows(folder / "taped.csv", "from,to,distance_m,stddev_m", [(*row, 0.015) for row in taped])
        tables["scale"]["distances"] = "taped.csv"
    if {"points", "lengths"} & {*names}:
        seen = [
            (name, photo, *pixel)
            for name, marker in points.markers.items()
            for photo, pixel in zip(marker.image_names, marker.pixels.tolist(), strict=True)
        ]
        write_rows(folder / "markers.csv", "marker,image_name,x_px,y_px", seen)
        tables["scale"]["markers"] = "markers.csv"
    return tables


def write_loops(folder: Path) -> Tables:
    looped.write_survey(looped.bent_laps(), folder)
    tables = tables_of_files("first_camera")
    tables["mapper"]["database_path"] = "database.db"
    return tables


SURVEYS: dict[str, Callable[[Path], Tables]] = {
    "hall": write_hall,
    "room_unknown": write_room_unknown,
    "yard_loose": write_yard_loose,
    "lap": write_lap,
    "poses": write_poses,
    "yard_all": partial(write_known, "yard", ("ranges", "positions", "points", "lengths")),
    "room_positions": partial(write_known, "room", ("positions",)),
    "yard_points": partial(write_known, "yard", ("points",)),
    "yard_lengths": partial(write_known, "yard", ("lengths",)),
    "loops": write_loops,
}


def write_survey(name: str, folder: Path) -> None:
    """Make a survey, and write it into a new folder."""
    folder.mkdir(parents=True)
    lines = []
    for table, values in SURVEYS[name](folder).items():
        lines += [f"[{table}]", *(f"{key} = {json.dumps(value)}" for key, value in values.items()), ""]
    (folder / "survey.toml").write_text("\n".join(lines), encoding="utf-8")


def written(survey: MadeSurvey, folder: Path) -> Tables:
    """Write a survey with ranges, and return the tables of its survey file."""
    write_map(survey, folder)
    write_ranges_csv(survey.log, folder / "uwb.csv")
    write_anchors(folder / "anchors.csv", survey.anchors_m)
    tables = tables_of_files(survey.anchor_frame)
    tables["refine"]["enabled"] = survey.sfm is not None
    return tables


def write_map(survey: MadeSurvey, folder: Path) -> None:
    path = survey.trajectory
    timestamps_s = dict(zip(path.image_names, path.times_s.tolist(), strict=True))
    write_model(survey.model, folder / "sparse", timestamps_s, folder / "images.csv")


def tables_of_files(frame: str | None) -> Tables:
    """Return the tables of a survey file for ranges with anchors in a frame; None: there are no ranges."""
    tables: Tables = {
        "images": {"model": "sparse", "times": "images.csv"},
        "camera": {"refine_intrinsics": False},
        "mapper": {"num_threads": 1},
        "scale": {},
        "refine": {},
        "report": {"enabled": False},
        "export": {"formats": []},
        "output": {"seed": 0},
    }
    if frame is not None:
        tables["ranges"] = {"path": "uwb.csv", "time_offset": 0.0}
        tables["tag"] = {"tag_in_cam_m": TAG_IN_CAM_M.tolist()}
        tables["anchors"] = {"frame": frame} | ({} if frame == "unknown" else {"path": "anchors.csv"})
    return tables


# What the program has in memory. Each of these functions knows where it keeps one kind of thing.


def metric_of(survey_path: Path, output_path: Path) -> MetricResult:
    """Run a survey as ``rangesfm`` does, and return what is in memory when the results are written."""
    kept: list[MetricResult] = []

    def write(run: Any, metric: MetricResult) -> ResultFolder:
        kept.append(metric)
        return write_results(run, metric)

    survey = rangesfm.read_survey(survey_path).changed({"output.path": output_path})
    with patch("rangesfm.pipeline.run.write_results", write):
        rangesfm.run_survey(survey)
    return kept[0]


def tables_of(metric: MetricResult) -> Values:
    """Return the columns of the CSV files, which round most of them."""
    found: Values = {}
    for table in result_records.tables_of(metric):
        found |= {f"{table.NAME} {each.name}": np.array(getattr(table, each.name)) for each in fields(table)}
    return found


def range_equations_of(metric: MetricResult) -> Values:
    """Return residuals of ranges, their derivatives by the map as a whole and the anchors, and the same of priors."""
    on_map = metric.all_measured
    if (ranges := find_kind(on_map.kinds, RangeScale)) is None:
        return {}
    moved = ranges.moved(on_map.posterior) if on_map.is_at_rest else ranges
    problem = linearized(moved.on(on_map)).with_learnt_errors()
    return {
        "ranges residual": problem.residual_m,
        "ranges derivatives": problem.design,
        "ranges prior residual": problem.prior_residual,
        "ranges prior derivatives": problem.prior_design,
        "ranges covariance": problem.noise.covariance_m2,
    }


def position_equations_of(metric: MetricResult) -> Values:
    """Return residuals of positions and control points, their derivatives by the map as a whole, and their errors."""
    found, problem = find_kind(metric.kinds, PositionScale), metric.all_measured.problem
    if found is None or not found.is_used:
        return {}
    return {
        "positions residual": problem.residual_m[problem.rows[POSITIONS]],
        "positions derivatives": problem.design[problem.rows[POSITIONS]],
        "positions covariance": problem.noise_of(POSITIONS).covariance_m2,
        "positions weight": found.weights,
    }


def length_equations_of(metric: MetricResult) -> Values:
    """Return residuals of measured lengths, derivatives of the scale by them, and their errors."""
    found = find_kind(metric.kinds, LengthScale)
    if found is None:
        return {}
    return {
        "lengths residual": np.concatenate([each.sizes for each in found.errors]),
        "lengths derivatives": found.by_metre,
        "lengths stddev": np.concatenate([each.stddevs for each in found.errors]),
        "lengths redundancy": np.array([each.redundancy for each in found.errors]),
    }


def noise_of(metric: MetricResult) -> Values:
    """Return the standard deviation of each component of the noise, as learnt for the final map."""
    on_map = metric.all_measured
    learnt = {
        "ranges": metric.estimate.ranges.error_stddevs,
        "positions": on_map.problem.noise_of(POSITIONS).stddev_of_component if POSITIONS in on_map.observed else {},
    }
    return {f"{kind} noise {name}": np.array(of) for kind, found in learnt.items() for name, of in found.items()}


def covariances_of(metric: MetricResult) -> Values:
    """Return the components of the scale's standard deviation, and the covariances of the final map."""
    uncertainty = metric.estimate.uncertainty
    found: Values = {f"scale component {name}": np.array(size) for name, size in uncertainty.components.items()}
    found["scale half width"] = np.array(uncertainty.half_width_95)
    if metric.estimate.placement is not None:
        found["covariance placement"] = metric.estimate.placement
    if POSITIONS in metric.all_measured.observed:
        found["covariance by positions"] = metric.all_measured.posterior.place
    joint = metric.map_errors
    if joint.are_known:
        found |= {"covariance centers": joint.centers_m2(metric.trajectory.frame_ids)}
        found |= {f"covariance {kind}s": joint.covariances(kind) for kind in joint.parts}
    return found


# What every state has: the files of a result.


def values_of(survey_path: Path) -> Values:
    """Run a survey, and return all numbers and words of its result by name; those of a refusal are its error."""
    with tempfile.TemporaryDirectory() as folder:
        output_path = Path(folder) / "out"
        try:
            metric = metric_of(survey_path, output_path)
        except rangesfm.RangesfmError as error:
            return {"refused": np.array(str(error))}
        found = dict(written_values(output_path))
    for kept_in_memory in (
        *(tables_of, range_equations_of, position_equations_of, length_equations_of, noise_of, covariances_of),
    ):
        found |= kept_in_memory(metric)
    return found


def written_values(output_path: Path) -> Iterator[tuple[str, npt.NDArray[Any]]]:
    """Yield what ``result.json`` and the final model say."""
    result = json.loads((output_path / "result.json").read_text(encoding="utf-8"))
    yield from leaves("result", result)
    for stage in ("sparse_scaled", "sparse_metric"):
        if (path := output_path / stage / "0").is_dir():
            model = pycolmap.Reconstruction(path)
            frames = [model.frame(frame_id).rig_from_world for frame_id in sorted(model.reg_frame_ids())]
            yield f"{stage} rotations", np.array([pose.rotation.matrix() for pose in frames if pose is not None])
            yield f"{stage} translations", np.array([pose.translation for pose in frames if pose is not None])
            points = [model.point3D(point_id).xyz for point_id in sorted(model.point3D_ids())]
            yield f"{stage} points", np.array(points).reshape(-1, 3)


def leaves(name: str, value: Any) -> Iterator[tuple[str, npt.NDArray[Any]]]:
    """Yield numbers and words with their keys; equal keys of a list of entries are a column."""
    if isinstance(value, list) and value and isinstance(value[0], Mapping):
        keys = dict.fromkeys(key for entry in value for key in entry)
        value = {key: [entry.get(key) for entry in value] for key in keys}
    if isinstance(value, Mapping):
        for key in value.keys() - OF_THE_RUN:
            yield from leaves(f"{name}.{key}", value[key])
    elif any(isinstance(item, (str, list, dict)) for item in (value if isinstance(value, list) else [value])):
        yield name, numbers_or_words(value)
    else:
        yield name, np.array(value, dtype=np.float64)


def numbers_or_words(value: Any) -> npt.NDArray[Any]:
    """Return an array of numbers if there are only such, all equally many, else of words."""
    try:
        return np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        return np.array([item if isinstance(item, str) else json.dumps(item) for item in np.atleast_1d(value).tolist()])


def dump(folder: Path, surveys: Path | None, only: Sequence[str]) -> None:
    """Run surveys and write the values of each."""
    folder.mkdir(parents=True, exist_ok=True)
    if surveys is None:
        surveys = folder / "surveys"
        for name in only or SURVEYS:
            write_survey(name, surveys / name)
    for path in sorted(surveys.glob("*/survey.toml")):
        name = path.parent.name
        if not only or name in only:
            np.savez_compressed(folder / f"{name}.npz", **values_of(path))  # type: ignore[arg-type]
            print(name, flush=True)


def difference(one: npt.NDArray[Any] | None, other: npt.NDArray[Any] | None) -> float:
    """Return the largest difference relative to the largest number; infinite for another shape or other words."""
    if one is None or other is None or one.shape != other.shape:
        return np.inf
    if "U" in (one.dtype.kind, other.dtype.kind):
        return 0.0 if np.array_equal(one, other) else np.inf
    if not np.array_equal(np.isfinite(one), np.isfinite(other)):
        return np.inf
    known = np.isfinite(one)
    before, after = (values[known].astype(np.float64) for values in (one, other))
    return float(np.abs(before - after).max(initial=0.0) / np.abs(before).max(initial=1e-12))


def compare(folder: Path, other: Path, tolerance: float) -> bool:
    """Print how two dumps differ, and return whether they are the same."""
    is_same = True
    for name in sorted({path.stem for place in (folder, other) for path in place.glob("*.npz")}):
        if lines := [*differences(read(folder / f"{name}.npz"), read(other / f"{name}.npz"), tolerance)]:
            is_same = False
        print(f"{name}: {'differs' if lines else 'the same'}", *lines, sep="\n  ", flush=True)
    return is_same


def read(path: Path) -> Values:
    """Read the values of a survey; none if the dump does not have it."""
    if not path.exists():
        return {}
    with np.load(path) as values:
        return {**values}


def differences(before: Values, after: Values, tolerance: float) -> Iterator[str]:
    """Yield a line for each array that differs by more than the tolerance, the largest difference first."""
    apart = {key: difference(before.get(key), after.get(key)) for key in sorted({*before, *after})}
    for key, by in sorted(apart.items(), key=lambda item: -item[1]):
        if by > tolerance:
            one, other = before.get(key), after.get(key)
            yield f"{key}: {by:.1e}" if np.isfinite(by) else f"{key}: {in_short(one, other)} -> {in_short(other, one)}"


def in_short(values: npt.NDArray[Any] | None, others: npt.NDArray[Any] | None) -> str:
    """Return what to show of an array that cannot be compared: words that the other one lacks, or its shape."""
    if values is None:
        return "not there"
    if values.dtype.kind != "U":
        return f"{np.isfinite(values).sum()} finite numbers of shape {values.shape}"
    return str([word for word in np.ravel(values).tolist() if others is None or word not in others])


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    dumping = commands.add_parser("dump")
    dumping.add_argument("folder", type=Path)
    dumping.add_argument("--surveys", type=Path, help="folders with a survey.toml each; default: the ten, made anew")
    dumping.add_argument("--only", nargs="+", default=[], metavar="NAME")
    comparing = commands.add_parser("compare")
    comparing.add_argument("folder", type=Path)
    comparing.add_argument("other", type=Path)
    comparing.add_argument("--tolerance", type=float, default=1e-6)
    args = parser.parse_args()
    if args.command == "dump":
        dump(args.folder, args.surveys, args.only)
        return 0
    return int(not compare(args.folder, args.other, args.tolerance))


if __name__ == "__main__":
    sys.exit(main())

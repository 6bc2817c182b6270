"""Dump what is computed of ten surveys on one state of the program, and compare the dumps of two states.

    python -m tests.studies.golden_dumps dump FOLDER [--surveys NAME ...]
    python -m tests.studies.golden_dumps compare FOLDER OTHER [--tolerance 1e-6]

For changes that are meant to change no number, such as a move of code. Each survey becomes one file with all numbers
in full: residuals, weights and noise of the ranges, derivatives by the motions of the map, learnt parts of the errors,
covariances, the table of tests; and the words of the verdicts. ``numbers_of`` is the only place that knows where the
program keeps them. The surveys are laps and halls that drift, paths without points, control points, positions alone and
with ranges, tapes, and one unknown anchor.

``compare`` prints the largest difference of each array, relative to its largest number, and whether the words are the
same. Exit status 1 if an array differs by more than the tolerance, or words do.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from tests.studies import drifting_maps, known_positions
from tests.studies.measured_distances import KINDS, simulated

from rangesfm.diagnostics.hypothesis_tests import MistakeTest
from rangesfm.diagnostics.linearized import linearized, ranges_on_map
from rangesfm.result.metric_result import MetricResult

Numbers = dict[str, npt.NDArray[Any]]


def drifting(kind: str, seed: int) -> MetricResult:
    return drifting_maps.run(drifting_maps.surveys(None)[kind](seed), seed)


def known(what: str, kind: str, seed: int) -> MetricResult:
    truth, survey = simulated(replace(KINDS[kind], frame="site"), seed)
    of_survey = known_positions.Known.of(what.split("+"), truth, survey, KINDS[kind].path(seed), seed)
    return of_survey.run(of_survey.surveyed, seed)


SURVEYS: dict[str, Callable[[], MetricResult]] = {
    "lap": lambda: drifting("lap", 1),
    "lap_unknown": lambda: drifting("lap_unknown", 0),
    "lap_radio": lambda: drifting("lap_radio", 3),
    "hall": lambda: drifting("hall", 0),
    "poses": lambda: drifting("poses", 2),
    "yard_points": lambda: known("points", "yard", 0),
    "room_positions": lambda: known("positions", "room", 1),
    "orbit_exif": lambda: known("exif", "orbit of a drone", 0),
    "yard_all": lambda: known("points+positions+ranges+anchors", "yard", 1),
    "room_ranges_unknown": lambda: known("ranges", "room", 0),
}


def numbers_of(metric: MetricResult) -> Numbers:
    """Return all numbers of a result by name; words are arrays of text."""
    estimate, place = metric.estimate, metric.place
    found: Numbers = {
        "scale": np.array([estimate.value, *estimate.interval_95, estimate.uncertainty.empirical]),
        "centers_m": metric.trajectory.as_in(metric.final).centers,
        "residuals_m": metric.residuals_m,
        "weights": metric.weights,
        "noise_m": metric.range_stddev_m,
        "status": metric.observations.status,
        "words": np.array([estimate.verdict, *estimate.reasons, *(place.reasons if place is not None else ())]),
    }
    if place is not None:
        found["place_stddev_m"] = np.array(place.stddev_m)
    components = estimate.uncertainty.components
    found["components"] = np.array([components[name] for name in sorted(components)])
    for anchor in metric.anchors:
        found[f"anchor_{anchor.anchor_id}"] = np.array([*anchor.position_m, *np.ravel(anchor.range_bias_m)])
    at = metric.refined_with_ranges
    on_map = metric.on_map if at is None else ranges_on_map(at.posed, at.solution, at.bending)
    if on_map is not None:
        problem = linearized(on_map).with_learnt_errors()
        found |= {
            "derivatives": problem.design,
            "bins_residual_m": problem.residual_m,
            "bins_covariance_m2": problem.errors.covariance_m2,
            "learnt": problem.errors.stddevs,
        }
    if metric.by_positions is not None:
        found["positions_stddev_m"] = metric.by_positions.stddev_m
    if metric.center_covariance_m2:
        found["centers_covariance_m2"] = np.array(list(metric.center_covariance_m2.values()))
    if metric.kept_refinement is not None and metric.kept_refinement.covariance is not None:
        found["similarity_covariance"] = metric.kept_refinement.covariance.similarity
    if metric.diagnosis is not None:
        tests = metric.diagnosis.tests
        names = [field.name for field in fields(MistakeTest) if field.type in ("float", "float | None", "bool | None")]
        rows = [[np.nan if getattr(test, name) is None else getattr(test, name) for name in names] for test in tests]
        found["tests"] = np.array(rows, dtype=np.float64)
        found["tests_words"] = np.array([f"{test.name} {test.subject}: {test.words}" for test in tests])
    return found


def dump(folder: Path, names: list[str]) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        np.savez_compressed(folder / f"{name}.npz", **numbers_of(SURVEYS[name]()))  # type: ignore[arg-type]
        print(name, flush=True)


def difference(one: npt.NDArray[Any], other: npt.NDArray[Any]) -> float:
    """Return the largest difference relative to the largest number; infinite for another shape or other words."""
    if one.shape != other.shape:
        return np.inf
    if one.dtype.kind == "U":
        return 0.0 if np.array_equal(one, other) else np.inf
    if not np.array_equal(np.isfinite(one), np.isfinite(other)):
        return np.inf
    known = np.isfinite(one)
    before, after = (values[known].astype(np.float64) for values in (one, other))
    return float(np.abs(before - after).max(initial=0.0) / np.abs(before).max(initial=1e-12))


def compare(folder: Path, other: Path, tolerance: float) -> bool:
    """Print how two dumps differ, and return whether they are the same."""
    is_same = True
    for path in sorted(folder.glob("*.npz")):
        with np.load(path) as one, np.load(other / path.name) as two:
            apart = {key: difference(one[key], two[key]) if key in two else np.inf for key in one}
            apart |= {key: np.inf for key in two if key not in one}
        worst = max(apart.values())
        is_same &= worst <= tolerance
        print(f"{path.stem}: {worst:.1e}", *(f"{key} {by:.1e}" for key, by in apart.items() if by > tolerance))
    return is_same


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    dumping = commands.add_parser("dump")
    dumping.add_argument("folder", type=Path)
    dumping.add_argument("--surveys", nargs="+", choices=SURVEYS, default=list(SURVEYS))
    comparing = commands.add_parser("compare")
    comparing.add_argument("folder", type=Path)
    comparing.add_argument("other", type=Path)
    comparing.add_argument("--tolerance", type=float, default=1e-6)
    args = parser.parse_args()
    if args.command == "dump":
        dump(args.folder, args.surveys)
        return 0
    return int(not compare(args.folder, args.other, args.tolerance))


if __name__ == "__main__":
    sys.exit(main())

"""Find which named numbers of the program decide results, by doubling each in turn.

Run: python -m tests.studies.deciding_numbers [--rooms measurements solver ...] [--out FILE]

A number is a constant at the top of a module, or one of a mapping or a tuple there. Each is doubled alone, wherever it
was imported to, and five small surveys are run again: a hall with a radio from the population and photos; a lap that
drifts by 2 m with one anchor; poses without points; a yard with ranges, positions and control points; and a room with
control points alone. A survey that never comes to a line that reads the number is not run again: it cannot change.
What other constants or default arguments were computed from it at import stays.

Prints the numbers that move a result, those that move most first: the largest change of a scale in its stddevs, the
largest change of a half width (ratio), of a keyframe's place in the map's stated stddevs, and verdicts that change or
surveys that fail. Those that move nothing by more than 1 % of a stddev are listed by name. With --out each is a line of
a file, and those that are there already are not repeated.
"""

from __future__ import annotations

import argparse
import ast
import dis
import importlib
import inspect
import json
import pkgutil
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from types import CodeType, FrameType, ModuleType
from typing import Any
from unittest.mock import patch

import numpy as np
from tests.simulated.runs import run_stages
from tests.simulated.surveys import Kind, simulated
from tests.studies import drifting_maps, known_positions
from tests.studies.kept_runs import KeptRuns
from tests.studies.measured_distances import KINDS

import rangesfm
from rangesfm.errors import RangesfmError
from rangesfm.pipeline.metric_result import MetricResult

ROOMS = ("solver", "measurements", "estimation", "diagnostics", "pipeline", "util")
MOVES_NOTHING = 0.01
Line = dict[str, Any]
Number = tuple[str, str, str]


def surveys() -> dict[str, Callable[[], MetricResult]]:
    """Functions that run a survey, by name."""

    def known(names: str, kind: Kind) -> Callable[[], MetricResult]:
        truth, survey = simulated(replace(kind, anchor_frame="site"), 0)
        of_survey = known_positions.Known.of(names.split("+"), truth, survey, kind.path(0), 0)
        return lambda: of_survey.run(of_survey.surveyed, 0)

    hall, yard = (replace(KINDS[name], interval_s=1.5, rate_hz=2.0) for name in ("hall", "yard"))
    lap = partial(drifting_maps.lap_of_drift, 2.0, 0)
    made = {
        "hall": simulated(hall, 0)[1],
        "lap": lap(num_keyframes=100),
        "poses": drifting_maps.without_points(lap("site", with_radio=True, num_keyframes=40)),
    }
    return {
        **{name: partial(run_stages, survey, 0) for name, survey in made.items()},
        "all": known("points+positions+ranges+anchors", yard),
        "points": known("points", KINDS["room"]),
    }


def numbers(rooms: tuple[str, ...]) -> Iterator[Number]:
    """Yield the module, the name and the key (or nothing) of each number."""
    for info in pkgutil.walk_packages(rangesfm.__path__, "rangesfm."):
        if info.name.split(".")[1] not in rooms or ".readers" in info.name:
            continue
        module = importlib.import_module(info.name)
        source = Path(str(module.__file__))
        if source.suffix != ".py":
            continue
        for node in ast.parse(source.read_text(encoding="utf-8")).body:
            targets = node.targets if isinstance(node, ast.Assign) else []
            targets = [node.target] if isinstance(node, ast.AnnAssign) else targets
            for name in (each.id for target in targets for each in ast.walk(target) if isinstance(each, ast.Name)):
                value = getattr(module, name, None)
                if is_number(value):
                    yield info.name, name, ""
                elif isinstance(value, Mapping):
                    yield from ((info.name, name, str(key)) for key, one in value.items() if is_number(one))


def is_number(value: object) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and value not in (0, 1) and abs(value) < 1e15


def doubled(number: Number) -> Line:
    """Return the modules' attributes to be patched, by module and name."""
    module, name, key = number
    value = getattr(sys.modules[module], name)
    twice = {each: 2 * one if str(each) == key else one for each, one in value.items()} if key else 2 * value
    return {
        f"{each}.{name}": twice
        for each, at in list(sys.modules.items())
        if each.startswith("rangesfm.") and getattr(at, name, None) is value and (each == module or imports(at, name))
    }


@cache
def imports(module: ModuleType, name: str) -> bool:
    """Return whether the module has the name from another one, rather than defining a number of its own by it."""
    nodes = ast.walk(ast.parse(inspect.getsource(module)))
    return any(one.name == name for node in nodes if isinstance(node, ast.ImportFrom) for one in node.names)


class Reads:
    """Record which attributes of the package's modules are read, as names with their modules, while it is entered."""

    def __init__(self) -> None:
        self.read: set[str] = set()
        self._to_come: dict[CodeType, dict[int, set[str]]] = {}

    def __enter__(self) -> Reads:
        threading.settrace(self._calls)
        sys.settrace(self._calls)
        return self

    def __exit__(self, *_: object) -> None:
        sys.settrace(None)
        threading.settrace(None)

    def _calls(self, frame: FrameType, event: str, arg: object) -> Callable[..., Any] | None:
        module = str(frame.f_globals.get("__name__"))
        if not module.startswith("rangesfm."):
            return None
        if frame.f_code not in self._to_come:
            self._to_come[frame.f_code] = dict(lines_that_read(frame.f_code, module))
        return self._lines if self._to_come[frame.f_code] else None

    def _lines(self, frame: FrameType, event: str, arg: object) -> Callable[..., Any] | None:
        lines = self._to_come[frame.f_code]
        self.read |= lines.pop(frame.f_lineno, set())
        return self._lines if lines else None


def lines_that_read(code: CodeType, module: str) -> dict[int, set[str]]:
    """Return the module's attributes that each line of the code reads."""
    found: dict[int, set[str]] = {}
    for instruction in dis.get_instructions(code):
        line = instruction.positions.lineno if instruction.positions is not None else None
        if instruction.opname in ("LOAD_GLOBAL", "LOAD_NAME") and line is not None:
            found.setdefault(line, set()).add(f"{module}.{instruction.argval}")
    return found


def compared(before: MetricResult, after: MetricResult) -> Line:
    """Return the changes of scale, half width and place."""
    first, second = before.estimate, after.estimate
    stddev = first.uncertainty.empirical
    centers_m = [each.trajectory.as_in(each.final).centers for each in (before, after)]
    size_m = float(np.linalg.norm(centers_m[0].std(axis=0)))
    stated_m = before.place.worst_keyframe_stddev_m if before.place is not None else stddev * size_m
    return {
        "scale": abs(float(np.log(second.value / first.value))) / stddev,
        "half_width": float(second.uncertainty.half_width_95 / first.uncertainty.half_width_95),
        "place": float(np.linalg.norm(centers_m[1] - centers_m[0], axis=1).max()) / stated_m,
        "verdict": "" if first.verdict == second.verdict else f"{first.verdict} -> {second.verdict}",
    }


def effect(
    number: Number,
    runs: Mapping[str, Callable[[], MetricResult]],
    usual: Mapping[str, MetricResult],
    read: Mapping[str, set[str]],
) -> Line:
    """Return the largest changes over the surveys that read the number, with the number doubled."""
    changes, said, twice_by_name = [], [], doubled(number)
    runs = {name: run for name, run in runs.items() if read[name] & twice_by_name.keys()}
    patches = [patch(at, twice) for at, twice in twice_by_name.items()]
    for each in patches:
        each.start()
    try:
        for name, run in runs.items():
            try:
                change = compared(usual[name], run())
            except (RangesfmError, np.linalg.LinAlgError, TypeError, ValueError, IndexError) as error:
                said.append(f"{name}: {error}")
                continue
            changes.append(change)
            said += [f"{name}: {change['verdict']}"] if change["verdict"] else []
    finally:
        for each in patches:
            each.stop()
    widths = [change["half_width"] for change in changes] or [1.0]
    return {
        "read_by": list(runs),
        "scale": max((change["scale"] for change in changes), default=0.0),
        "half_width": max(widths, key=lambda ratio: abs(np.log(ratio))),
        "place": max((change["place"] for change in changes), default=0.0),
        "said": said,
    }


def size_of(line: Line) -> float:
    return float(max(line["scale"], line["place"], abs(np.log(line["half_width"])), bool(line["said"])))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rooms", nargs="*", default=ROOMS, choices=ROOMS, metavar="NAME")
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    kept, runs = KeptRuns(args.out, "number"), surveys()
    usual, read = {}, {}
    for name, run in runs.items():
        with Reads() as reads:
            usual[name] = run()
        read[name] = reads.read
    for number in numbers(tuple(args.rooms)):
        print(json.dumps(kept.run(partial(effect, number, runs, usual, read), number=list(number))), flush=True)
    lines = sorted(kept.rows, key=size_of, reverse=True)
    print("number, change of a scale (stddevs), of a half width (ratio), of a place (stddevs), verdicts")
    for line in (line for line in lines if size_of(line) > MOVES_NOTHING):
        name = ".".join(filter(None, line["number"]))
        print(f"{name}: {line['scale']:.2f}, {line['half_width']:.3f}, {line['place']:.2f}, {'; '.join(line['said'])}")
    for what, is_read in (("read, and move nothing", True), ("not read", False)):
        those = (line for line in lines if size_of(line) <= MOVES_NOTHING and bool(line["read_by"]) == is_read)
        print(f"{what}: {', '.join('.'.join(filter(None, line['number'])) for line in those)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())

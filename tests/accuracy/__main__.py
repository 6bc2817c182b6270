"""Measure accuracy, honesty and speed of this state in one table, and compare it with the stored one.

    python -m tests.accuracy [--data DIR] [--quick] [--groups NAME ...] [--workers 2] [--store]

DIR holds the data sets that ``examples/public_data.md`` describes; groups that need what is not there are left out, and
named. ``tests/accuracy/groups.py`` lists the groups: what each runs, and its figures. ``--quick`` runs a part of the
cases of each group. The same cases have the same seeds, so that two runs on one state give the same figures, apart from
times.

Each figure is compared with the stored one over the cases that both have: over all of a group, and over those whose
names differ only in the number at their end, which mostly is the seed. It is worse if more cases are worse, and by
more, than chance makes so. Prints the table; exit status 1 if a figure is worse.

``--store`` stores the cases, and writes the tables into ``examples/measured.md``.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path

from tests.accuracy.figures import Cases, Loss, Values, kind_of
from tests.accuracy.groups import GROUPS, Group, Task, cases_of

STORED = Path(__file__).with_name("stored.json")
PAGE = Path(__file__).parents[2] / "examples" / "measured.md"
BEGIN, END = "<!-- written by python -m tests.accuracy --store -->\n", "<!-- end -->\n"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--groups", nargs="+", choices=[group.name for group in GROUPS])
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--store", action="store_true")
    args = parser.parse_args()
    if args.store and args.quick:
        parser.error("--store is for all cases")
    groups = [group for group in GROUPS if args.groups is None or group.name in args.groups]
    found = measured(groups, args.data, quick=args.quick, num_workers=args.workers)
    stored = json.loads(STORED.read_text(encoding="utf-8"))["groups"] if STORED.exists() else {}
    losses = [loss for name, cases in found.items() for loss in losses_of(name, cases, stored.get(name, {}))]
    print("\n".join(rows(found)))
    for name, loss in losses:
        if loss.is_real:
            print(f"WORSE: {name}, {loss.words}: by {loss.by:.3g} on the average")
    if args.store:
        store({**stored, **found})
    return int(any(loss.is_real for _, loss in losses))


def measured(groups: list[Group], data: Path | None, *, quick: bool, num_workers: int) -> dict[str, Cases]:
    """Run all cases side by side, those that take longest first, and return their values by group."""
    # Each process has one thread for linear algebra; it is read when numpy is loaded, hence before the processes begin.
    os.environ |= {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    tasks = [task for group in groups for task in group.tasks(data, quick)]
    for group in groups:
        if not any(task.group == group.name for task in tasks):
            print(f"left out, without its data: {group.name}", file=sys.stderr)
    found: dict[str, dict[str, Values]] = {group.name: {} for group in groups}
    start = time.perf_counter()
    with ProcessPoolExecutor(num_workers, mp_context=get_context("spawn")) as pool:
        running = {pool.submit(cases_of, task): task for task in sorted(tasks, key=lambda task: -task.seconds)}
        for number, future in enumerate(as_completed(running), 1):
            task: Task = running[future]
            found[task.group] |= future.result()
            print(f"{time.perf_counter() - start:5.0f} s, {number} of {len(tasks)}: {task.name}", file=sys.stderr)
    return {name: dict(sorted(cases.items())) for name, cases in found.items() if cases}


def losses_of(name: str, cases: Cases, stored: Cases) -> Iterator[tuple[str, Loss]]:
    """Yield the name of the group with each comparison."""
    group = next(group for group in GROUPS if group.name == name)
    for figure in group.figures:
        yield from ((name, loss) for loss in figure.losses(cases, stored))


def rows(found: dict[str, Cases]) -> Iterator[str]:
    """Yield the table in Markdown."""
    yield "| what | cases | measured |"
    yield "|---|---|---|"
    for group in GROUPS:
        if cases := found.get(group.name):
            figures = "; ".join(f"{figure.words} {figure.text(cases)}" for figure in group.figures)
            yield f"| {group.words} (`{group.name}`) | {len(cases)} | {figures} |"


def kind_rows(group: Group, cases: Cases) -> Iterator[str]:
    """Yield a table with the medians of each kind of case of a group."""
    figures = [
        replace(figure, over="median")
        for figure in group.figures
        if figure.key not in ("covered", "in_stddevs", "named", "refused")
    ]
    yield f"\n## {group.title}\n"
    yield f"| | {' | '.join(figure.words for figure in figures)} |"
    yield "|---" * (len(figures) + 1) + "|"
    for kind in dict.fromkeys(map(kind_of, cases)):
        of_kind = {case: values for case, values in cases.items() if kind_of(case) == kind}
        yield f"| {kind} | {' | '.join(figure.text(of_kind) for figure in figures)} |"


def store(found: dict[str, Cases]) -> None:
    """Store the cases with the state that they were measured on, and write the page of what is measured."""
    state = subprocess.run(["git", "describe", "--always", "--dirty"], capture_output=True, text=True, check=True)
    content = {"state": state.stdout.strip(), "groups": found}
    STORED.write_text(json.dumps(content, indent=0, sort_keys=True) + "\n", encoding="utf-8")
    write_page(found)


def write_page(found: dict[str, Cases]) -> None:
    """Write the tables into the page of what is measured."""
    before, rest = PAGE.read_text(encoding="utf-8").split(BEGIN)
    of_kinds = [row for group in GROUPS if group.title for row in kind_rows(group, found.get(group.name, {}))]
    tables = "\n".join(["", *rows(found), *of_kinds, "\n"])
    PAGE.write_text(before + BEGIN + tables + END + rest.split(END, 1)[1], encoding="utf-8")


if __name__ == "__main__":
    sys.exit(main())

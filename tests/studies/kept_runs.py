"""Studies that keep each simulated run as a line of a file, and continue there when they are started again."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Collection
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

Row = dict[str, Any]


class KeptRuns:
    """The runs of a study that are done, which a file keeps as JSON lines (None: nothing is kept).

    ``names`` are those of the values that say which run a line is.
    """

    def __init__(self, file: Path | None, *names: str) -> None:
        self._file = file
        kept = file.read_text(encoding="utf-8").splitlines() if file is not None and file.exists() else []
        lines: list[Row] = [json.loads(line) for line in kept]
        self._done = {str([line[name] for name in names]): line for line in lines}

    @property
    def rows(self) -> list[Row]:
        return list(self._done.values())

    def has(self, **which: Any) -> bool:
        return str([*which.values()]) in self._done

    def run(self, make: Callable[[], Row], **which: Any) -> Row:
        """Return the line of a run; a missing one is made and added to the file."""
        key = str([*which.values()])
        if key not in self._done:
            self._done[key] = which | make()
            if self._file is not None:
                with self._file.open("a", encoding="utf-8") as lines:
                    print(json.dumps(self._done[key]), file=lines)
        return self._done[key]


def seeds_parser(doc: str | None, kinds: Collection[str] | None, num_seeds: int) -> argparse.ArgumentParser:
    """Return the command line of a study that runs kinds of surveys, each with many seeds.

    Args:
        kinds: those that there are, by default all; None: any word may be given.
    """
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kinds", nargs="+", default=kinds, choices=kinds, metavar="NAME")
    parser.add_argument("--num_seeds", type=int, default=num_seeds)
    parser.add_argument("--seed", type=int, default=0, help="the first")
    parser.add_argument("--out", type=Path, help="keeps the runs, which are not made again")
    return parser


def runs_of(asked: argparse.Namespace, kind: str, told: Callable[[int], Row]) -> list[Row]:
    """Return the runs of a kind of survey with each seed."""
    kept, rows = KeptRuns(asked.out, "kind", "seed"), []
    for seed in range(asked.seed, asked.seed + asked.num_seeds):
        print(f"{kind}, {seed}", file=sys.stderr)
        rows.append(kept.run(partial(told, seed), kind=kind, seed=seed))
    return rows


def spread(rows: list[Row], name: str) -> tuple[float, float]:
    """Return the root mean square of errors (of a place, of their lengths), and its relative stddev by chance.

    The relative stddev is half of the mean square's, whatever the errors' distribution.
    """
    squares = np.array([float(np.sum(np.square(row[name]))) for row in rows if name in row])
    if not len(squares):
        return float("nan"), float("nan")
    mean = float(squares.mean())
    return mean**0.5, 0.5 * float(squares.std(ddof=1)) / mean / len(squares) ** 0.5 if len(squares) > 1 else 1.0

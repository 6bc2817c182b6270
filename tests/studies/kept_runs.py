"""Studies that keep each simulated run as a line of a file, and continue there when they are started again."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

Row = dict[str, Any]


@dataclass(frozen=True)
class Study:
    """The arguments of a study.

    Attributes:
        file: keeps the runs that are done, as JSON lines.
        num_seeds: runs of each survey.
        beginning: only surveys whose names begin with this text are run.
    """

    file: Path
    num_seeds: int
    beginning: str

    def runs_of(self, name: str, run: Callable[[int], Row]) -> list[Row]:
        """Return the runs of a survey from the file; missing ones are made and added to the file."""
        kept = [json.loads(line) for line in self.file.read_text().splitlines()] if self.file.exists() else []
        rows = [row for row in kept if row["survey"] == name and row["seed"] < self.num_seeds]
        done = {row["seed"] for row in rows}
        with self.file.open("a") as lines:
            for seed in (seed for seed in range(self.num_seeds) if seed not in done):
                rows.append({"survey": name, "seed": seed} | run(seed))
                print(json.dumps(rows[-1]), file=lines, flush=True)
        return rows


def study(doc: str | None) -> Study:
    """Parse the command line."""
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rows", type=Path, required=True, help="what is done, as JSON lines")
    parser.add_argument("--num_seeds", type=int, default=100)
    parser.add_argument("--surveys", default="", help="only those whose name begins so")
    args = parser.parse_args()
    return Study(args.rows, args.num_seeds, args.surveys)


def spread(rows: list[Row], name: str) -> tuple[float, float]:
    """Return the root mean square of errors (of a place, of their lengths), and its relative stddev by chance.

    The relative stddev is half of the mean square's, whatever the errors' distribution.
    """
    squares = np.array([float(np.sum(np.square(row[name]))) for row in rows if name in row])
    if not len(squares):
        return float("nan"), float("nan")
    mean = float(squares.mean())
    return mean**0.5, 0.5 * float(squares.std(ddof=1)) / mean / len(squares) ** 0.5 if len(squares) > 1 else 1.0

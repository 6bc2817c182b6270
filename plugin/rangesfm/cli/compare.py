"""``rangesfm compare``: what scaling and refinement did, and how far from the truth the result is."""

from __future__ import annotations

import argparse
from pathlib import Path

from rangesfm.cli.arguments import Commands, Outcome
from rangesfm.cli.result_argument import add_result_argument, result_path
from rangesfm.progress import Progress


def add_command(commands: Commands) -> None:
    parser = commands.add(
        "compare",
        execute,
        help="unscaled, scaled and refined model with each other and with a reference",
        description="Compare the models of a result folder with each other, and with a reference if there is one.",
        example="rangesfm compare out --reference reference.csv",
    )
    add_result_argument(parser)
    parser.add_argument("--reference", metavar="FILE", help="true positions: CSV or TUM")


def execute(args: argparse.Namespace, progress: Progress) -> Outcome:
    from rangesfm.comparison import compare_folder

    reference = None if args.reference is None else Path(args.reference)
    return Outcome([str(compare_folder(result_path(args), reference))])

"""``rangesfm report``: a result folder as one HTML page."""

from __future__ import annotations

import argparse

from rangesfm.cli.arguments import Commands, Outcome
from rangesfm.cli.result_argument import add_result_argument, result_path
from rangesfm.progress import Progress


def add_command(commands: Commands) -> None:
    parser = commands.add(
        "report",
        execute,
        help="result folder to one self-contained HTML page",
        description="Write report.html, one self-contained page, into a result folder.",
        example="rangesfm report out",
    )
    add_result_argument(parser)


def execute(args: argparse.Namespace, progress: Progress) -> Outcome:
    from rangesfm.report import write_report

    return Outcome([str(write_report(result_path(args)))])

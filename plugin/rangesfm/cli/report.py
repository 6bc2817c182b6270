"""``rangesfm report``: a result folder as one HTML page."""

from __future__ import annotations

import argparse
from pathlib import Path

from rangesfm.cli.arguments import Commands, Outcome
from rangesfm.cli.result_argument import add_result_argument, result_path
from rangesfm.errors import InputError
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
    parser.add_argument("--images", metavar="FOLDER", help="the photos, for thumbnails (default: as in the run)")
    parser.add_argument("--png", action="store_true", help="write the figures for a paper too, as PNG and SVG")


def execute(args: argparse.Namespace, progress: Progress) -> Outcome:
    from rangesfm.report import write_report, write_report_pictures

    images = None if args.images is None else Path(args.images)
    if images is not None and not images.is_dir():
        raise InputError("no such folder of photos", images)
    lines = [str(write_report(result_path(args), images_path=images))]
    if args.png:
        lines += map(str, write_report_pictures(result_path(args)))
    return Outcome(lines)

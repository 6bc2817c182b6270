"""``rangesfm export``: the metric model in other formats."""

from __future__ import annotations

import argparse
from pathlib import Path

from rangesfm.cli.arguments import Commands, Outcome
from rangesfm.cli.result_argument import add_result_argument, result_path
from rangesfm.progress import Progress


def add_command(commands: Commands) -> None:
    parser = commands.add(
        "export",
        execute,
        help="metric model to other formats",
        description="Write the metric model of a result folder in other formats; an unknown one lists them all.",
        example="rangesfm export out --formats tum,ply,ply_cameras --output_path exported",
    )
    add_result_argument(parser)
    parser.add_argument("--formats", metavar="A,B,..", help="what to write (default: what a run exports)")
    parser.add_argument("--output_path", metavar="FOLDER", help="where to (default: the result folder)")


def execute(args: argparse.Namespace, progress: Progress) -> Outcome:
    from rangesfm.config import DEFAULT_FORMATS
    from rangesfm.export import export_result

    source = result_path(args)
    formats = DEFAULT_FORMATS if args.formats is None else args.formats.replace(",", " ").split()
    return Outcome([str(path) for path in export_result(source, formats, Path(args.output_path or source))])

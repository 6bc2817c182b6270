"""``rangesfm export``: the metric model in other formats and frames."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from rangesfm.cli.arguments import Commands, Outcome
from rangesfm.cli.result_argument import add_result_argument, result_path
from rangesfm.cli.survey_flags import add_flags, overrides_from_arguments
from rangesfm.errors import InputError
from rangesfm.progress import Progress

if TYPE_CHECKING:
    from rangesfm.options import ExportOptions


def add_command(commands: Commands) -> None:
    parser = commands.add(
        "export",
        execute,
        help="metric model to other formats",
        description="Write the metric model of a result folder in other formats; an unknown one lists them all.",
        example="rangesfm export out --formats tum,ply,nerfstudio --frame level --output_path exported",
    )
    add_result_argument(parser)
    add_flags(parser, "export", by_own_names=True)
    parser.add_argument(
        "--apply_to",
        nargs="+",
        metavar="FILE",
        help="carry these, made from the unscaled model, over instead: PLY, OBJ, camera JSON, COLMAP folders",
    )
    parser.add_argument("--images", metavar="FOLDER", help="the photos (default: where the run found them)")
    parser.add_argument("--output_path", metavar="FOLDER", help="where to (default: the result folder)")


def execute(args: argparse.Namespace, progress: Progress) -> Outcome:
    from rangesfm.survey.settings import survey_from_tables
    from rangesfm.workflows.export_result import export_result

    source = result_path(args)
    overrides = overrides_from_arguments(args)
    options = survey_from_tables({}, Path.cwd(), overrides).export
    if args.apply_to is not None:
        if "export.formats" in overrides:
            raise InputError("--apply_to writes files in their own formats: leave out --formats")
        return _apply(source, args, options)
    images_path = None if args.images is None else Path(args.images)
    written = export_result(
        source, options.formats, Path(args.output_path or source), options=options, images_path=images_path
    )
    return Outcome([*map(str, written), *_frame_note(options, source)])


def _apply(source: Path, args: argparse.Namespace, options: ExportOptions) -> Outcome:
    from rangesfm.workflows.export_result import apply_result

    destination = Path(args.output_path or source / "applied")
    paths, residual_m = apply_result(source, [Path(path) for path in args.apply_to], destination, options=options)
    note = f"cameras of the refined map are {residual_m:.3f} m (rms) from where the similarity puts them"
    return Outcome([*map(str, paths), *_frame_note(options, source), *([note] if residual_m else [])])


def _is_site(source: Path) -> bool:
    from rangesfm.result.folder import read_result_folder

    return read_result_folder(source).summary.frame == "site"


def _frame_note(options: ExportOptions, result_folder: Path) -> list[str]:
    """Where up came from, if it was asked for: nobody can see it in the files."""
    if options.frame == "result" and options.origin_anchor is None:
        return []
    if options.frame == "enu" and options.origin_anchor is None:
        return ["up is away from the ellipsoid, by the anchors' coordinates"]
    if options.up == "auto" and _is_site(result_folder):
        return ["up is z of the site"]
    photos = "the mean of what is up in the photos"
    source = {"cameras": photos, "auto": photos, "path": "across the plane of the path"}
    return [f"up is {source.get(options.up, f'{options.up} in the frame of the result')}"]

"""``rangesfm export``: the metric model in other formats and frames."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from rangesfm.cli.arguments import Commands, Outcome
from rangesfm.cli.result_argument import add_result_argument, result_path
from rangesfm.cli.survey_flags import position
from rangesfm.errors import InputError
from rangesfm.options import DEFAULT_FORMATS, EXPORT_FRAMES
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
    parser.add_argument("--formats", metavar="A,B,..", help="what to write (default: what a run exports)")
    parser.add_argument("--frame", choices=EXPORT_FRAMES, default="result", help="its frame (default: the result's)")
    parser.add_argument(
        "--up",
        metavar="UP",
        default="auto",
        help="what is up: cameras, path or a direction X,Y,Z (default: z in a site frame, else cameras)",
    )
    parser.add_argument("--crs", metavar="CRS", help="coordinate system for maps, as EPSG:2056 (default: the anchors')")
    parser.add_argument("--origin_anchor", metavar="ID", help="an anchor whose place on the Earth is known")
    parser.add_argument(
        "--origin_lat_lon_height", metavar="LAT,LON,H", type=position, help="its place: degrees and metres, WGS 84"
    )
    parser.add_argument("--heading_deg", metavar="DEG", type=float, help="azimuth in which the first camera looks")
    parser.add_argument(
        "--apply_to",
        nargs="+",
        metavar="FILE",
        help="carry these, made from the unscaled model, over instead: PLY, OBJ, camera JSON, COLMAP folders",
    )
    parser.add_argument("--images", metavar="FOLDER", help="the photos (default: where the run found them)")
    parser.add_argument("--output_path", metavar="FOLDER", help="where to (default: the result folder)")


def execute(args: argparse.Namespace, progress: Progress) -> Outcome:
    from rangesfm.options import ExportOptions
    from rangesfm.workflows.export_result import export_result

    source = result_path(args)
    formats = DEFAULT_FORMATS if args.formats is None else args.formats.replace(",", " ").split()
    place = args.origin_lat_lon_height
    options = ExportOptions(
        frame=args.frame,
        up=args.up,
        crs=args.crs,
        origin_anchor=args.origin_anchor,
        origin_lat_lon_height=None if place is None else (place[0], place[1], place[2]),
        heading_deg=args.heading_deg,
    )
    if args.apply_to is not None:
        return _apply(source, args, options)
    images_path = None if args.images is None else Path(args.images)
    written = export_result(source, formats, Path(args.output_path or source), options=options, images_path=images_path)
    return Outcome([*map(str, written), *_frame_note(options, source)])


def _apply(source: Path, args: argparse.Namespace, options: ExportOptions) -> Outcome:
    from rangesfm.workflows.export_result import apply_result

    if args.formats is not None:
        raise InputError("--apply_to writes files in their own formats: leave out --formats")
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

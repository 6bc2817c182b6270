"""The commands that work on results of runs: ``measure``, ``export``, ``compare`` and ``report``."""

from __future__ import annotations

import argparse
import itertools
from pathlib import Path
from typing import TYPE_CHECKING

from rangesfm.cli.arguments import Commands, Outcome
from rangesfm.cli.help_pages import Parser
from rangesfm.cli.survey_flags import add_flags, flags_given, overrides_from_arguments, survey_from_arguments
from rangesfm.errors import InputError
from rangesfm.progress import Progress
from rangesfm.util.files.atomic import require_apart

if TYPE_CHECKING:
    from rangesfm.options import ExportOptions

_COMPARE_KEYS = ("images.path", "ranges", "anchors", "tag", "scale")
_OF_A_RUN = ("ranges.check_share", "ranges.check_anchors", "ranges.check_times_s", "scale.method")
_WITHOUT_LOG = ("--images", "--distances", "--markers")


def add_results_commands(commands: Commands) -> None:
    measure = commands.add("measure", _measure, "measure distances and height differences in a map", is_common=True)
    measure.add_argument("result", metavar="RESULT", help="output folder of a run")
    measure.add_argument(
        "points",
        nargs="*",
        metavar="POINT",
        help="two or more points, all pairs of which are measured: photos, markers, printed tags (tag7) or their "
        "corners (tag7.0), anchors, 3-D points of the model (point:1234)",
    )
    measure.add_argument("--pairs", type=Path, metavar="FILE", help="CSV from,to with further pairs of points")
    measure.add_argument(
        "--markers",
        type=Path,
        metavar="FILE",
        help="CSV marker,image_name,x_px,y_px with marks in photos (default: the tags and markers of the run)",
    )
    measure.add_argument("--output_path", type=Path, metavar="FILE", help="also write the measurements as CSV")
    export = commands.add("export", _export, "write the metric model in other formats", is_common=True)
    _add_result_argument(export)
    add_flags(export, "export", by_own_names=True)
    export.add_argument(
        "--apply_to",
        nargs="+",
        metavar="FILE",
        help="instead, transform these files, made from the unscaled model, into the metric frame: PLY, OBJ, camera "
        "JSON, COLMAP folders",
    )
    export.add_argument(
        "--images",
        type=Path,
        metavar="FOLDER",
        help="folder of the photos (default: that of the run, beside the result)",
    )
    export.add_argument("--output_path", metavar="FOLDER", help="folder to write to (default: the result folder)")
    compare = commands.add("compare", _compare, "compare models with each other and with a reference")
    compare.add_argument("models", nargs="*", metavar="MODEL", help="result folders, COLMAP models, CSV or TUM files")
    compare.add_argument("--input_path", metavar="RESULT", help="one result folder (default: out)")
    compare.add_argument("--reference", type=Path, metavar="FILE", help="true positions: CSV or TUM")
    compare.add_argument(
        "--output_path", metavar="FOLDER", help="for two models or more: also write comparison.html to this folder"
    )
    add_flags(compare, *_COMPARE_KEYS, without=_OF_A_RUN)
    report = commands.add("report", _report, "write a result folder as one self-contained HTML page", is_common=True)
    _add_result_argument(report)
    report.add_argument(
        "--images",
        type=Path,
        metavar="FOLDER",
        help="folder of the photos, for thumbnails (default: that of the run, beside the result)",
    )
    report.add_argument("--png", action="store_true", help="also write the figures as PNG and SVG files")
    add_flags(report, "report.title", "report.by")


def _add_result_argument(parser: Parser) -> None:
    """Add the argument of the result folder, as a positional argument or as ``--input_path``."""
    parser.add_argument("result", nargs="?", metavar="RESULT", help="output folder of a run (default: out)")
    parser.add_argument("--input_path", metavar="RESULT", help="the same as RESULT")


def _result_path(args: argparse.Namespace) -> Path:
    if args.result is not None and args.input_path is not None:
        raise InputError(f"two result folders are given, {args.result} and {args.input_path}; expected one")
    return Path(args.result or args.input_path or "out")


def _measure(args: argparse.Namespace, progress: Progress) -> Outcome:
    r"""Measure distances and height differences between points of a map. Their 95 % intervals count how the two points
    err together: by the scale, by the map's bending, and by the photos that show them. Height differences need a site
    frame, or a given upward direction.

    example:
      rangesfm measure out IMG_0001.jpg IMG_0020.jpg A1
      rangesfm measure out --pairs pairs.csv --markers marks.csv \
        --output_path measured.csv
    """
    from rangesfm.pipeline.measure import measure, read_point_pairs

    if again := {name for name in args.points if args.points.count(name) > 1}:
        raise InputError(f"{min(again)} is given twice, expected different points")
    if len(args.points) == 1 or not (args.points or args.pairs):
        given = f"one point, {args.points[0]}" if args.points else "no point"
        raise InputError(f"{given} is given, expected two or more (or --pairs FILE)")
    pairs = [*itertools.combinations(args.points, 2), *(read_point_pairs(args.pairs) if args.pairs else ())]
    found = measure(Path(args.result), pairs, markers=args.markers)
    if args.output_path is None:
        return Outcome([str(found)])
    require_apart([path for path in (args.pairs, args.markers) if path is not None], args.output_path)
    found.write(args.output_path)
    return Outcome([str(found), f"table: {args.output_path}"])


def _export(args: argparse.Namespace, progress: Progress) -> Outcome:
    r"""Write the metric model of a result folder in other formats. An unknown format prints the list of all.

    example:
      rangesfm export out --formats tum,ply,nerfstudio --frame level \
        --output_path exported
    """
    from rangesfm.export import NERFSTUDIO_IMAGES, TRAINERS_FORMATS
    from rangesfm.export.offset import offset_note
    from rangesfm.pipeline.export_result import apply_result, export_result

    source = _result_path(args)
    options = survey_from_arguments(args).export
    if args.apply_to is None:
        destination, notes = Path(args.output_path or source), []
        written = export_result(source, options.formats, destination, options=options, images_path=args.images)
        if "nerfstudio" in options.formats and not (destination / NERFSTUDIO_IMAGES).is_dir():
            notes = [f"the photos are not there: give --images, or copy them to {destination / NERFSTUDIO_IMAGES}"]
        is_moved = options.frame == "level" or not {*TRAINERS_FORMATS}.isdisjoint(options.formats)
    else:
        if "formats" in options.model_fields_set:
            raise InputError("--apply_to writes files in their own formats: leave out --formats")
        destination = Path(args.output_path or source / "applied")
        written, told = apply_result(source, list(map(Path, args.apply_to)), destination, options=options)
        notes, is_moved = list(told), options.frame == "level"
    notes += offset_note(destination) if is_moved else []
    return Outcome([*map(str, written), *_frame_note(options, source), *notes])


def _frame_note(options: ExportOptions, result_folder: Path) -> list[str]:
    """Return a line that says which direction is up in the exported files, where an option asked for one."""
    if options.frame == "result" and not options.origin_anchor:
        return []
    if options.frame == "enu" and not options.origin_anchor:
        return ["up is perpendicular to the ellipsoid, by the site's coordinates"]
    from rangesfm.result.result_folder import read_result_folder

    summary = read_result_folder(result_folder).summary
    if options.up == "auto" and summary.up is not None:
        return ["up is z of the site" if summary.frame == "site" else "up is as it was measured"]
    photos = "the mean upward direction of the photos"
    source = {"cameras": photos, "auto": photos, "path": "perpendicular to the plane of the path"}
    return [f"up is {source.get(options.up, f'{options.up} in the frame of the result')}"]


def _compare(args: argparse.Namespace, progress: Progress) -> Outcome:
    r"""Compare models. One result folder: its models with each other, and with a reference if there is one. Two or
    more models, result folders or files of camera positions by photo or time, in any order: each of them with the
    first. --ranges compares them with a radio log, placed on the first model (default: the ranges that the first
    result folder used), and --distances with taped distances. The photos' times are those of --images, of the result
    folders, or in the photos' names.

    example:
      rangesfm compare out --reference reference.csv
      rangesfm compare out other_tool/sparse/0 --output_path comparison
      rangesfm compare one/sparse/0 other/sparse/0 --ranges uwb.csv \
        --anchors anchors.csv --images images.csv \
        --tag_in_cam -0.0012,-0.09,-0.0663 --distances taped.csv
    """
    given = [*([] if args.input_path is None else [args.input_path]), *args.models]
    paths = [Path(path) for path in given] or [Path("out")]
    from rangesfm.result.summary import ResultSummary

    if len(paths) > 1 or (args.reference is not None and not (paths[0] / ResultSummary.NAME).is_file()):
        return _compare_many(args, paths)
    if args.output_path is not None:
        raise InputError(f"one model is given, {paths[0]}; a page of comparison needs two (see rangesfm report)")
    if overrides_from_arguments(args):
        raise InputError(f"one model is given, {paths[0]}; comparing models with ranges or distances needs two")
    from rangesfm.comparison.before_after import compare_folder

    return Outcome([compare_folder(paths[0], args.reference)])


def _compare_many(args: argparse.Namespace, paths: list[Path]) -> Outcome:
    from rangesfm.comparison.many_models import compare_many, read_named_models
    from rangesfm.comparison.model_ranges import NO_RANGES
    from rangesfm.measurements.lengths.tape import Tape
    from rangesfm.measurements.lengths.tape_file import read_markers, read_tape
    from rangesfm.measurements.positions.true_positions import read_true_positions
    from rangesfm.pipeline.ranges_for_models import ranges_of_survey
    from rangesfm.util.geometry.reference import NO_REFERENCE

    if args.output_path is not None:
        require_apart(paths, Path(args.output_path))
    given = flags_given(args, *_COMPARE_KEYS)
    of_log = [name for name in given if name not in _WITHOUT_LOG]
    if of_log and "--ranges" not in given:
        raise InputError(f"{', '.join(of_log)} given without a log to use it for, expected --ranges LOG as well")
    survey = survey_from_arguments(args)
    models, ranges, tape = read_named_models(paths, survey), NO_RANGES, Tape()
    if survey.ranges.path is not None:
        model, path = next((one.model, path) for one, path in zip(models, paths, strict=True) if one.model.num_images())
        ranges = ranges_of_survey(survey, model, path)
    if survey.scale.distances is not None:
        tape = read_tape(survey.scale.distances)
        if survey.scale.markers is not None:
            tape = tape.with_more_markers(read_markers(survey.scale.markers))
    reference = NO_REFERENCE if args.reference is None else read_true_positions(args.reference)
    comparison = compare_many(models, ranges, tape, reference)
    lines = [str(comparison)]
    if args.output_path is not None:
        from rangesfm.comparison.comparison_page import write_comparison

        lines += ["", f"page: {write_comparison(comparison, Path(args.output_path))}"]
    return Outcome(lines)


def _report(args: argparse.Namespace, progress: Progress) -> Outcome:
    """Write report.html, one self-contained page, into a result folder.

    Without --images, the page shows the photos of the run if they are in the result folder or in the folder around
    it. Photos elsewhere are not used, because a result from somebody else could name any of your folders.

    example:
      rangesfm report out
      rangesfm report results/monday --images photos --report_title "Hall 7"
    """
    from rangesfm.report import write_report, write_report_pictures
    from rangesfm.result.result_folder import read_result_folder

    source = _result_path(args)
    if args.images is not None and not args.images.is_dir():
        raise InputError("no such folder of photos", args.images)
    pictures, labels = write_report_pictures if args.png else lambda _: (), survey_from_arguments(args).report
    page = write_report(source, images_path=args.images, title=labels.title or "", by=labels.by or "")
    written = [str(page), *map(str, pictures(source))]
    result = read_result_folder(source)
    recorded = result.summary.settings.images.path
    if args.images is None and recorded is not None and result.images_path is None:
        written.append(
            f"without photos: those of the run are in {recorded}, not in the folder around the result (use --images)"
        )
    return Outcome(written)

"""``rangesfm ranges calibrate``: the error curve of a radio, from ranges whose true lengths are known."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from rangesfm.cli.arguments import Commands, Outcome
from rangesfm.cli.log_arguments import add_log_arguments, notes_of_log, read_log
from rangesfm.cli.position_arguments import add_position_arguments, read_tag_positions
from rangesfm.files.text_table import align_rows
from rangesfm.progress import Progress

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rangesfm.ranging.errors.calibration import Calibration


def add_command(commands: Commands) -> None:
    parser = commands.add(
        "ranges calibrate",
        execute,
        help="the error curve of a radio, from a log with known tag positions",
        description=(
            "Learn by how much a radio reads long or short at each distance, from a log whose tag positions are "
            "known (a total station, motion capture) and surveyed anchors. Every command takes the file that this "
            "writes as --error_curve, or as error_curve in [ranges]."
        ),
        example=(
            "rangesfm ranges calibrate log.csv --anchors anchors.csv --positions truth.csv \\\n"
            "    --output_path curve.csv"
        ),
    )
    add_log_arguments(parser)
    parser.add_argument("--anchors", required=True, metavar="CSV", help="anchor_id,x_m,y_m,z_m: surveyed")
    add_position_arguments(parser, max_interpolation_gap_s=0.2)
    parser.add_argument("--output_path", required=True, metavar="CSV", help="write the curve there")
    parser.add_argument("--plot", metavar="FILE", help="draw the curve and the ranges' errors there (PNG or SVG)")


def execute(args: argparse.Namespace, progress: Progress) -> Outcome:
    from rangesfm.ranging.anchors.anchor_file import read_anchors
    from rangesfm.ranging.errors.calibration import calibrate_ranges
    from rangesfm.ranging.errors.error_curve import write_error_curve
    from rangesfm.survey.inputs import of_one_tag

    anchors = read_anchors(args.anchors)
    log = of_one_tag(read_log(args), args.tag_id)
    tags = read_tag_positions(args, log)
    calibration = calibrate_ranges(log, tags, anchors)
    lines = [*notes_of_log(log), *_lines(calibration, len(log)), "", f"written to {args.output_path}"]
    if args.plot is not None:
        from rangesfm.report.pictures import write_picture
        from rangesfm.report.range_plots import plot_error_curve

        write_picture(plot_error_curve(calibration), Path(args.plot))
        lines.append(f"drawn in {args.plot}")
    write_error_curve(calibration.curve, Path(args.output_path))
    return Outcome(lines)


def _lines(calibration: Calibration, num_in_log: int) -> Sequence[str]:
    curve = calibration.curve
    columns = (curve.distance_m, curve.error_m, curve.stddev_m, curve.noise_stddev_m)
    rows = [
        (f"{distance:.2f}", f"{error:+.3f}", f"{stddev:.3f}", f"{noise:.3f}")
        for distance, error, stddev, noise in zip(*columns)
    ]
    return [
        f"ranges  {calibration.num_ranges} of {num_in_log} have a known length, "
        f"{100 * calibration.outlier_share:.1f} % do not fit",
        f"noise   {calibration.noise_stddev_m:.3f} m about the curve",
        "",
        align_rows([("distance m", "error m", "stddev m", "noise m"), *rows], num_left=0),
        "",
        "anchors beyond the curve: "
        + ", ".join(f"{anchor_id} {bias:+.3f} m" for anchor_id, bias in calibration.anchor_bias_m.items()),
    ]

"""The commands about a radio log alone: ``ranges``, ``ranges calibrate`` and ``trilaterate``."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from rangesfm.cli.arguments import Commands, Outcome
from rangesfm.cli.help_pages import Parser
from rangesfm.cli.survey_flags import add_flags, position, survey_from_arguments
from rangesfm.errors import GeometryError, InputError
from rangesfm.progress import Progress
from rangesfm.util.files.clock_times import span_text

if TYPE_CHECKING:
    from rangesfm.arrays import Array
    from rangesfm.measurements.ranges.anchors.anchor import Anchor
    from rangesfm.measurements.ranges.anchors.trilateration import AnchorPlacement
    from rangesfm.measurements.ranges.errors.radio_calibration import RadioCalibration
    from rangesfm.measurements.ranges.range_log import RangeLog
    from rangesfm.measurements.ranges.range_summary import LinkSummary, RangeSummary
    from rangesfm.option_model import Bounds

_Value = TypeVar("_Value")

_LOG_KEYS = (
    *("ranges.format", "ranges.columns", "ranges.timestamp_unit", "ranges.range_unit", "ranges.separator"),
    *("ranges.ranging_interval_s", "ranges.stamp_unit", "ranges.stamp_bits", "ranges.propagation_speed"),
    "ranges.t_off_s",
)
_ANCHOR_FILE_KEYS = ("anchors.columns", "anchors.unit")
_LENGTHS = ("number", "min m", "median m", "max m")
_TOWARD = {
    "above": (0.0, 0.0, 1.0),
    "below": (0.0, 0.0, -1.0),
    "x+": (1.0, 0.0, 0.0),
    "x-": (-1.0, 0.0, 0.0),
    "y+": (0.0, 1.0, 0.0),
    "y-": (0.0, -1.0, 0.0),
    "z+": (0.0, 0.0, 1.0),
    "z-": (0.0, 0.0, -1.0),
}


def add_ranges_commands(commands: Commands) -> None:
    ranges = commands.add("ranges", _ranges, "print what is in a radio log, and write it as canonical CSV")
    _add_log_arguments(ranges)
    ranges.add_argument("--anchors", metavar="CSV", help="file of anchors, by which ranges between anchors are known")
    add_flags(ranges, *_ANCHOR_FILE_KEYS)
    ranges.add_argument("--output_path", metavar="CSV", help="write the ranges to this file")
    ranges.add_argument("--plot", metavar="FILE", help="draw the ranges over time into this file (PNG or SVG)")
    calibrate = commands.add(
        "ranges calibrate", _calibrate, "learn the error curve of a radio from a log with known tag positions"
    )
    _add_log_arguments(calibrate)
    calibrate.add_argument("--anchors", required=True, metavar="CSV", help="surveyed anchors: anchor_id,x_m,y_m,z_m")
    add_flags(calibrate, *_ANCHOR_FILE_KEYS)
    calibrate.later.append(partial(_add_position_arguments, max_interpolation_gap_s=0.2))
    calibrate.add_argument("--output_path", required=True, metavar="CSV", help="write the curve to this file")
    calibrate.add_argument(
        "--plot", metavar="FILE", help="draw the curve and the errors of the ranges into this file (PNG or SVG)"
    )
    trilaterate = commands.add("trilaterate", _trilaterate, "find anchor positions from ranges at known tag positions")
    _add_log_arguments(trilaterate)
    trilaterate.later += [partial(_add_position_arguments, max_interpolation_gap_s=0.5), _add_estimate_arguments]
    trilaterate.add_argument(
        "--output_path", metavar="CSV", help="write the anchors to this file, for --anchors of other commands"
    )


def _add_log_arguments(parser: Parser) -> None:
    """Add the arguments that name a log and its format."""
    parser.add_argument(
        "log",
        nargs="+",
        metavar="LOG",
        help="the radio's log: a file, or a folder or several files, one for each anchor",
    )
    add_flags(parser, *_LOG_KEYS, by_own_names=True)


def _add_position_arguments(parser: Parser, *, max_interpolation_gap_s: float) -> None:
    """Add the arguments about the known positions of the tag and how they belong to the log."""
    from rangesfm.options import DURATION_S, TIME_S

    parser.add_argument(
        "--positions",
        required=True,
        metavar="FILE",
        help="known positions of the tag in the frame of the anchors: CSV timestamp_s (or image_name, where the log "
        "names photos),x_m,y_m,z_m[,qx,qy,qz,qw], or a TUM trajectory",
    )
    parser.add_argument(
        "--tag_in_cam",
        type=_lever_arm,
        default=(0.0, 0.0, 0.0),
        metavar="X,Y,Z",
        help="position of the tag's antenna in the frame whose poses are given, metres (default: 0,0,0)",
    )
    whose = "the tag whose positions these are, if the log has several"
    parser.add_argument("--tag_id", default="", metavar="ID", help=whose)
    parser.add_argument(
        "--time_offset",
        type=_number_within(TIME_S),
        default=0.0,
        metavar="SECONDS",
        help="time of positions minus time of ranges",
    )
    parser.add_argument(
        "--max_interpolation_gap_s",
        type=_number_within(DURATION_S),
        default=max_interpolation_gap_s,
        metavar="S",
        help="longest time between known positions between which positions are interpolated "
        f"(default: {max_interpolation_gap_s:g})",
    )


def _add_estimate_arguments(parser: Parser) -> None:
    from rangesfm.options import BIAS_M, STDDEV_M, STDDEV_OR_EXACT_M

    parser.add_argument(
        "--side",
        type=_side,
        default={},
        metavar="WORD|ID=WORD,..",
        help=f"which of two possible places is right: {', '.join(_TOWARD)}; for all anchors or for each",
    )
    parser.add_argument(
        "--height",
        type=_heights,
        default={},
        metavar="M|ID=M,..",
        help="known z of all anchors or of each; with it, the positions may be in a level plane",
    )
    add = parser.add_argument_group("estimate").add_argument
    stddev, stddev_or_exact = _number_within(STDDEV_M), _number_within(STDDEV_OR_EXACT_M)
    add("--range_stddev_m", type=stddev, metavar="M", help="standard deviation of a range (default: estimated)")
    too_long = "bias of the ranges, positive if they are too long"
    add("--range_bias_m", type=_number_within(BIAS_M), default=0.0, metavar="M", help=too_long)
    uncertain = "standard deviation of the bias; 0 fixes it (default: 0.25)"
    add("--range_bias_stddev_m", type=stddev_or_exact, default=0.25, metavar="M", help=uncertain)
    refused = "largest accepted standard deviation of an anchor's position in any direction (default: 1)"
    add("--max_position_stddev_m", type=stddev, default=1.0, metavar="M", help=refused)


def _by_anchor(text: str) -> dict[str, str]:
    """Return the words of a flag by anchor id; the empty id has the word for all other anchors."""
    return {anchor_id: word for anchor_id, _, word in (part.strip().rpartition("=") for part in text.split(","))}


def _side(text: str) -> dict[str, Sequence[float]]:
    sides = _by_anchor(text)
    for word in sides.values():
        if word not in _TOWARD:
            raise argparse.ArgumentTypeError(f"'{word}' is not a side, expected one of {', '.join(_TOWARD)}")
    return {anchor_id: _TOWARD[word] for anchor_id, word in sides.items()}


def _heights(text: str) -> dict[str, float]:
    from rangesfm.options import COORDINATE_M

    within = _number_within(COORDINATE_M)
    return {anchor_id: within(word) for anchor_id, word in _by_anchor(text).items()}


def _lever_arm(text: str) -> list[float]:
    from rangesfm.options import LEVER_ARM_M

    numbers = position(text)
    if not all(map(LEVER_ARM_M.hold, numbers)):
        raise argparse.ArgumentTypeError(f"'{text}' is not three times {LEVER_ARM_M}")
    return numbers


def _number_within(bounds: Bounds) -> Callable[[str], float]:
    """Return a type of argparse for numbers within bounds."""

    def number(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not bounds.hold(value):
            raise argparse.ArgumentTypeError(f"'{text}' is not {bounds}")
        return value

    return number


def _require_apart(args: argparse.Namespace, *inputs: str | Path | None) -> None:
    """Check that the command writes to no file that it reads.

    Raises:
        InputError: it would overwrite the log or another input.
    """
    from rangesfm.util.files.atomic import require_apart

    read = [Path(path) for path in (*args.log, *inputs) if path is not None]
    for output in (args.output_path, getattr(args, "plot", None)):
        if output is not None:
            require_apart(read, Path(output))


def _read_log(args: argparse.Namespace, anchor_ids: Sequence[str] = ()) -> RangeLog:
    """Read the log that the arguments name; ``anchor_ids`` as in ``read_ranges``."""
    from rangesfm.survey.inputs import read_log

    return read_log(survey_from_arguments(args).ranges.changed(path=Path(args.log[0])), anchor_ids, files=args.log)


def _read_anchors(args: argparse.Namespace) -> tuple[Anchor, ...]:
    """Read the anchor file that the arguments name."""
    from rangesfm.measurements.ranges.anchors.anchor_file import read_anchors

    options = survey_from_arguments(args).anchors
    return read_anchors(args.anchors, columns=options.columns, unit=options.unit)


def _read_placed_log(args: argparse.Namespace) -> tuple[RangeLog, Array]:
    """Read the n ranges of one tag, and return them with the position of the tag at each, (n, 3); NaN if unknown."""
    from rangesfm.measurements.positions.true_positions import read_true_positions
    from rangesfm.measurements.ranges.known_path import tag_positions
    from rangesfm.survey.inputs import of_one_tag

    log, known = of_one_tag(_read_log(args), args.tag_id), read_true_positions(args.positions)
    offset_s, max_gap_s = args.time_offset, args.max_interpolation_gap_s
    return log, tag_positions(log, known, args.tag_in_cam, time_offset_s=offset_s, max_gap_s=max_gap_s)


def _ranges(args: argparse.Namespace, progress: Progress) -> Outcome:
    r"""Print what is in a radio log, and write it as canonical CSV. The noise is the scatter of ranges about a smooth
    curve through their neighbours in time.

    example:
      rangesfm ranges log.csv --columns timestamp=t,anchor_id=node,range=d \
        --timestamp_unit ms --output_path ranges.csv
    """
    from rangesfm.measurements.ranges.range_summary import summarize_ranges
    from rangesfm.measurements.ranges.readers import read_anchors_in_log, write_ranges_csv

    _require_apart(args, args.anchors)
    anchors = _read_anchors(args) if args.anchors is not None else ()
    log = _read_log(args, [anchor.anchor_id for anchor in anchors])
    lines = _summary(summarize_ranges(log), _notes_of(log))
    in_log = read_anchors_in_log(args.log, format=log.format)
    if known := [(anchor.anchor_id, anchor.position_m) for anchor in in_log if anchor.position_m is not None]:
        lines += ["", "positions of anchors in the log (x, y, z in metres):"]
        lines += [f"  {anchor_id}  " + "  ".join(f"{value:.3f}" for value in place) for anchor_id, place in known]
    if args.output_path is not None:
        write_ranges_csv(log, args.output_path)
        lines += ["", f"written to {args.output_path}"]
    if args.plot is not None:
        from rangesfm.report.chart import write_picture
        from rangesfm.report.figures_ranges import plot_ranges

        write_picture(plot_ranges(log), Path(args.plot))
        lines += ["", f"drawn in {args.plot}"]
    return Outcome(lines)


def _notes_of(log: RangeLog) -> list[str]:
    """Return lines that say what was assumed when the log was read, and what is odd about its times."""
    return [f"note    {note}" for note in (*log.notes, *log.notes_on_clock())]


def _summary(summary: RangeSummary, of_reading: Sequence[str]) -> list[str]:
    from rangesfm.util.files.text_tables import align_rows

    step_m = summary.quantization_m
    between = {"anchor": 0, "tag": 0}
    for pair in summary.pairs:
        between[pair.kind.split("-")[0]] += pair.num
    notes = {
        f"{summary.num_duplicates} ranges are in the log twice": summary.num_duplicates,
        f"{summary.num_out_of_order} ranges are earlier than the one before them": summary.num_out_of_order,
        **{f"{num} ranges are between two {end}s": num for end, num in between.items()},
        f"all ranges are multiples of {step_m} m: rounded": step_m,
    }
    # The noise is known only where an anchor has enough ranges.
    has_noise = any(math.isfinite(anchor.noise_stddev_m) for anchor in summary.anchors)
    rows = [["anchor", *_LENGTHS, *(["noise m"] if has_noise else []), "largest gap s"]]
    for anchor in summary.anchors:
        noise = [_number(anchor.noise_stddev_m)] if has_noise else []
        rows.append([*anchor.ids, *_lengths(anchor), *noise, _number(anchor.largest_gap_s)])
    pairs = [[pair.kind, " - ".join(pair.ids), *_lengths(pair)] for pair in summary.pairs]
    return [
        f"format  {summary.format}",
        f"ranges  {summary.num}, and {summary.num_no_measurement} records without a measurement",
        f"tags    {', '.join(summary.tag_ids)}",
        f"time    {_time(summary)}",
        *of_reading,
        *(f"note    {note}" for note, applies in notes.items() if applies),
        "",
        align_rows(rows),
        *(["", align_rows([["between", "", *_LENGTHS], *pairs], num_left=2)] if pairs else []),
    ]


def _time(summary: RangeSummary) -> str:
    if math.isnan(summary.start_s):
        return "by photo name"
    span = f"{span_text(summary.start_s, summary.end_s)}, {summary.end_s - summary.start_s:.3f} s long"
    rate = f", {summary.rate_hz:.1f} ranges a second" if math.isfinite(summary.rate_hz) else ""
    return span + rate + f", largest gap {_number(summary.largest_gap_s)} s"


def _lengths(ranges: LinkSummary) -> list[str]:
    return [str(ranges.num), *map(_number, (ranges.min_m, ranges.median_m, ranges.max_m))]


def _number(value: float) -> str:
    return "-" if math.isnan(value) else f"{value:.3f}"


def _calibrate(args: argparse.Namespace, progress: Progress) -> Outcome:
    r"""Learn how much too long or too short a radio measures at each distance, from a log with known tag positions (by
    total station or motion capture) and surveyed anchors. The commands run, batch, init, check, scale, refine and
    compare take the file that this writes as --error_curve; in a survey file it is error_curve in [ranges].

    example:
      rangesfm ranges calibrate log.csv --anchors anchors.csv \
        --positions truth.csv --output_path curve.csv
    """
    from rangesfm.measurements.ranges.errors.error_curve import write_error_curve
    from rangesfm.measurements.ranges.errors.radio_calibration import calibrate_ranges

    _require_apart(args, args.anchors, args.positions)
    anchors = _read_anchors(args)
    log, tags_m = _read_placed_log(args)
    calibration = calibrate_ranges(log, tags_m, anchors)
    lines = [*_notes_of(log), *_calibrated(calibration, len(log)), "", f"written to {args.output_path}"]
    if args.plot is not None:
        from rangesfm.report.chart import write_picture
        from rangesfm.report.figures_ranges import plot_error_curve

        write_picture(
            plot_error_curve(
                calibration.curve, calibration.distance_m, calibration.error_m, calibration.noise_stddev_m
            ),
            Path(args.plot),
        )
        lines.append(f"drawn in {args.plot}")
    write_error_curve(calibration.curve, Path(args.output_path))
    return Outcome(lines)


def _calibrated(calibration: RadioCalibration, num_in_log: int) -> list[str]:
    from rangesfm.util.files.text_tables import align_rows

    curve, share = calibration.curve, f"{100 * calibration.outlier_share:.1f} % do not fit"
    columns = (curve.distance_m, curve.error_m, curve.stddev_m, curve.noise_stddev_m)
    rows = [
        (f"{at:.2f}", f"{error:+.3f}", f"{stddev:.3f}", f"{noise:.3f}") for at, error, stddev, noise in zip(*columns)
    ]
    biases = ", ".join(f"{anchor_id} {bias:+.3f} m" for anchor_id, bias in calibration.anchor_bias_m.items())
    return [
        f"ranges  {calibration.num_ranges} of {num_in_log} have a known length, {share}",
        f"noise   {calibration.noise_stddev_m:.3f} m about the curve",
        "",
        align_rows([("distance m", "error m", "stddev m", "noise m"), *rows], num_left=0),
        "",
        f"anchors beyond the curve: {biases}",
    ]


def _trilaterate(args: argparse.Namespace, progress: Progress) -> Outcome:
    r"""Estimate the positions of anchors robustly, from ranges taken at known positions of the tag. If these positions
    are in a plane, an anchor has two possible places, one on each side of the plane; --side says which one is right.
    If --height gives the height of an anchor, only x and y are estimated, and positions in a level plane are enough.

    example:
      rangesfm trilaterate uwb.csv --positions total_station.csv --side above \
        --output_path anchors.csv
      rangesfm run survey.toml --anchors anchors.csv --anchor_frame site
    """
    from rangesfm.measurements.ranges.anchors.anchor_file import write_anchors
    from rangesfm.measurements.ranges.anchors.trilateration import TrilaterationOptions, trilaterate_anchors

    _require_apart(args, args.positions)
    log, tags_m = _read_placed_log(args)
    options = TrilaterationOptions(
        range_stddev_m=args.range_stddev_m,
        range_bias_m=args.range_bias_m,
        range_bias_stddev_m=args.range_bias_stddev_m,
        max_position_stddev_m=args.max_position_stddev_m,
    )
    placements = trilaterate_anchors(
        log,
        tags_m,
        toward=_of_anchors("--side", args.side, log),
        height_m=_of_anchors("--height", args.height, log),
        options=options,
    )
    if all(placement.found is None for placement in placements):
        raise GeometryError(f"anchor {placements[0].anchor_id}: {placements[0].why_not}")
    lines = [*_notes_of(log), *_placed(log, placements)]
    if args.output_path is not None:
        write_anchors([placement.anchor for placement in placements], args.output_path)
        lines += ["", f"written to {args.output_path}"]
    return Outcome(lines)


def _of_anchors(flag: str, given: dict[str, _Value], log: RangeLog) -> dict[str, _Value]:
    """Return what a flag gives for each anchor of the log: its own value, or that of the empty id.

    Raises:
        InputError: the flag names an anchor that is not in the log.
    """
    for anchor_id in given:
        if anchor_id and anchor_id not in log.anchor_ids:
            raise InputError(f"{flag}: anchor '{anchor_id}' is not in the log ({', '.join(log.anchor_ids)})")
    names = {anchor_id: anchor_id if anchor_id in given else "" for anchor_id in log.anchor_ids}
    return {anchor_id: given[name] for anchor_id, name in names.items() if name in given}


def _placed(log: RangeLog, placements: Sequence[AnchorPlacement]) -> list[str]:
    from rangesfm.util.files.text_tables import align_rows

    rows: list[Sequence[str]] = [("anchor", "ranges", "fit", "x m", "y m", "z m", "stddev m", "bias m", "noise m")]
    notes = [""]
    for placement in placements:
        found, name = placement.found, (placement.anchor_id, str(placement.num_ranges))
        if found is None:
            rows.append((*name, *("",) * 7))
            notes.append(f"  {placement.why_not}")
            continue
        share = f"{100 * (found.weights > 0.5).mean():.0f} %"
        stddevs = (found.position_stddev_m, found.range_bias_m, found.noise_stddev_m)
        rows.append((*name, share, *map(_number, (*found.position_m, *stddevs))))
        notes.append("")
        if found.mirror_position_m is not None:
            rows.append(("", "", "or", *map(_number, found.mirror_position_m), "", "", ""))
            notes.append("  (on the other side of the tag's positions; choose with --side)")
    num_known = sum(placement.num_ranges for placement in placements)
    return [
        f"{num_known} of {len(log)} ranges are at known positions of the tag",
        "",
        *(line + note for line, note in zip(align_rows(rows).split("\n"), notes, strict=True)),
    ]

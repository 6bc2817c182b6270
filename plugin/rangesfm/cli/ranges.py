"""``rangesfm ranges``: what is in a radio log, and the log as canonical CSV."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from rangesfm.cli.arguments import Commands, Outcome
from rangesfm.cli.log_arguments import add_log_arguments, notes_of_log, read_log
from rangesfm.files.text_table import align_rows
from rangesfm.progress import Progress

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rangesfm.ranging.anchors.anchor import Anchor
    from rangesfm.ranging.summary import AnchorSummary, PairSummary, RangeSummary

_LENGTHS = ("number", "min m", "median m", "max m")


def add_command(commands: Commands) -> None:
    parser = commands.add(
        "ranges",
        execute,
        help="what is in a radio log; writes it as canonical CSV",
        description=(
            "Print what is in a radio log, and write it as canonical CSV. The noise is how far ranges are off a "
            "smooth curve through their neighbours."
        ),
        example=(
            "rangesfm ranges log.csv --columns timestamp=t,anchor_id=node,range=d --timestamp_unit ms \\\n"
            "    --output_path ranges.csv"
        ),
    )
    add_log_arguments(parser)
    parser.add_argument("--anchors", metavar="CSV", help="who is an anchor, to tell ranges between two of them")
    parser.add_argument("--output_path", metavar="CSV", help="write the ranges there")
    parser.add_argument("--plot", metavar="FILE", help="draw the ranges over time there (PNG or SVG)")


def execute(args: argparse.Namespace, progress: Progress) -> Outcome:
    from rangesfm.ranging.anchors.anchor_file import read_anchors
    from rangesfm.ranging.readers import read_anchors_in_log, write_ranges_csv
    from rangesfm.ranging.summary import summarize_ranges

    anchors = read_anchors(args.anchors) if args.anchors is not None else ()
    log = read_log(args, [anchor.anchor_id for anchor in anchors])
    lines = [
        *_lines(summarize_ranges(log), notes_of_log(log)),
        *_anchors(read_anchors_in_log(args.log, format=log.format)),
    ]
    if args.output_path is not None:
        write_ranges_csv(log, args.output_path)
        lines += ["", f"written to {args.output_path}"]
    if args.plot is not None:
        from rangesfm.report.pictures import write_picture
        from rangesfm.report.range_plots import plot_ranges

        write_picture(plot_ranges(log), Path(args.plot))
        lines += ["", f"drawn in {args.plot}"]
    return Outcome(lines)


def _lines(summary: RangeSummary, of_reading: Sequence[str]) -> list[str]:
    return [
        f"format  {summary.format}",
        f"ranges  {summary.num}, and {summary.num_no_measurement} records without a measurement",
        f"tags    {', '.join(summary.tag_ids)}",
        f"time    {_time(summary)}",
        *of_reading,
        *(f"note    {note}" for note in _notes(summary)),
        "",
        _table(summary),
        *_pairs(summary),
    ]


def _notes(summary: RangeSummary) -> list[str]:
    step_m = summary.quantization_m
    notes = {
        f"{summary.num_duplicates} ranges stand in the log twice": summary.num_duplicates,
        f"{summary.num_out_of_order} ranges are earlier than the one before them": summary.num_out_of_order,
        f"{summary.num_between_anchors} ranges are between two anchors": summary.num_between_anchors,
        f"{summary.num_between_tags} ranges are between two tags": summary.num_between_tags,
        f"all ranges are multiples of {step_m} m: rounded": step_m,
    }
    return [note for note, applies in notes.items() if applies]


def _anchors(anchors: Sequence[Anchor]) -> list[str]:
    known = [(anchor.anchor_id, anchor.position_m) for anchor in anchors if anchor.position_m is not None]
    if not known:
        return []
    return [
        "",
        "the log tells where anchors stand (x, y, z in metres):",
        *(f"  {anchor_id}  " + "  ".join(f"{value:.3f}" for value in position) for anchor_id, position in known),
    ]


def _time(summary: RangeSummary) -> str:
    if summary.start_s is None or summary.end_s is None:
        return "by photo name"
    span = f"{summary.start_s:.3f} to {summary.end_s:.3f} s, {summary.end_s - summary.start_s:.3f} s long"
    rate = f", {summary.rate_hz:.1f} ranges a second" if summary.rate_hz is not None else ""
    return span + rate + f", largest gap {_number(summary.largest_gap_s)} s"


def _table(summary: RangeSummary) -> str:
    """One row an anchor; the noise only where there are enough ranges to tell it."""
    has_noise = any(anchor.noise_stddev_m is not None for anchor in summary.anchors)
    header = ["anchor", *_LENGTHS, *(["noise m"] if has_noise else []), "largest gap s"]
    rows = [
        [
            anchor.anchor_id,
            *_lengths(anchor),
            *([_number(anchor.noise_stddev_m)] if has_noise else []),
            _number(anchor.largest_gap_s),
        ]
        for anchor in summary.anchors
    ]
    return align_rows([header, *rows])


def _pairs(summary: RangeSummary) -> list[str]:
    """One row for each two of a kind that ranged with each other."""
    if not summary.pairs:
        return []
    rows = [[pair.kind, " - ".join(pair.ids), *_lengths(pair)] for pair in summary.pairs]
    return ["", align_rows([["between", "", *_LENGTHS], *rows], num_left=2)]


def _lengths(ranges: AnchorSummary | PairSummary) -> list[str]:
    return [str(ranges.num), *map(_number, (ranges.min_m, ranges.median_m, ranges.max_m))]


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"

"""``rangesfm ranges``: what is in a radio log, and the log as canonical CSV."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from rangesfm.cli.arguments import Commands, Outcome
from rangesfm.progress import Progress

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rangesfm.ranging.anchors import Anchor
    from rangesfm.ranging.summary import RangeSummary
    from rangesfm.ranging.twr import StampOptions

_STAMP_UNITS = ("ns", "us", "ms", "s", "ticks")


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
    parser.add_argument("log", metavar="LOG", help="the radio's log")
    parser.add_argument("--format", metavar="FORMAT", help="its format (default: recognised by content)")
    parser.add_argument(
        "--columns",
        type=_columns,
        metavar="QUANTITY=NAME,..",
        help="names of its columns for timestamp (or image_name), anchor_id, range, tag_id, range_stddev, los; "
        "without range, the time stamps tx1, rx1, tx2, rx2 and possibly tx3, rx3 of two-way ranging",
    )
    parser.add_argument("--timestamp_unit", metavar="UNIT", help="s, ms, us, ns or iso (default: by format)")
    parser.add_argument("--range_unit", metavar="UNIT", help="m, cm or mm (default: by format)")
    parser.add_argument("--separator", metavar="CHARACTER", help="between cells (default: told from the header row)")
    parser.add_argument(
        "--ranging_interval_s",
        type=float,
        metavar="S",
        help="between two rounds, for a Qorvo log without the host's times (default: 0.2)",
    )
    _add_stamp_options(parser)
    parser.add_argument("--output_path", metavar="CSV", help="write the ranges there")
    parser.add_argument("--plot", metavar="PNG", help="draw the ranges over time there")


def _add_stamp_options(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("time stamps, in a log without ranges")
    group.add_argument("--stamp_unit", choices=_STAMP_UNITS, default="ns", help="(default: ns)")
    group.add_argument(
        "--stamp_bits", type=int, choices=(32, 40), default=32, help="of a DW1000's counter (default: 32, up to 67 ms)"
    )
    group.add_argument(
        "--propagation_speed", type=_speed, default="air", metavar="SPEED", help="air (default), vacuum or m/s"
    )
    group.add_argument(
        "--t_off_s", type=float, default=0.0, metavar="S", help="what all delays together add to a round trip"
    )


def execute(args: argparse.Namespace, progress: Progress) -> Outcome:
    from rangesfm.ranging.readers import read_anchors_in_log, read_ranges, write_ranges_csv
    from rangesfm.ranging.summary import summarize_ranges

    log = read_ranges(
        args.log,
        format=args.format,
        columns=args.columns,
        timestamp_unit=args.timestamp_unit,
        range_unit=args.range_unit,
        separator=args.separator,
        ranging_interval_s=args.ranging_interval_s,
        stamps=_stamp_options(args),
    )
    lines = [*_lines(summarize_ranges(log)), *_anchors(read_anchors_in_log(args.log, format=log.format))]
    if args.output_path is not None:
        write_ranges_csv(log, args.output_path)
        lines += ["", f"written to {args.output_path}"]
    if args.plot is not None:
        from rangesfm.ranging.plot import plot_ranges, write_figure

        write_figure(plot_ranges(log), args.plot)
        lines += ["", f"drawn in {args.plot}"]
    return Outcome(lines)


def _columns(text: str) -> dict[str, str]:
    pairs = [pair.partition("=") for pair in text.split(",")]
    if not all(quantity and name for quantity, _, name in pairs):
        raise argparse.ArgumentTypeError(f"'{text}' is not a mapping, expected as timestamp=t,anchor_id=node,range=d")
    return {quantity.strip(): name.strip() for quantity, _, name in pairs}


def _stamp_options(args: argparse.Namespace) -> StampOptions:
    from rangesfm.ranging.readers.time_units import SECONDS_PER_UNIT
    from rangesfm.ranging.twr import DW1000_TICK_S, StampOptions

    return StampOptions(
        unit_s={**SECONDS_PER_UNIT, "ticks": DW1000_TICK_S}[args.stamp_unit],
        wrap_s=2**args.stamp_bits * DW1000_TICK_S,
        propagation_speed_m_per_s=args.propagation_speed,
        t_off_s=args.t_off_s,
    )


def _speed(text: str) -> float:
    from rangesfm.ranging.twr import AIR_M_PER_S, VACUUM_M_PER_S

    try:
        speed = {"air": AIR_M_PER_S, "vacuum": VACUUM_M_PER_S}.get(text) or float(text)
    except ValueError:
        speed = 0.0
    if not 1e8 < speed < 3e8:
        raise argparse.ArgumentTypeError(f"'{text}' is no speed of light, expected air, vacuum or one in m/s")
    return speed


def _lines(summary: RangeSummary) -> list[str]:
    return [
        f"format  {summary.format}",
        f"ranges  {summary.num}, and {summary.num_no_measurement} records without a measurement",
        f"tags    {', '.join(summary.tag_ids)}",
        f"time    {_time(summary)}",
        *(f"note    {note}" for note in _notes(summary)),
        "",
        *_table(summary),
    ]


def _notes(summary: RangeSummary) -> list[str]:
    step_m = summary.quantization_m
    notes = {
        f"{summary.num_duplicates} ranges stand in the log twice": summary.num_duplicates,
        f"{summary.num_out_of_order} ranges are earlier than the one before them": summary.num_out_of_order,
        f"{summary.num_between_anchors} ranges are between two anchors": summary.num_between_anchors,
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


def _table(summary: RangeSummary) -> list[str]:
    """One row an anchor; the noise only where there are enough ranges to tell it."""
    width = max(len("anchor"), *(len(anchor.anchor_id) for anchor in summary.anchors))
    has_noise = any(anchor.noise_stddev_m is not None for anchor in summary.anchors)
    return [
        f"{'anchor':{width}}  {'number':>8}  {'min m':>9}  {'median m':>9}  {'max m':>9}"
        f"{'  noise m' if has_noise else ''}  {'largest gap s':>13}",
        *(
            f"{anchor.anchor_id:{width}}  {anchor.num:8}  {anchor.min_m:9.3f}  {anchor.median_m:9.3f}"
            f"  {anchor.max_m:9.3f}{f'  {_number(anchor.noise_stddev_m):>7}' if has_noise else ''}"
            f"  {_number(anchor.largest_gap_s):>13}"
            for anchor in summary.anchors
        ),
    ]


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"

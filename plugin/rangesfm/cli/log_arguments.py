"""Arguments that say how a radio's log is read, shared by the commands that take one alone."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rangesfm.ranging.log import RangeLog
    from rangesfm.ranging.twr import StampOptions

_STAMP_UNITS = ("ns", "us", "ms", "s", "ticks")


def add_log_arguments(parser: argparse.ArgumentParser) -> None:
    """The log and how it is written."""
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


def read_log(args: argparse.Namespace, anchor_ids: Sequence[str] = ()) -> RangeLog:
    """The log that the arguments name; ``anchor_ids`` as for ``read_ranges``."""
    from rangesfm.ranging.readers import read_ranges

    return read_ranges(
        args.log,
        format=args.format,
        columns=args.columns,
        timestamp_unit=args.timestamp_unit,
        range_unit=args.range_unit,
        separator=args.separator,
        ranging_interval_s=args.ranging_interval_s,
        stamps=_stamp_options(args),
        anchor_ids=anchor_ids,
    )


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

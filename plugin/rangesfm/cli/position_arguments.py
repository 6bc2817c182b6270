"""Arguments that say where the tag was while the radio's log was taken."""

from __future__ import annotations

import argparse
import math
from typing import TYPE_CHECKING

from rangesfm.cli.survey_flags import position

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from rangesfm.ranging.log import RangeLog

# As of the times in a survey file.
_MAX_TIME_S = 1e10


def add_position_arguments(parser: argparse.ArgumentParser, *, max_interpolation_gap_s: float) -> None:
    """The file of known positions and how it belongs to the log; ``max_interpolation_gap_s`` is the default."""
    parser.add_argument(
        "--positions",
        required=True,
        metavar="FILE",
        help="where the tag was, in the anchors' frame: CSV timestamp_s (or image_name, with ranges by name),"
        "x_m,y_m,z_m[,qx,qy,qz,qw], or a TUM trajectory",
    )
    parser.add_argument(
        "--tag_in_cam",
        type=position,
        default=(0.0, 0.0, 0.0),
        metavar="X,Y,Z",
        help="the antenna in the frame whose poses are given, metres (default: they are the antenna's)",
    )
    parser.add_argument("--tag_id", metavar="ID", help="the tag whose positions these are, if the log has several")
    parser.add_argument(
        "--time_offset", type=_seconds, default=0.0, metavar="SECONDS", help="time of positions minus time of ranges"
    )
    parser.add_argument(
        "--max_interpolation_gap_s",
        type=_seconds,
        default=max_interpolation_gap_s,
        metavar="S",
        help=f"between known positions further apart none is interpolated (default: {max_interpolation_gap_s:g})",
    )


def read_tag_positions(args: argparse.Namespace, log: RangeLog) -> npt.NDArray[np.float64]:
    """(n, 3) where the tag was at each range of ``log``, by the file that the arguments name; NaN: not known."""
    from rangesfm.geometry.reference import read_reference
    from rangesfm.ranging.tag_positions import tag_positions

    return tag_positions(
        log,
        read_reference(args.positions),
        args.tag_in_cam,
        time_offset_s=args.time_offset,
        max_gap_s=args.max_interpolation_gap_s,
    )


def _seconds(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not abs(value) <= _MAX_TIME_S:
        raise argparse.ArgumentTypeError(f"'{text}' is not a time in seconds, expected at most {_MAX_TIME_S:g} of them")
    return value

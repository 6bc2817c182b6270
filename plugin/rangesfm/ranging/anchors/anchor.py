"""Anchor: a static radio node with what is known of it, and the anchor file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rangesfm.arrays import Array
from rangesfm.errors import InputError
from rangesfm.files.text_tables import TextTable, read_table, repeated, write_user_table
from rangesfm.options import BIAS_M, COORDINATE_M, STDDEV_OR_EXACT_M

_COORDINATES = ("x_m", "y_m", "z_m")
_OPTIONAL = ("position_stddev_m", "range_bias_m", "range_bias_stddev_m")
ANCHOR_COLUMNS = ("anchor_id", *_COORDINATES)
ANCHOR_ALIASES = {"": "anchor_id", "id": "anchor_id", "Anchor_ID": "anchor_id", "x": "x_m", "y": "y_m", "z": "z_m"}


@dataclass(frozen=True)
class Anchor:
    """A static UWB node.

    Attributes:
        anchor_id: id in the log.
        position_m: (3,) antenna in the anchors' frame, metres; None if unknown.
        position_stddev_m: standard deviation of each coordinate; 0 means exact.
        range_bias_m: prior mean of the bias of its ranges, positive if they are too long (antenna delay).
        range_bias_stddev_m: prior standard deviation of that bias; None means the option's default.
    """

    anchor_id: str
    position_m: Array | None = None
    position_stddev_m: float = 0.0
    range_bias_m: float = 0.0
    range_bias_stddev_m: float | None = None


@dataclass(frozen=True)
class AnchorEstimate:
    """Estimate of an anchor in the metric frame of a result, with its prior.

    Attributes:
        anchor_id: id in the log.
        position_m: (3,) position; NaN for an unknown anchor with too few ranges.
        position_stddev_m: root of the mean variance of the three coordinates; 0 for an anchor that was held fixed.
        prior_position_m, prior_position_stddev_m: surveyed position in the same frame and the standard deviation of
            each coordinate; None and inf if unknown.
        range_bias_m: bias of its ranges, positive if they are too long.
        prior_bias_m, prior_bias_stddev_m: prior of the bias, without the part that all anchors share; a standard
            deviation of 0 fixes it.
        mirror_position_m: mirror image that fits as well; None if there is none.
        position_covariance_m2: (3, 3) covariance by the ranges alone, before any refinement; None if unknown.
    """

    anchor_id: str
    position_m: Array
    position_stddev_m: float
    prior_position_m: Array | None
    prior_position_stddev_m: float
    range_bias_m: float
    prior_bias_m: float
    prior_bias_stddev_m: float
    mirror_position_m: Array | None = None
    position_covariance_m2: Array | None = None


def read_anchors(path: str | Path) -> tuple[Anchor, ...]:
    """Read ``anchor_id,x_m,y_m,z_m[,position_stddev_m,range_bias_m,range_bias_stddev_m]``.

    Coordinates are empty for an anchor of unknown position. The optional cells may be empty as well. Columns named
    x, y, z and an unnamed column of ids are understood.

    Raises:
        InputError: an anchor appears twice, a position is incomplete, or a cell is not a number. The error gives the
            line.
    """
    table = read_table(path, ANCHOR_COLUMNS, _OPTIONAL, aliases=ANCHOR_ALIASES, separator=None)
    if not len(table):
        raise InputError("names no anchor, expected one per line", path)
    anchor_ids = table.text("anchor_id")
    if again := repeated(anchor_ids):
        row, first = again
        message = f"anchor {anchor_ids[row]} is in line {table.line[first]} already, expected each once"
        raise InputError(message, path, int(table.line[row]))
    positions = _positions(table)
    position_stddevs = table.numbers("position_stddev_m", empty=0.0, bounds=STDDEV_OR_EXACT_M)
    biases = table.numbers("range_bias_m", empty=0.0, bounds=BIAS_M)
    bias_stddevs = table.numbers("range_bias_stddev_m", empty=np.nan, bounds=STDDEV_OR_EXACT_M)
    return tuple(
        Anchor(
            anchor_id=anchor_id,
            position_m=None if np.isnan(positions[row, 0]) else positions[row],
            position_stddev_m=float(position_stddevs[row]),
            range_bias_m=float(biases[row]),
            range_bias_stddev_m=None if np.isnan(bias_stddevs[row]) else float(bias_stddevs[row]),
        )
        for row, anchor_id in enumerate(anchor_ids)
    )


def write_anchors(anchors: Sequence[Anchor], path: str | Path) -> None:
    """Write an anchor file that ``read_anchors`` reads, with empty cells for unknown values.

    Raises:
        InputError: the file cannot be written.
    """
    rows = []
    for anchor in anchors:
        place = 4 * [None] if anchor.position_m is None else [*anchor.position_m, anchor.position_stddev_m]
        bias = 2 * [None] if anchor.range_bias_stddev_m is None else [anchor.range_bias_m, anchor.range_bias_stddev_m]
        rows.append([anchor.anchor_id, *("" if number is None else f"{number:.4f}" for number in (*place, *bias))])
    write_user_table(Path(path), [*ANCHOR_COLUMNS, *_OPTIONAL], rows)


def default_anchor_frame(anchors: Sequence[Anchor]) -> str:
    """Return the frame of anchors for which the user gave none: "site" if any position is known, else "unknown"."""
    return "site" if any(anchor.position_m is not None for anchor in anchors) else "unknown"


def _positions(table: TextTable) -> Array:
    """Return the positions (n, 3) in metres, with NaN for a row in which all three cells are empty."""
    positions = np.column_stack([table.numbers(name, empty=np.nan, bounds=COORDINATE_M) for name in _COORDINATES])
    unknown = np.isnan(positions)
    incomplete = unknown.any(axis=1) & ~unknown.all(axis=1)
    if np.any(incomplete):
        row = int(np.argmax(incomplete))
        column = _COORDINATES[int(np.argmax(unknown[row]))]
        raise table.error(row, column, "all three coordinates or none")
    return positions

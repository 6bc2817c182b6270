"""The anchors' file: who they are, where they stand and how far they read too long."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from rangesfm.arrays import Array
from rangesfm.errors import InputError
from rangesfm.files.tables import Table, read_table, repeated, write_user_table
from rangesfm.ranging.anchors.anchor import Anchor

_COORDINATES = ("x_m", "y_m", "z_m")
_OPTIONAL = ("position_stddev_m", "range_bias_m", "range_bias_stddev_m")
ANCHOR_COLUMNS = ("anchor_id", *_COORDINATES)
ANCHOR_ALIASES = {"": "anchor_id", "id": "anchor_id", "Anchor_ID": "anchor_id", "x": "x_m", "y": "y_m", "z": "z_m"}


def read_anchors(path: str | Path) -> tuple[Anchor, ...]:
    """Read ``anchor_id,x_m,y_m,z_m[,position_stddev_m,range_bias_m,range_bias_stddev_m]``.

    Empty coordinates are those of an anchor that nobody measured; the other cells may be empty as well.
    Columns named x, y, z and an unnamed column of ids are understood.

    Raises:
        InputError: with the line, for an anchor named twice, an incomplete position, or what is not a number.
    """
    table = read_table(path, ANCHOR_COLUMNS, _OPTIONAL, aliases=ANCHOR_ALIASES, separator=None)
    if not len(table):
        raise InputError("names no anchor, expected one a line", path)
    anchor_ids = table.text("anchor_id")
    if again := repeated(anchor_ids):
        row, first = again
        message = f"anchor {anchor_ids[row]} stands in line {table.line[first]} already, expected each once"
        raise InputError(message, path, int(table.line[row]))
    positions = _positions(table)
    expected = "a number of metres that is not negative, or nothing"
    position_stddevs = table.numbers("position_stddev_m", empty=0.0, expected=expected, least=0.0)
    biases = table.numbers("range_bias_m", empty=0.0)
    bias_stddevs = table.numbers("range_bias_stddev_m", empty=np.nan, expected=expected, least=0.0)
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
    """Write anchors so that ``read_anchors`` reads them, with empty cells for what is not known; or InputError."""
    rows = []
    for anchor in anchors:
        place = 4 * [None] if anchor.position_m is None else [*anchor.position_m, anchor.position_stddev_m]
        bias = 2 * [None] if anchor.range_bias_stddev_m is None else [anchor.range_bias_m, anchor.range_bias_stddev_m]
        rows.append([anchor.anchor_id, *("" if number is None else f"{number:.4f}" for number in (*place, *bias))])
    write_user_table(Path(path), [*ANCHOR_COLUMNS, *_OPTIONAL], rows)


def default_anchor_frame(anchors: Sequence[Anchor]) -> str:
    """The frame of anchors of which the user said none: "site" if any position is known, else "unknown"."""
    return "site" if any(anchor.position_m is not None for anchor in anchors) else "unknown"


def _positions(table: Table) -> Array:
    """(n, 3) metres, a row of NaN where all three cells are empty."""
    positions = np.column_stack(
        [table.numbers(name, empty=np.nan, expected="a number of metres") for name in _COORDINATES]
    )
    unknown = np.isnan(positions)
    incomplete = unknown.any(axis=1) & ~unknown.all(axis=1)
    if np.any(incomplete):
        row = int(np.argmax(incomplete))
        column = _COORDINATES[int(np.argmax(unknown[row]))]
        raise table.error(row, column, "all three coordinates or none")
    return positions

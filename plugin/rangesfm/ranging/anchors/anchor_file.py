"""The anchors' file: who they are, where they stand and how far they read too long."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from rangesfm.arrays import Array
from rangesfm.errors import InputError
from rangesfm.files.tables import Table, read_table, write_table
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
    _check_unique(table, anchor_ids)
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
    """Write anchors so that ``read_anchors`` reads them: empty coordinates where the position is unknown.

    Raises:
        InputError: the file cannot be written.
    """
    try:
        write_table(Path(path), [*ANCHOR_COLUMNS, *_OPTIONAL], map(_row, anchors))
    except OSError as error:
        raise InputError(f"cannot be written ({error.strerror})", path) from error


def _row(anchor: Anchor) -> list[str]:
    bias = ["", ""]
    if anchor.range_bias_stddev_m is not None:
        bias = [f"{anchor.range_bias_m:.4f}", f"{anchor.range_bias_stddev_m:.4f}"]
    if anchor.position_m is None:
        return [anchor.anchor_id, "", "", "", "", *bias]
    return [
        anchor.anchor_id,
        *(f"{coordinate:.4f}" for coordinate in anchor.position_m),
        f"{anchor.position_stddev_m:.4f}",
        *bias,
    ]


def default_anchor_frame(anchors: Sequence[Anchor]) -> str:
    """The frame of anchors of which the user said none: "site" if any position is known, else "unknown"."""
    return "site" if any(anchor.position_m is not None for anchor in anchors) else "unknown"


def _check_unique(table: Table, anchor_ids: list[str]) -> None:
    if len(set(anchor_ids)) == len(anchor_ids):
        return
    first_line: dict[str, int] = {}
    for anchor_id, line in zip(anchor_ids, table.line.tolist()):
        if first_line.setdefault(anchor_id, line) != line:
            message = f"anchor {anchor_id} stands in line {first_line[anchor_id]} already, expected each once"
            raise InputError(message, table.path, line)


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

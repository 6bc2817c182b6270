"""The offset of exported files whose origin is near the cameras, for who needs the coordinates of the site again."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from rangesfm.arrays import Array
from rangesfm.util.files.atomic import write_text

OFFSET_NAME = "offset.txt"
"""File with the offset, beside the files that it belongs to."""


def write_offset(offset_m: Array, names: Iterable[str], folder: Path) -> None:
    """Write what to add to the coordinates in some files: three numbers, metres, below a line that says so.

    Without an offset nothing is written, unless to correct the file of an earlier export.
    """
    path = folder / OFFSET_NAME
    if offset_m.any() or path.exists():
        numbers = " ".join(f"{x:.15g}" for x in offset_m.tolist())
        write_text(f"# metres to add to the coordinates in {', '.join(names)}\n{numbers}\n", path)


def offset_note(folder: Path) -> list[str]:
    """Return a line for the user on the offset of the files in a folder; none without one."""
    path = folder / OFFSET_NAME
    if not path.exists() or not (offset_m := np.loadtxt(path, ndmin=1)).any():
        return []
    told = path.read_text(encoding="utf-8").splitlines()[0].removeprefix("# metres to add to the coordinates in ")
    numbers = ", ".join(f"{x:.15g}" for x in offset_m.tolist())
    return [
        f"{told}: the origin is moved near the cameras, because programs with 32-bit numbers lose millimetres far from "
        f"it; add {numbers} m to their coordinates for those of the site ({path})"
    ]

"""Arrays and pictures in the form in which a page holds them."""

from __future__ import annotations

import base64

import numpy as np
import numpy.typing as npt


def pack(values: npt.ArrayLike, kind: str) -> dict[str, str]:
    """Return an array, row by row, as base64 in the form that the script of the page reads.

    Args:
        values: numbers of any shape.
        kind: "uint8", "int16", "uint16", "int32" or "float32".
    """
    with np.errstate(over="ignore"):  # an anchor that no range holds may be anywhere; what is too far is not drawn
        array = np.ascontiguousarray(values, dtype=np.dtype(kind).newbyteorder("<"))
    return {"type": kind, "data": base64.b64encode(array.tobytes()).decode("ascii")}

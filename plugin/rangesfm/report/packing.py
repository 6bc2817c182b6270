"""Arrays for the page's script."""

from __future__ import annotations

import base64

import numpy as np
import numpy.typing as npt


def pack(values: npt.ArrayLike, kind: str) -> dict[str, str]:
    """An array as the page's script reads it, row by row.

    Args:
        kind: "uint8", "uint16", "int32" or "float32".
    """
    array = np.ascontiguousarray(values, dtype=np.dtype(kind).newbyteorder("<"))
    return {"type": kind, "data": base64.b64encode(array.tobytes()).decode("ascii")}

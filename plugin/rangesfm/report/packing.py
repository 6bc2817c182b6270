"""Data for the page's script: JSON that no name can break out of, with arrays as base64."""

from __future__ import annotations

import base64
import json
from typing import Any

import numpy as np
import numpy.typing as npt

from rangesfm.report.markup import Markup, element

# A JSON string may hold these as escapes; in HTML "</script" and "<!--" would end or change the block.
_ESCAPES = str.maketrans({character: f"\\u{ord(character):04x}" for character in "<>&\u2028\u2029"})


def pack(values: npt.ArrayLike, kind: str) -> dict[str, str]:
    """An array as the page's script reads it, row by row.

    Args:
        kind: "uint8", "uint16", "int32" or "float32".
    """
    array = np.ascontiguousarray(values, dtype=np.dtype(kind).newbyteorder("<"))
    return {"type": kind, "data": base64.b64encode(array.tobytes()).decode("ascii")}


def script_json(value: Any) -> Markup:
    """JSON that may stand inside a script element."""
    return Markup(json.dumps(value, ensure_ascii=False, allow_nan=False, separators=(",", ":")).translate(_ESCAPES))


def data_block(id_: str, value: Any) -> Markup:
    """A script element that holds data and is never run."""
    return element("script", script_json(value), type="application/json", id=id_)

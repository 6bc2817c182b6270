"""Drawing of pictures by the engine of Vega-Lite, in a process of its own.

The engine is written in C++ and ends the whole process where it fails. Here that is a child process, whose end is
noticed.
"""

from __future__ import annotations

import base64
from collections.abc import Sequence
from functools import partial
from typing import Any, TypeAlias

from rangesfm.errors import SolverError
from rangesfm.progress import Progress
from rangesfm.util.processes.supervision import supervise

# Pixels of a PNG per pixel of the page, with which text has the size that is usual in papers.
_PNG_SCALE = 2.5
# Vega-Lite specification of a picture, and its format: "png" or "svg".
Drawing: TypeAlias = tuple[dict[str, Any], str]


def draw_pictures(drawings: Sequence[Drawing]) -> list[bytes]:
    """Return the contents of picture files.

    Raises:
        SolverError: the engine fails, for example because it may not reserve the address space that it wants.
    """
    ended = supervise(partial(_draw, drawings))
    if "done" not in ended.last:
        hint = " (it reserves 64 GB of address space; `ulimit -v` may allow less)" if ended.signal is not None else ""
        raise SolverError(f"the engine that draws pictures failed: {ended.how}{hint}")
    return [base64.b64decode(content) for content in ended.last["done"]]


def _draw(drawings: Sequence[Drawing], _: Progress) -> list[str]:
    """Draw the pictures and return their contents as text for a message."""
    import vl_convert  # it loads 90 MB with a script engine, so it is imported only where a picture is drawn

    contents = [
        vl_convert.vegalite_to_png(spec, scale=_PNG_SCALE)
        if format == "png"
        else vl_convert.vegalite_to_svg(spec).encode("utf-8")
        for spec, format in drawings
    ]
    return [base64.b64encode(content).decode("ascii") for content in contents]

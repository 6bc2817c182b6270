"""Words for known positions and for the components of their errors."""

from __future__ import annotations

from rangesfm.measurements.kind_words import KindWords

POSITIONS = "positions"
FRAME = "frame"
"""Error of the frame of known positions, in its place and its scale."""
POSITION_WORDS = KindWords(
    POSITIONS,
    "known positions",
    {
        "points": "coordinates of the control points",
        "positions": "noise of the known positions",
        "positions_warp": "errors of the positions that belong to a place",
        "positions_(.+)s": "errors of the known positions that last for {} s",
        FRAME: "size of the site as the positions have it",
    },
)

"""Words for measured lengths and for the components of their errors."""

from __future__ import annotations

from rangesfm.measurements.kind_words import KindWords

LENGTHS = "lengths"
LENGTH_WORDS = KindWords(
    LENGTHS,
    "measured lengths",
    {"tape": "errors of the measured lengths", "marks": "marking of points in the photos"},
)

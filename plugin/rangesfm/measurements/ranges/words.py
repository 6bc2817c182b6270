"""Words for ranges and for the components of their errors."""

from __future__ import annotations

from rangesfm.measurements.kind_words import KindWords
from rangesfm.measurements.ranges.errors.components import COMPONENTS, OTHER_ERRORS

RANGES = "ranges"
RANGE_WORDS = KindWords(
    RANGES, "ranges", {component.name: component.words for component in COMPONENTS} | {**OTHER_ERRORS}
)

"""The table of words for all kinds of measurement, in the order of the table of kinds (``survey/kinds_in_map.py``)."""

from __future__ import annotations

import re
from collections.abc import Iterable

from rangesfm.measurements.imu.words import IMU_WORDS
from rangesfm.measurements.lengths.words import LENGTH_WORDS
from rangesfm.measurements.positions.words import POSITION_WORDS
from rangesfm.measurements.ranges.words import RANGE_WORDS
from rangesfm.solver.bending import BENDS

KINDS_IN_WORDS = (RANGE_WORDS, POSITION_WORDS, LENGTH_WORDS, IMU_WORDS)


def component_words(names: Iterable[str]) -> dict[str, str]:
    """Return descriptions of components of errors for people, by name; of a later version's components their names."""
    return {name: _words_of(name) for name in names}


def _words_of(name: str) -> str:
    known = [BENDS, *(each.errors for each in KINDS_IN_WORDS)]
    described = ((re.fullmatch(pattern, name), words) for errors in known for pattern, words in errors.items())
    return next((words.format(*found.groups()) for found, words in described if found is not None), name)

"""Logs of lines that a radio prints, in which each range is a phrase of its own.

Serial lines lose and double characters. So the phrases are found one by one, wherever they stand: what
is whole in a damaged line survives, and what was begun and is not whole counts as no measurement.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from rangesfm.files.tables import read_text
from rangesfm.ranging.anchors.anchor import Anchor
from rangesfm.ranging.log import DEFAULT_TAG_ID
from rangesfm.ranging.readers.reader import Reader, Reading, ReadOptions, reader_of_readings
from rangesfm.ranging.readers.roles import Sides
from rangesfm.ranging.readers.times import HostClock

ReadPhrase = Callable[["re.Match[str]", float, int], Iterable[Reading]]
LOST = Reading(0.0, "", math.nan)


def _one_range(phrase: re.Match[str], timestamp_s: float, line: int) -> Iterator[Reading]:
    """Of metres, by the groups anchor_id and range, and possibly tag_id and variance."""
    groups = phrase.groupdict()
    tag_id, stddev_m = groups.get("tag_id") or DEFAULT_TAG_ID, math.sqrt(max(float(groups.get("variance") or 0), 0))
    yield Reading(timestamp_s, phrase["anchor_id"], float(phrase["range"]), line, tag_id, stddev_m)


@dataclass(frozen=True)
class _Phrases:
    """How a radio prints its ranges.

    Attributes:
        begin: begins a line's first range; the host's time stands before it.
        each: begins each range.
        whole: all of it; groups x, y and z, if there are any, are where the anchor stands, in metres; a group time
            is the time of the range, which stands in no other place then.
        ranges: of such a phrase, its time in seconds and its line.
    """

    begin: re.Pattern[str]
    each: re.Pattern[str]
    whole: re.Pattern[str]
    ranges: ReadPhrase

    def begins(self, head: str) -> bool:
        return self.begin.search(head) is not None

    def readings(self, path: Path, options: ReadOptions) -> Iterator[Reading]:
        clock = HostClock(path, options)
        has_time = "time" in self.whole.groupindex
        for line, text in _numbered_lines(path):
            num_begun = len(self.each.findall(text))
            begin = self.begin.search(text) if num_begun else None
            if begin is None:
                continue
            timestamp_s = 0.0 if has_time else clock.seconds(text[: begin.start()], line)
            whole = list(self.whole.finditer(text))
            for phrase in whole:
                yield from self.ranges(phrase, clock.seconds(phrase["time"], line) if has_time else timestamp_s, line)
            yield from [LOST] * (num_begun - len(whole))

    def read_anchors(self, path: Path) -> tuple[Anchor, ...]:
        """At the median of what was said of each; those that share a place were never set up: unknown."""
        positions: dict[str, list[tuple[float, float, float]]] = {}
        for _, text in _numbered_lines(path) if "x" in self.whole.groupindex else ():
            for phrase in self.whole.finditer(text):
                if phrase["z"] is not None:  # a place in the plane does not say how high
                    position = (float(phrase["x"]), float(phrase["y"]), float(phrase["z"]))
                    positions.setdefault(phrase["anchor_id"], []).append(position)
        medians = {anchor_id: np.median(said, axis=0) for anchor_id, said in positions.items()}
        places = [tuple(median.tolist()) for median in medians.values()]
        return tuple(
            Anchor(anchor_id, position_m=median if places.count(tuple(median.tolist())) == 1 else None)
            for anchor_id, median in medians.items()
        )


def printed_reader(
    name: str, *, begin: str, each: str, whole: str, ranges: ReadPhrase = _one_range, sides: Sides = Sides.TOLD
) -> Reader:
    """The reader of lines with such phrases, given as patterns of ASCII."""
    compiled = partial(re.compile, flags=re.ASCII | re.MULTILINE)
    phrases = _Phrases(compiled(begin), compiled(each), compiled(whole), ranges)
    return reader_of_readings(name, phrases.begins, phrases.readings, phrases.read_anchors, sides)


def _numbered_lines(path: Path) -> Iterator[tuple[int, str]]:
    """Every line with its 1-based number; bytes that are no text, as serial lines have them, are replaced."""
    return enumerate(read_text(path, errors="replace").split("\n"), 1)

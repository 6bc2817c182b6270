"""Logs of lines that a radio prints, in which each range is a phrase of its own.

Serial lines lose and double characters. So the phrases are found one by one, wherever they stand: what
is whole in a damaged line survives, and what was begun and is not whole counts as no measurement.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from rangesfm.errors import InputError
from rangesfm.files.tables import read_text
from rangesfm.ranging.anchors.anchor import Anchor
from rangesfm.ranging.log import DEFAULT_TAG_ID, RangeLog
from rangesfm.ranging.readers.host_time import HostClock
from rangesfm.ranging.readers.reader import Reader, ReadOptions
from rangesfm.ranging.readers.records import Records
from rangesfm.ranging.readers.roles import Sides

AddPhrase = Callable[[Records, "re.Match[str]", float, int], None]


def _add(records: Records, phrase: re.Match[str], timestamp_s: float, line: int) -> None:
    """Take a range of metres, with the groups anchor_id and range, and possibly tag_id and variance."""
    groups = phrase.groupdict()
    tag_id, variance = groups.get("tag_id") or DEFAULT_TAG_ID, float(groups.get("variance") or 0)
    stddev_m = math.sqrt(variance) if variance > 0 else math.nan
    records.add(timestamp_s, phrase["anchor_id"], float(phrase["range"]), line, tag_id=tag_id, range_stddev_m=stddev_m)


@dataclass(frozen=True)
class _Phrases:
    """How a radio prints its ranges.

    Attributes:
        begin: begins a line's first range; the host's time stands before it.
        each: begins each range.
        whole: all of it; groups x, y and z, if there are any, are where the anchor stands, in metres; a group time
            is the time of the range, which stands in no other place then.
        add: puts the ranges of such a phrase, the time in seconds and the line into the records.
    """

    begin: re.Pattern[str]
    each: re.Pattern[str]
    whole: re.Pattern[str]
    add: AddPhrase


def printed_reader(
    name: str,
    description: str,
    *,
    begin: str,
    each: str,
    whole: str,
    add: AddPhrase = _add,
    sides: Sides = Sides.TOLD,
) -> Reader:
    """The reader of lines with such phrases, given as patterns of ASCII."""
    compiled = partial(re.compile, flags=re.ASCII | re.MULTILINE)
    phrases = _Phrases(compiled(begin), compiled(each), compiled(whole), add)

    def read(path: Path, options: ReadOptions) -> RangeLog:
        check_only_time_is_described(path, options)
        return _read(path, options, name, phrases)

    return Reader(
        name,
        description,
        recognizes=lambda head: phrases.begin.search(head) is not None,
        read=read,
        read_anchors=lambda path: _read_anchors(path, phrases) if "x" in phrases.whole.groupindex else (),
        sides=sides,
    )


def check_only_time_is_described(path: Path, options: ReadOptions) -> None:
    """InputError if the user describes columns where there are none."""
    if options.columns or options.range_unit is not None or options.separator is not None:
        raise InputError("the log has a format of its own, without columns, range_unit or separator to be given", path)


def _numbered_lines(path: Path) -> Iterator[tuple[int, str]]:
    """Every line with its 1-based number; bytes that are no text, as serial lines have them, are replaced."""
    return enumerate(read_text(path, errors="replace").split("\n"), 1)


def positions_to_anchors(positions: Mapping[str, list[tuple[float, float, float]]]) -> tuple[Anchor, ...]:
    """Anchors at the median of what was said of each; those that share a place were never set up: unknown."""
    medians = {anchor_id: np.median(said, axis=0) for anchor_id, said in positions.items()}
    places = [tuple(median.tolist()) for median in medians.values()]
    return tuple(
        Anchor(anchor_id, position_m=median if places.count(tuple(median.tolist())) == 1 else None)
        for anchor_id, median in medians.items()
    )


def _read(path: Path, options: ReadOptions, name: str, phrases: _Phrases) -> RangeLog:
    clock = HostClock(path, options)
    records = Records()
    for line, text in _numbered_lines(path):
        num_begun = len(phrases.each.findall(text))
        begin = phrases.begin.search(text) if num_begun else None
        if begin is None:
            continue
        has_time = "time" in phrases.whole.groupindex
        timestamp_s = 0.0 if has_time else clock.seconds(text[: begin.start()], line)
        whole = list(phrases.whole.finditer(text))
        for phrase in whole:
            timestamp_s = clock.seconds(phrase["time"], line) if has_time else timestamp_s
            phrases.add(records, phrase, timestamp_s, line)
        records.num_no_measurement += max(0, num_begun - len(whole))
    return records.to_log(path, name)


def _read_anchors(path: Path, phrases: _Phrases) -> tuple[Anchor, ...]:
    positions: dict[str, list[tuple[float, float, float]]] = {}
    for _, text in _numbered_lines(path):
        for phrase in phrases.whole.finditer(text):
            if phrase["z"] is None:  # a place in the plane does not say how high
                continue
            position = (float(phrase["x"]), float(phrase["y"]), float(phrase["z"]))
            positions.setdefault(phrase["anchor_id"], []).append(position)
    return positions_to_anchors(positions)

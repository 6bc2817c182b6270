"""What a reader of one log format is, how the ranges that it finds become a log, and which of its nodes are anchors."""

from __future__ import annotations

import math
import shlex
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass
from enum import Enum
from itertools import compress
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rangesfm.arrays import Array, Mask
from rangesfm.errors import InputError
from rangesfm.options import LogOptions
from rangesfm.ranging.anchors.anchor import Anchor
from rangesfm.ranging.log import DEFAULT_TAG_ID, RangeLog

# A value that stands for no measurement: so often, so many times the largest range, where so many show what is usual.
_MIN_NUM_FAR, _FAR, _MIN_NUM = 3, 4.0, 20
_NOTHING = 1e-12  # in any unit


class ReadOptions(LogOptions):
    """What the user says about a log."""

    given: tuple[str, ...] = ()
    """What the user calls it."""

    def command(self, path: Path, **more: str) -> str:
        """What to type to read the log with these options and some more."""
        columns = ",".join(f"{quantity}={name}" for quantity, name in self.columns.items())
        said = {"columns": columns, "timestamp_unit": self.timestamp_unit, "range_unit": self.range_unit}
        flags = {**said, "separator": self.separator, **more}
        typed = [word for flag, value in flags.items() if value for word in (f"--{flag}", value)]
        return shlex.join(["rangesfm", "ranges", *(self.given or [str(path)]), *typed])

    def which_unit(self, path: Path, quantity: str, units: Sequence[str], why: str) -> InputError:
        """What asks for a unit that may be one or another, with the commands that say it."""
        flag, either = f"{quantity}_unit", " or ".join(units)
        message = f"the {quantity} has {why}, which may be {either}; say which by --{flag} (in a survey file: {flag})"
        return InputError(message, path, advice=[self.command(path, **{flag: unit}) for unit in units])


class Sides(Enum):
    """What a log format says of the two ends of a range."""

    ASKED = "who asked whom"
    TOLD = "a side for tags and one for anchors, where a peer may stand on the other's side"
    APART = "tags and anchors, each numbered by themselves"


@dataclass(frozen=True)
class Reader:
    """One log format. What ``read`` and ``read_anchors`` find wrong is an InputError.

    Attributes:
        name: by which the user asks for it.
        recognizes: whether the beginning of a file looks like this format.
        read: the whole file.
        read_anchors: the anchors whose positions the log tells.
        sides: what the log says of the two ends of a range.
    """

    name: str
    recognizes: Callable[[str], bool]
    read: Callable[[Path, ReadOptions], RangeLog]
    read_anchors: Callable[[Path], tuple[Anchor, ...]] = lambda path: ()
    sides: Sides = Sides.TOLD


class Reading(NamedTuple):
    """A range as a radio tells it (see RangeLog); one that is not a positive number is no measurement."""

    timestamp_s: float
    anchor_id: str
    range_m: float
    line: int = 0
    tag_id: str = DEFAULT_TAG_ID
    range_stddev_m: float = math.nan
    los: int = -1


def which_are_measured(ranges: Array, path: Path) -> tuple[Mask, tuple[str, ...]]:
    """(n,) which of the ranges in a file are one, and what to say of the others; InputError if none is.

    Those are none that are not positive, and the largest where it stands for no measurement, as 65535: far above all
    others and often.
    """
    positive = ranges[(ranges > 0) & (ranges < math.inf)]
    largest = float(np.max(positive, initial=0.0))
    others = positive[positive < largest]
    num_far = len(positive) - len(others)
    is_far = num_far >= _MIN_NUM_FAR and len(others) >= _MIN_NUM and largest > _FAR * others.max()
    measured: Mask = (ranges > _NOTHING) & (ranges < (largest if is_far else math.inf))
    if not measured.any():
        said = f"all {len(ranges)} records say that there was no measurement" if len(ranges) else "no records"
        raise InputError(f"no usable range: {said}", path)
    note = f"{largest:.10g} stands there {num_far} times, far above all other ranges: taken for no measurement"
    return measured, (note,) if is_far else ()


def reader_of_readings(
    name: str,
    recognizes: Callable[[str], bool],
    readings: Callable[[Path, ReadOptions], Iterable[Reading]],
    read_anchors: Callable[[Path], tuple[Anchor, ...]] = lambda path: (),
    sides: Sides = Sides.TOLD,
) -> Reader:
    """Of a format of its own, which has no columns to be described."""

    def read(path: Path, options: ReadOptions) -> RangeLog:
        if options.columns or options.range_unit is not None or options.separator is not None:
            message = "the log has a format of its own, without columns, range_unit or separator to be given"
            raise InputError(message, path)
        found = list(readings(path, options))
        measured, notes = which_are_measured(np.array([reading.range_m for reading in found], np.float64), path)
        times, anchor_ids, ranges, lines, tag_ids, stddevs, los = zip(*compress(found, measured))
        return RangeLog.from_arrays(
            anchor_ids,
            ranges,
            timestamp_s=times,
            range_stddev_m=[stddev if 0 < stddev < math.inf else math.nan for stddev in stddevs],
            tag_id=tag_ids,
            los=los,
            line=lines,
            source=path,
            format=name,
            num_no_measurement=len(found) - len(ranges),
            notes=notes,
        )

    return Reader(name, recognizes, read, read_anchors, sides)


def tell_roles(
    log: RangeLog,
    sides: Sides,
    *,
    known_anchor_ids: Collection[str] = (),
    known_tag_ids: Collection[str] = (),
) -> RangeLog:
    """Put every range's tag and anchor in their places, and tell those between two of a kind.

    What is known decides. A node that stands on one side only has the role of that side, but for one that only
    known anchors range with: it is a tag. One on both sides is a tag where the anchors are known, an anchor where
    the tags are known and sides mean nothing; else it is what it is in most ranges. Where an id ranges with itself,
    or is known as both, tags and anchors are numbered by themselves, and their sides count.

    Args:
        log: as read: all ranges between the tag and the anchor of their record.
        sides: what these mean.
        known_anchor_ids, known_tag_ids: as far as anybody said.
    """
    known_anchors, known_tags = set(known_anchor_ids), set(known_tag_ids)
    tags, anchors = set(log.tag_ids), set(log.anchor_ids)
    if sides is Sides.APART or known_anchors & known_tags:
        return log
    if not (tags & anchors or tags & known_anchors or anchors & known_tags):
        is_hub = len(anchors) == 1 and len(tags) > 1 and not (known_anchors or known_tags)
        # Anchors are many and tags few.
        return log.with_anchors(tags) if sides is Sides.ASKED and is_hub else log
    asked = Counter(zip(log.tag_index.tolist(), log.anchor_index.tolist()))
    num_by_pair = {(log.tag_ids[tag], log.anchor_ids[anchor]): num for (tag, anchor), num in asked.items()}
    if any(tag == anchor for tag, anchor in num_by_pair):
        return log
    if sides is Sides.ASKED and known_tags and not known_anchors:
        return log.with_anchors((tags | anchors) - known_tags)
    return log.with_anchors(
        {node for node in tags | anchors if _is_anchor(node, num_by_pair, known_anchors, known_tags)}
    )


def _is_anchor(
    node: str, num_by_pair: dict[tuple[str, str], int], known_anchors: set[str], known_tags: set[str]
) -> bool:
    if node in known_anchors or node in known_tags:
        return node in known_anchors
    num_as_tag = sum(num for (tag, _), num in num_by_pair.items() if tag == node)
    num_as_anchor = {tag: num for (tag, anchor), num in num_by_pair.items() if anchor == node}
    if known_anchors:
        return num_as_tag == 0 and not num_as_anchor.keys() <= known_anchors
    return sum(num_as_anchor.values()) >= num_as_tag

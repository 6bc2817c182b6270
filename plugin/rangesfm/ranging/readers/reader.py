"""What a reader of one log format is, and how the ranges that it finds become a log."""

from __future__ import annotations

import math
import shlex
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from itertools import compress
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rangesfm.arrays import Array, Mask
from rangesfm.errors import InputError
from rangesfm.options import LogOptions
from rangesfm.ranging.anchors.anchor import Anchor
from rangesfm.ranging.log import DEFAULT_TAG_ID, RangeLog
from rangesfm.ranging.readers.roles import Sides

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

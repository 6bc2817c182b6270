"""What a reader of one log format is."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from rangesfm.ranging.anchors.anchor import Anchor
from rangesfm.ranging.log import RangeLog
from rangesfm.ranging.readers.roles import Sides
from rangesfm.ranging.twr import StampOptions


@dataclass(frozen=True)
class ReadOptions:
    """What the user says about a log; None and empty: what the format says.

    Attributes:
        columns: name in the file of each quantity (``columns.QUANTITIES``).
        timestamp_unit: s, ms, us, ns or iso.
        range_unit: m, cm or mm.
        separator: between cells; a blank means any run of blanks.
        ranging_interval_s: time between two rounds, of radios that count them instead of telling times.
        stamps: how time stamps of two-way ranging become ranges.
        given: what the user called the log.
    """

    columns: Mapping[str, str] = field(default_factory=dict)
    timestamp_unit: str | None = None
    range_unit: str | None = None
    separator: str | None = None
    ranging_interval_s: float | None = None
    stamps: StampOptions = field(default_factory=StampOptions)
    given: Sequence[str] = ()

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
        description: for the message that lists the formats.
        recognizes: whether the beginning of a file looks like this format.
        read: the whole file.
        read_anchors: the anchors whose positions the log tells; None: this format tells none.
        sides: what the log says of the two ends of a range.
    """

    name: str
    description: str
    recognizes: Callable[[str], bool]
    read: Callable[[Path, ReadOptions], RangeLog]
    read_anchors: Callable[[Path], tuple[Anchor, ...]] | None = None
    sides: Sides = Sides.TOLD

"""Ranges gathered one by one into a log."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path

from rangesfm.errors import InputError
from rangesfm.ranging.log import DEFAULT_TAG_ID, RangeLog


@dataclass
class Records:
    """What a reader has found so far; see RangeLog for the meaning of each."""

    anchor_id: list[str] = field(default_factory=list)
    range_m: list[float] = field(default_factory=list)
    timestamp_s: list[float] = field(default_factory=list)
    range_stddev_m: list[float] = field(default_factory=list)
    tag_id: list[str] = field(default_factory=list)
    los: list[int] = field(default_factory=list)
    line: list[int] = field(default_factory=list)
    num_no_measurement: int = 0

    def add(
        self,
        timestamp_s: float,
        anchor_id: str,
        range_m: float,
        line: int,
        *,
        tag_id: str = DEFAULT_TAG_ID,
        range_stddev_m: float = math.nan,
        los: int = -1,
    ) -> None:
        """Take a range; one that is not a positive number is no measurement."""
        if not 0 < range_m < math.inf:
            self.num_no_measurement += 1
            return
        self.timestamp_s.append(timestamp_s)
        self.anchor_id.append(anchor_id)
        self.range_m.append(range_m)
        self.line.append(line)
        self.tag_id.append(tag_id)
        self.range_stddev_m.append(range_stddev_m if 0 < range_stddev_m < math.inf else math.nan)
        self.los.append(los)

    def to_log(self, path: Path, format: str) -> RangeLog:
        """All of it; InputError if no range was found."""
        if not self.range_m:
            num = self.num_no_measurement
            said = f"all {num} records say that there was no measurement" if num else "no records"
            raise InputError(f"no usable range: {said}", path)
        return RangeLog.from_arrays(
            self.anchor_id,
            self.range_m,
            timestamp_s=self.timestamp_s,
            range_stddev_m=self.range_stddev_m,
            tag_id=self.tag_id,
            los=self.los,
            line=self.line,
            source=path,
            format=format,
            num_no_measurement=self.num_no_measurement,
        )

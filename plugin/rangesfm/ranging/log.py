"""RangeLog: what a radio measured, as arrays that were checked once."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

DEFAULT_TAG_ID = "tag"


@dataclass(frozen=True)
class RangeLog:
    """n ranges between a moving tag and static anchors, in the order of the log.

    Either ``timestamp_s`` or ``image_name`` says when: the other is None.

    Attributes:
        anchor_ids: the distinct anchors, in order of first appearance.
        anchor_index: (n,) int, into ``anchor_ids``.
        range_m: (n,) metres, finite and positive.
        timestamp_s: (n,) seconds on the radio's clock, in any order; or None.
        image_name: n names of the photos at which each range was taken; or None.
        range_stddev_m: (n,) metres, NaN where the log does not say.
        tag_ids: the distinct tags, in order of first appearance.
        tag_index: (n,) int, into ``tag_ids``.
        los: (n,) int8: 1 line of sight, 0 none, -1 not said.
        line: (n,) int, 1-based line (or record) in the source.
        source: the file it came from, for messages; None if made in memory.
        format: name of the reader, for the record.
        num_no_measurement: how many records said that there was no measurement.
        shared_stddev_m: (n,) stddev of what all ranges of about this length are off together, once the radio's
            error curve has been taken off them; None: it has not.
    """

    anchor_ids: tuple[str, ...]
    anchor_index: npt.NDArray[np.int64]
    range_m: npt.NDArray[np.float64]
    timestamp_s: npt.NDArray[np.float64] | None
    image_name: tuple[str, ...] | None
    range_stddev_m: npt.NDArray[np.float64]
    tag_ids: tuple[str, ...]
    tag_index: npt.NDArray[np.int64]
    los: npt.NDArray[np.int8]
    line: npt.NDArray[np.int64]
    source: Path | None = None
    format: str = "memory"
    num_no_measurement: int = 0
    shared_stddev_m: npt.NDArray[np.float64] | None = None

    def __post_init__(self) -> None:
        n = len(self.range_m)
        if (self.timestamp_s is None) == (self.image_name is None):
            raise ValueError("a range log has either timestamps or image names")
        for name in ("anchor_index", "range_stddev_m", "tag_index", "los", "line"):
            if len(getattr(self, name)) != n:
                raise ValueError(f"{name} has {len(getattr(self, name))} entries, range_m has {n}")
        if not (np.all(np.isfinite(self.range_m)) and np.all(self.range_m > 0)):
            raise ValueError("ranges are finite and positive")
        if self.timestamp_s is not None and not np.all(np.isfinite(self.timestamp_s)):
            raise ValueError("timestamps are finite")

    def __len__(self) -> int:
        return len(self.range_m)

    def subset(self, rows: npt.NDArray[np.int64] | npt.NDArray[np.bool_]) -> RangeLog:
        """The same log with some of its ranges; anchors and tags that are left without any are forgotten."""
        rows = np.flatnonzero(rows) if rows.dtype == np.bool_ else rows
        return RangeLog.from_arrays(
            [self.anchor_ids[k] for k in self.anchor_index[rows]],
            self.range_m[rows],
            timestamp_s=None if self.timestamp_s is None else self.timestamp_s[rows],
            image_name=None if self.image_name is None else [self.image_name[i] for i in rows],
            range_stddev_m=self.range_stddev_m[rows],
            tag_id=[self.tag_ids[k] for k in self.tag_index[rows]],
            los=self.los[rows],
            line=self.line[rows],
            source=self.source,
            format=self.format,
            num_no_measurement=self.num_no_measurement,
            shared_stddev_m=None if self.shared_stddev_m is None else self.shared_stddev_m[rows],
        )

    @classmethod
    def from_arrays(
        cls,
        anchor_id: list[str] | npt.NDArray[np.str_],
        range_m: npt.ArrayLike,
        *,
        timestamp_s: npt.ArrayLike | None = None,
        image_name: list[str] | None = None,
        range_stddev_m: npt.ArrayLike | None = None,
        tag_id: list[str] | None = None,
        los: npt.ArrayLike | None = None,
        line: npt.ArrayLike | None = None,
        source: Path | None = None,
        format: str = "memory",
        num_no_measurement: int = 0,
        shared_stddev_m: npt.ArrayLike | None = None,
    ) -> RangeLog:
        """Build a log from one value (or one string) per range; optional columns may be left out."""
        ranges = np.asarray(range_m, dtype=np.float64)
        n = len(ranges)
        anchor_ids, anchor_index = _in_order_of_appearance(anchor_id)
        tag_ids, tag_index = _in_order_of_appearance(tag_id) if tag_id is not None else _only(DEFAULT_TAG_ID, n)
        return cls(
            anchor_ids=anchor_ids,
            anchor_index=anchor_index,
            range_m=ranges,
            timestamp_s=None if timestamp_s is None else np.asarray(timestamp_s, dtype=np.float64),
            image_name=None if image_name is None else tuple(image_name),
            range_stddev_m=np.full(n, np.nan)
            if range_stddev_m is None
            else np.asarray(range_stddev_m, dtype=np.float64),
            tag_ids=tag_ids,
            tag_index=tag_index,
            los=np.full(n, -1, dtype=np.int8) if los is None else np.asarray(los, dtype=np.int8),
            line=np.arange(1, n + 1) if line is None else np.asarray(line, dtype=np.int64),
            source=source,
            format=format,
            num_no_measurement=num_no_measurement,
            shared_stddev_m=None if shared_stddev_m is None else np.asarray(shared_stddev_m, dtype=np.float64),
        )


def _in_order_of_appearance(
    ids: list[str] | npt.NDArray[np.str_],
) -> tuple[tuple[str, ...], npt.NDArray[np.int64]]:
    texts: list[str] = ids if isinstance(ids, list) else ids.tolist()
    index_of = {text: index for index, text in enumerate(dict.fromkeys(texts))}
    return tuple(index_of), np.fromiter(map(index_of.__getitem__, texts), np.int64, len(texts))


def _only(id: str, num: int) -> tuple[tuple[str, ...], npt.NDArray[np.int64]]:
    return (id,) if num else (), np.zeros(num, np.int64)

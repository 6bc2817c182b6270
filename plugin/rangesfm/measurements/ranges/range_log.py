"""RangeLog: the ranges that a radio measured, as checked arrays."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from enum import IntEnum
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from rangesfm.arrays import Array, Categories, Indices, Mask
from rangesfm.errors import InputError
from rangesfm.util.geometry.moments import ByPhoto, ByTime, Moments

DEFAULT_TAG_ID = "tag"
# Two ranges between the same nodes cannot have the same time. If at least this share of successive ranges has, the
# times were rounded.
_MIN_REPEATED_SHARE = 0.25
# If more than this share of the steps goes back in time, the log is not in the order of time.
_MOST_GOING_BACK = 0.05
# Times of a log in steps at least as coarse as this get a note.
_COARSE_STEP_S = 0.1


class RangeKind(IntEnum):
    """Kinds of the two nodes of a range; tags are on the camera, anchors are static."""

    TAG_ANCHOR = 0
    ANCHOR_ANCHOR = 1
    TAG_TAG = 2


@dataclass(frozen=True)
class RangeLog:
    """n ranges in the order of the log, between moving tags and static anchors; some may be between two of a kind.

    Attributes:
        anchor_ids: the distinct anchors in natural order (A2 before A10), which does not depend on the log's order.
        anchor_index: (n,) int, index in ``anchor_ids``; -1 for a range between two tags.
        range_m: (n,) ranges in metres, finite and positive.
        moments: when the n ranges were taken: by time on the radio's clock, in any order, or by photo.
        range_stddev_m: (n,) standard deviation in metres, NaN where the log does not give it.
        shared_stddev_m: (n,) standard deviation of the error that all ranges of about this length share after the
            radio's error curve has been subtracted; NaN if it has not been.
        tag_ids: the distinct tags in natural order.
        tag_index: (n,) int, index in ``tag_ids``; -1 for a range between two anchors.
        peer_index: (n,) int, the other end of a range between two anchors (index in ``anchor_ids``) or two tags (index
            in ``tag_ids``); -1 for a range between a tag and an anchor.
        los: (n,) int8: 1 line of sight, 0 no line of sight, -1 not given.
        line: (n,) int, 1-based line (or record) in the source.
        source: the file that the ranges come from, for messages; None if made in memory.
        format: name of the reader.
        num_no_measurement: number of records that contain no measurement.
        notes: assumptions made in reading the file, as lines for the user.
    """

    anchor_ids: tuple[str, ...]
    anchor_index: Indices
    range_m: Array
    moments: Moments
    range_stddev_m: Array
    shared_stddev_m: Array
    tag_ids: tuple[str, ...]
    tag_index: Indices
    peer_index: Indices
    los: npt.NDArray[np.int8]
    line: Indices
    source: Path | None = None
    format: str = "memory"
    num_no_measurement: int = 0
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        n = len(self.range_m)
        of_ranges = ("moments", "range_stddev_m", "shared_stddev_m", "los", "line")
        for name in ("anchor_index", "tag_index", "peer_index", *of_ranges):
            if len(getattr(self, name)) != n:
                raise ValueError(f"{name} has {len(getattr(self, name))} entries, range_m has {n}")
        if not (np.all(np.isfinite(self.range_m)) and np.all(self.range_m > 0)):
            raise ValueError("ranges are finite and positive")
        if isinstance(self.moments, ByTime) and not np.all(np.isfinite(self.timestamp_s)):
            raise ValueError("timestamps are finite")
        num_ends = np.sum([self.anchor_index >= 0, self.tag_index >= 0, self.peer_index >= 0], axis=0)
        if np.any(num_ends != 2):
            raise ValueError("a range has two ends: tag and anchor, or one of them and a peer")

    def __len__(self) -> int:
        return len(self.range_m)

    @property
    def timestamp_s(self) -> Array:
        """(n,) seconds on the radio's clock; NaN where the ranges are by photo."""
        return self.moments.timestamp_s

    @property
    def image_name(self) -> tuple[str, ...]:
        """Names of the n photos at which the ranges were taken; empty texts where the ranges are by time."""
        return self.moments.image_name

    @property
    def kind(self) -> npt.NDArray[np.int8]:
        """RangeKind of each range (n,)."""
        kind = np.full(len(self), RangeKind.TAG_ANCHOR, dtype=np.int8)
        kind[self.tag_index < 0] = RangeKind.ANCHOR_ANCHOR
        kind[self.anchor_index < 0] = RangeKind.TAG_TAG
        return kind

    @cached_property
    def own_order(self) -> Indices:
        """Rows (n,) sorted by anchor, time, tag and range.

        Results computed in this order do not depend on the order of the log, neither by random draws nor by rounding.
        """
        return np.lexsort((self.range_m, self.peer_index, self.tag_index, self.moments.sort_keys, self.anchor_index))

    def in_time_order(self) -> RangeLog:
        """Return the same ranges sorted by time or photo, anchor and tag; the order of the log makes no difference."""
        of_twins = self.los, np.nan_to_num(self.range_stddev_m), self.range_m, self.peer_index
        return self.subset(np.lexsort((*of_twins, self.tag_index, self.anchor_index, self.moments.sort_keys)))

    @property
    def time_resolution_s(self) -> float:
        """Step to which the times are rounded, for example whole seconds or batches of lines; 0 if none is found.

        A step is found if it is longer than the time between two ranges of one tag and one anchor.
        """
        if not isinstance(self.moments, ByTime) or len(self) < 2:
            return 0.0
        times = self.timestamp_s
        steps, _ = self._steps_of_links(times, np.argsort(times, kind="stable"))
        if not len(steps) or np.mean(steps == 0) < _MIN_REPEATED_SHARE:
            return 0.0
        between = np.diff(np.unique(times))
        return float(np.median(between)) if len(between) else 0.0

    @property
    def num_restarts(self) -> int:
        """Number of times that the clock jumps back by a quarter of the log or more; 0 if the log is unordered."""
        if not isinstance(self.moments, ByTime) or len(self) < 2:
            return 0
        steps, link = self._steps_of_links(self.timestamp_s, np.arange(len(self)))
        if np.count_nonzero(steps < 0) > _MOST_GOING_BACK * len(steps):
            return 0
        # Each of the links goes back when the clock does.
        return int(np.bincount(link[steps < -0.25 * np.ptp(self.timestamp_s)], minlength=1).max())

    def notes_on_clock(self) -> Iterator[str]:
        """Yield lines for the user on times that a clock in order does not give."""
        if num := self.num_restarts:
            times = f"{num} time{'s' * (num > 1)}"
            yield f"the log's times go back {times} by a quarter of its length or more: was its clock restarted?"
        if (step_s := self.time_resolution_s) >= _COARSE_STEP_S:
            yield f"the log's times have steps of {step_s:.2g} s: somebody who walks moves that many metres in one"

    def _steps_of_links(self, times: Array, order: Indices) -> tuple[Array, Indices]:
        """Return the time steps between successive ranges of the same tag and anchor, with the rows in ``order``.

        The second result is the link of each step: a number for its pair of tag and anchor.
        """
        link = (self.tag_index + 1) * (len(self.anchor_ids) + 1) + self.anchor_index + 1
        order = order[np.argsort(link[order], kind="stable")]
        same = np.diff(link[order]) == 0
        return np.diff(times[order])[same], link[order][1:][same]

    def end_ids(self) -> tuple[list[str], list[str]]:
        """Return the ids of the two ends of each range: n tags (or peers if none) and n anchors (or peers)."""
        ids, first, second = self._ends()
        texts = np.array(ids, dtype=object)
        return texts[first].tolist(), texts[second].tolist()

    def _ends(self) -> tuple[list[str], Indices, Indices]:
        """Return the ids of all nodes, anchors first, and the indices (n,) of both ends of each range in them."""
        num_anchors = len(self.anchor_ids)
        first = np.where(self.tag_index < 0, self.peer_index, num_anchors + self.tag_index)
        second = np.where(self.anchor_index < 0, num_anchors + self.peer_index, self.anchor_index)
        return [*self.anchor_ids, *self.tag_ids], first, second

    def with_anchors(self, anchor_ids: Collection[str]) -> RangeLog:
        """Return the log with nodes of these ids as anchors and all others as tags; equal ids are one node."""
        ids, first, second = self._ends()
        node_of = {node_id: node for node, node_id in enumerate(dict.fromkeys(ids))}
        node = np.array([node_of[node_id] for node_id in ids], dtype=np.int64)
        is_anchor = np.array([node_id in anchor_ids for node_id in node_of], dtype=bool)
        return self._between(list(node_of), is_anchor, node[first], node[second])

    def _between(self, ids: list[str], is_anchor: Mask, first: Indices, second: Indices) -> RangeLog:
        """Return the ranges between nodes of a new list; nodes without ranges are dropped.

        Args:
            ids: ids of the nodes.
            is_anchor: for each node, whether it is an anchor.
            first, second: (n,) indices of both ends in ``ids``.
        """
        swapped = is_anchor[first] & ~is_anchor[second]
        first, second = np.where(swapped, second, first), np.where(swapped, first, second)
        peer = np.where(is_anchor[first], first, np.where(is_anchor[second], -1, second))
        with_ranges = np.unique(np.concatenate([first, second])).tolist()
        in_order = sorted(with_ranges, key=lambda node: _as_people_count(ids[node]))
        anchors = [node for node in in_order if is_anchor[node]]
        tags = [node for node in in_order if not is_anchor[node]]
        # The last entry is for the index -1, which means no node.
        index = np.full(len(ids) + 1, -1)
        index[anchors], index[tags] = np.arange(len(anchors)), np.arange(len(tags))
        return replace(
            self,
            anchor_ids=tuple(ids[node] for node in anchors),
            anchor_index=index[np.where(is_anchor[second], second, -1)],
            tag_ids=tuple(ids[node] for node in tags),
            tag_index=index[np.where(is_anchor[first], -1, first)],
            peer_index=index[peer],
        )

    def subset(self, rows: Indices | Mask) -> RangeLog:
        """Return the log with some of its ranges; anchors and tags without ranges are dropped."""
        index = np.flatnonzero(rows) if rows.dtype == np.bool_ else rows.astype(np.int64)
        columns: dict[str, Any] = {
            name: values[index]
            for name in (each.name for each in fields(self))
            if isinstance(values := getattr(self, name), np.ndarray)
        }
        chosen = replace(self, moments=self.moments.subset(index), **columns)
        ids, first, second = chosen._ends()
        return chosen._between(ids, np.arange(len(ids)) < len(self.anchor_ids), first, second)

    def lever_arms(self, tag_in_cam_m: npt.ArrayLike) -> Array:
        """Return the lever arm of each tag (num_tags, 3), in the order of ``tag_ids``.

        Args:
            tag_in_cam_m: (3,) one lever arm for all tags, or (num_tags, 3) one for each.

        Raises:
            InputError: it has another shape.
        """
        given = np.asarray(tag_in_cam_m, dtype=np.float64)
        num_tags = len(self.tag_ids)
        if given.shape not in ((3,), (num_tags, 3)):
            raise InputError(
                f"lever arms of shape {given.shape} for a log of {num_tags} tag(s), expected (3,) or ({num_tags}, 3)",
                self.source,
            )
        return np.broadcast_to(given, (num_tags, 3))

    @staticmethod
    def from_arrays(
        anchor_id: Sequence[str] | npt.NDArray[np.str_] | Categories,
        range_m: npt.ArrayLike,
        *,
        timestamp_s: npt.ArrayLike = (),
        image_name: Sequence[str] = (),
        range_stddev_m: npt.ArrayLike | None = None,
        tag_id: Sequence[str] | Categories | None = None,
        los: npt.ArrayLike | None = None,
        line: npt.ArrayLike | None = None,
        **of_log: Any,
    ) -> RangeLog:
        """Build a log from one value (or one string) per range, by time or by photo; other columns may be left out.

        Each range is between the tag and the anchor of its row. ``with_anchors`` afterwards finds the ranges between
        two anchors or two tags.

        Args:
            of_log: ``source``, ``format``, ``num_no_measurement`` and ``notes``.
        """
        n = np.size(range_m)
        times_s, photos = np.asarray(timestamp_s, np.float64), tuple(image_name)
        if len(times_s) and photos:
            raise ValueError("a range log has either timestamps or image names")
        anchor = _categories(anchor_id)
        tag = _categories([DEFAULT_TAG_ID] * n if tag_id is None else tag_id)
        return RangeLog(
            anchor_ids=anchor.names,
            anchor_index=anchor.index,
            range_m=np.asarray(range_m, np.float64),
            moments=ByTime(times_s) if len(times_s) else ByPhoto(photos),
            range_stddev_m=np.full(n, np.nan) if range_stddev_m is None else np.asarray(range_stddev_m, np.float64),
            shared_stddev_m=np.full(n, np.nan),
            tag_ids=tag.names,
            tag_index=tag.index,
            peer_index=np.full(n, -1),
            los=np.full(n, -1, np.int8) if los is None else np.asarray(los, np.int8),
            line=np.arange(1, n + 1) if line is None else np.asarray(line, np.int64),
            **of_log,
        )


def _categories(ids: Sequence[str] | npt.NDArray[np.str_] | Categories) -> Categories:
    found = (
        ids
        if isinstance(ids, Categories)
        else Categories.from_texts(ids if isinstance(ids, Sequence) else ids.tolist())
    )
    order = sorted(range(len(found.names)), key=lambda k: _as_people_count(found.names[k]))
    return Categories(tuple(found.names[k] for k in order), np.argsort(order)[found.index])


def _as_people_count(name: str) -> tuple[list[tuple[str, int, str]], str]:
    """Return a key for natural order, which sorts A2 before A10."""
    parts = [(text, digits.lstrip("0")) for text, digits in re.findall("([^0-9]*)([0-9]*)", name)]
    return [(text, len(number), number) for text, number in parts], name

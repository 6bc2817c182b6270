"""Summary of a range log in a few numbers."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from rangesfm.arrays import Array, Mask
from rangesfm.measurements.ranges.errors.noise import estimate_noise_m, find_quantization_m, quantization_stddev_m
from rangesfm.measurements.ranges.range_log import RangeKind, RangeLog
from rangesfm.util.geometry.moments import ByPhoto, ByTime


@dataclass(frozen=True)
class LinkSummary:
    """Summary of the ranges from tags to one anchor, between two anchors, or between two tags.

    Attributes:
        kind: "tag-anchor", "anchor-anchor" or "tag-tag".
        ids: the anchor, or both ends.
        num: number of ranges.
        min_m, median_m, max_m: shortest, median and longest range.
        largest_gap_s: longest time without such a range; NaN without times, or if the kind is not "tag-anchor".
        noise_stddev_m: standard deviation of the noise, estimated from the log itself, at least that of its rounding;
            NaN in the same cases, and with too few ranges.
    """

    kind: str
    ids: tuple[str, ...]
    num: int
    min_m: float
    median_m: float
    max_m: float
    largest_gap_s: float = math.nan
    noise_stddev_m: float = math.nan


@dataclass(frozen=True)
class RangeSummary:
    """Summary of a whole log; times are NaN if it has image names instead.

    Attributes:
        format: name of the reader.
        num: number of ranges.
        num_no_measurement: number of records that contain no measurement.
        num_duplicates: ranges that repeat an earlier one, with the same time, tag, anchor and range.
        num_out_of_order: ranges that are earlier than the one before them.
        quantization_m: step to which all ranges seem to be rounded; 0 if there is none.
        tag_ids: ids of the tags.
        start_s, end_s: first and last time on the radio's clock.
        rate_hz: ranges per second over the whole time.
        largest_gap_s: longest time without a range to any anchor.
        anchors: the anchors that tags range with, in the order of the log's ``anchor_ids``.
        pairs: the pairs of anchors, then the pairs of tags, that range with each other.
    """

    format: str
    num: int
    num_no_measurement: int
    num_duplicates: int
    num_out_of_order: int
    quantization_m: float
    tag_ids: tuple[str, ...]
    start_s: float
    end_s: float
    rate_hz: float
    largest_gap_s: float
    anchors: tuple[LinkSummary, ...]
    pairs: tuple[LinkSummary, ...]


def summarize_ranges(log: RangeLog) -> RangeSummary:
    """Compute the summary of a log."""
    start = end = rate = math.nan
    if isinstance(log.moments, ByTime) and len(log):
        start, end = float(log.timestamp_s.min()), float(log.timestamp_s.max())
        rate = (len(log) - 1) / (end - start) if end > start else math.nan
    quantization = find_quantization_m(log.range_m) or 0.0
    return RangeSummary(
        format=log.format,
        num=len(log),
        num_no_measurement=log.num_no_measurement,
        num_duplicates=_num_duplicates(log),
        num_out_of_order=int(np.count_nonzero(np.diff(log.timestamp_s) < 0)),
        quantization_m=quantization,
        tag_ids=log.tag_ids,
        start_s=start,
        end_s=end,
        rate_hz=rate,
        largest_gap_s=_largest_gap(log.timestamp_s),
        anchors=tuple(
            _summarize_anchor(log, index, quantization)
            for index in np.unique(log.anchor_index[log.kind == RangeKind.TAG_ANCHOR]).tolist()
        ),
        pairs=(
            *_summarize_pairs(log, "anchor-anchor", RangeKind.ANCHOR_ANCHOR),
            *_summarize_pairs(log, "tag-tag", RangeKind.TAG_TAG),
        ),
    )


def _summarize_pairs(log: RangeLog, name: str, kind: RangeKind) -> Iterator[LinkSummary]:
    """Yield the summary of each pair of nodes, with the ranges of both directions."""
    ends, rows = list(zip(*log.end_ids(), strict=True)), dict[frozenset[str], list[int]]()
    for row in np.flatnonzero(log.kind == kind).tolist():
        rows.setdefault(frozenset(ends[row]), []).append(row)
    for mine in rows.values():
        yield LinkSummary(name, ends[mine[0]], *_lengths(log.range_m[mine]))


def _summarize_anchor(log: RangeLog, index: int, quantization_m: float) -> LinkSummary:
    mine = (log.anchor_index == index) & (log.kind == RangeKind.TAG_ANCHOR)
    gap_s = _largest_gap(log.timestamp_s[mine])
    noise_m = _noise(log, mine, quantization_m)
    return LinkSummary("tag-anchor", (log.anchor_ids[index],), *_lengths(log.range_m[mine]), gap_s, noise_m)


def _lengths(range_m: Array) -> tuple[int, float, float, float]:
    return len(range_m), float(range_m.min()), float(np.median(range_m)), float(range_m.max())


def _noise(log: RangeLog, mine: Mask, quantization_m: float) -> float:
    """Return the noise of the ranges between one anchor and the tag with the most ranges to it.

    Only one tag is used, because each tag has a path of its own.
    """
    if isinstance(log.moments, ByPhoto):
        return math.nan
    mine = mine & (log.tag_index == np.argmax(np.bincount(log.tag_index[mine])))
    noise = estimate_noise_m(log.timestamp_s[mine], log.range_m[mine])
    return math.nan if noise is None else max(noise, quantization_stddev_m(quantization_m))


def _num_duplicates(log: RangeLog) -> int:
    columns = (log.timestamp_s, log.anchor_index, log.tag_index, log.peer_index, log.range_m)
    order = np.lexsort(columns)
    same = np.logical_and.reduce([np.diff(column[order]) == 0 for column in columns])
    return int(np.count_nonzero(same))


def _largest_gap(timestamps_s: Array) -> float:
    return float(np.diff(np.sort(timestamps_s)).max()) if len(timestamps_s) > 1 else math.nan

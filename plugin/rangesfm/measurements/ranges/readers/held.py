"""Values that a logger holds until the next one comes: rows at a fixed rate, or of all anchors where one is new."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rangesfm.arrays import Array, Indices, rows_by_key
from rangesfm.measurements.ranges.range_log import RangeLog

# A radio that rounds its ranges may measure the same value again, but not where values jump by several steps of the
# rounding: with noise or motion of k steps, a value repeats with a probability of about 0.4/k. Values between two such
# jumps that are nearly all repeated are held. So are values between larger jumps of which fewer are repeated, if few
# are repeated more than once; they are in a log that is little faster than the radio. A few jumps say nothing, because
# in steady motion the jumps beside a repeated value are larger.
_JUMP_STEPS, _HELD_SHARE, _MIN_SHARE_BETWEEN = 1.5, 0.7, 0.1
_LARGE_JUMP_STEPS, _SOMETIMES_HELD_SHARE, _MIN_SHARE_FAR_BETWEEN, _MOST_HELD_LONGER = 4.5, 0.3, 0.3, 0.2
_MIN_NUM = 15  # values between two jumps, from which something follows
_STEP_PERCENTILE = 5.0  # of the differences between neighbouring values; some may be between the steps


def without_held(log: RangeLog) -> RangeLog:
    """Return the log without repetitions of values that were held, with a note; the log itself if there are none.

    The first of equal values stays, at the time at which it came.
    """
    if log.timestamp_s is None:
        return log
    firsts: list[Indices] = []
    lengths, jumps = [np.zeros(0, np.int64)], [np.zeros(0)]
    for rows in rows_by_key(log.tag_index, log.anchor_index, log.peer_index) if len(log) else ():
        rows = rows[np.argsort(log.timestamp_s[rows], kind="stable")]
        values = log.range_m[rows]
        begins = np.flatnonzero(np.concatenate([[True], np.diff(values) != 0]))
        firsts.append(rows[begins])
        steps = np.diff(np.unique(values))
        if len(begins) > 2:
            sizes = np.abs(np.diff(values[begins])) / np.percentile(steps, _STEP_PERCENTILE)
            lengths.append(np.diff(begins)[1:])
            jumps.append(np.minimum(sizes[:-1], sizes[1:]))
    kept = np.sort(np.concatenate([np.zeros(0, np.int64), *firsts]))
    if not _are_held(np.concatenate(lengths), np.concatenate(jumps)):
        return log
    note = (
        f"each range is repeated about {len(log) / len(kept):.3g} times: the log holds the last range until the next; "
        f"only the first of each is used, {len(kept)} of {len(log)}"
    )
    return replace(log.subset(kept), notes=(*log.notes, note))


def _are_held(lengths: Indices, jumps: Array) -> bool:
    """Return whether values are held.

    Args:
        lengths: (n,) how often each value comes in a row.
        jumps: (n,) the smaller of the jumps before and after it, in steps of the rounding.
    """
    between, far_between = lengths[jumps > _JUMP_STEPS], lengths[jumps > _LARGE_JUMP_STEPS]
    if len(between) >= max(_MIN_NUM, _MIN_SHARE_BETWEEN * len(lengths)) and np.mean(between > 1) > _HELD_SHARE:
        return True
    return bool(
        len(far_between) >= max(_MIN_NUM, _MIN_SHARE_FAR_BETWEEN * len(lengths))
        and np.mean(far_between > 1) > _SOMETIMES_HELD_SHARE
        and np.mean(far_between > 2) < _MOST_HELD_LONGER
    )

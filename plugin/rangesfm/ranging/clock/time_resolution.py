"""How coarsely a log's times are written down: whole seconds of a host, or lines that arrive in batches."""

from __future__ import annotations

import numpy as np

from rangesfm.ranging.log import RangeLog

# Two ranges of one radio to another take time: if this share of them has the time of the one before, it was rounded.
_MIN_REPEATED_SHARE = 0.25


def time_resolution_s(log: RangeLog) -> float:
    """The step of the log's times, seconds; 0 if none is seen.

    Any step is seen that is longer than the ranges between one tag and one anchor are apart.
    """
    times = log.timestamp_s
    if times is None or len(log) < 2:
        return 0.0
    link = log.tag_index * len(log.anchor_ids) + log.anchor_index
    order = np.lexsort((times, link))
    same_link = np.diff(link[order]) == 0
    steps = np.diff(times[order])[same_link]
    if not len(steps) or np.mean(steps == 0) < _MIN_REPEATED_SHARE:
        return 0.0
    between = np.diff(np.unique(times))
    return float(np.median(between)) if len(between) else 0.0

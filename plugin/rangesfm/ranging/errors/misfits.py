"""Whether ranges fit as their errors let expect."""

from __future__ import annotations

import numpy as np

from rangesfm.arrays import Array, Indices
from rangesfm.ranging.errors.noise import robust_stddev
from rangesfm.ranging.errors.range_errors import RangeErrors

# Median block residuals beyond this many stddevs are no noise.
_MAX_BLOCK_STDDEVS = 3.0
_MIN_BLOCK = 5
# Real radios' errors stay alike for seconds; that makes their residuals twice as large as their scatter, not this.
_MAX_STDDEV_OVER_SCATTER = 5.0
_MIN_SCATTER_M = 0.01
_MIN_DIFFERENCES = 20


def misfits(errors: RangeErrors, residuals_m: Array, time_order: Array) -> tuple[str, ...]:
    """Why ranges that took part do not fit as their noise lets expect; empty if they do.

    Args:
        errors, residuals_m: of the k ranges that took part. time_order: (k,) anything that grows with time.
    """
    if not len(residuals_m):
        return ()
    reasons = []
    stated = residuals_m / errors.stddev_m
    typical = robust_stddev(stated)
    if len(stated) >= _MIN_DIFFERENCES and typical > _MAX_BLOCK_STDDEVS:
        reasons.append(f"range residuals are typically {typical:.1f} times their stddev")
    off = [np.median(stated[rows]) for rows in _by_group(errors.group) if len(rows) >= _MIN_BLOCK]
    num_off = int(np.sum(np.abs(off) > _MAX_BLOCK_STDDEVS))
    if num_off:
        reasons.append(f"in {num_off} of {len(off)} stretches of time the ranges to an anchor are off as a whole")
    order = np.lexsort((time_order, errors.anchor_index))
    steps = np.diff(residuals_m[order])[np.diff(errors.anchor_index[order]) == 0]
    if len(steps) >= _MIN_DIFFERENCES:
        scatter = max(robust_stddev(steps) / np.sqrt(2), _MIN_SCATTER_M)
        size = robust_stddev(residuals_m)
        if size > _MAX_STDDEV_OVER_SCATTER * scatter:
            reasons.append(f"range residuals ({size:.2f} m) are far larger than the ranges' scatter ({scatter:.2f} m)")
    return tuple(reasons)


def _by_group(labels: Indices) -> list[Indices]:
    order = np.argsort(labels, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(labels[order])) + 1)

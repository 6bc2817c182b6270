"""How well the ranges suit the path at every offset of the clocks, for people to look at."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rangesfm.arrays import Array
from rangesfm.ranging.clock.fit import OffsetFit
from rangesfm.ranging.clock.path import PathSamples
from rangesfm.ranging.clock.search import scan_offsets

_NUM_COARSE = 160
# Around the best offset all are shown: at least this far, and so many stddevs.
_FINE_REACH_S = 1.0
_FINE_REACH_STDDEVS = 6.0
_MAX_NUM_FINE = 200


@dataclass(frozen=True)
class CostCurve:
    """What offsets of the clocks cost.

    Attributes:
        offsets_s: (m,) increasing: all offsets at which log and photos overlap, closer together
            near the best one.
        costs_m: (m,) root mean square of the residuals of the ranges on the path, with the anchors and the scale that
            suit each offset best; each range weighs as it does at the best offset.
    """

    offsets_s: Array
    costs_m: Array


def cost_curve(best: OffsetFit, path: PathSamples, stddev_s: float) -> CostCurve:
    """The best offset of each stretch of all, and those around the best of all; ``stddev_s``: of that one."""
    scanned = scan_offsets(best.ranges, path, best.squares.weights)
    from_best_s = np.abs(scanned.offsets_s - best.offset_s)
    near = np.flatnonzero(from_best_s < max(_FINE_REACH_S, _FINE_REACH_STDDEVS * stddev_s))
    fine = near[np.argsort(from_best_s[near])[:_MAX_NUM_FINE]]
    stretches = np.array_split(np.arange(len(from_best_s)), min(_NUM_COARSE, len(from_best_s)))
    coarse = [rows[np.argmin(scanned.costs_m[rows])] for rows in stretches]
    shown = np.unique(np.concatenate([fine, coarse]))
    return CostCurve(scanned.offsets_s[shown], scanned.costs_m[shown])

"""How well the ranges suit the path at every offset of the clocks, for people to look at."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rangesfm.arrays import Array
from rangesfm.ranging.clock.fit import OffsetFit, fit_at_offset
from rangesfm.ranging.clock.path import PathSamples
from rangesfm.ranging.clock.search import OffsetCurve, TimedRanges, ranges_on_path

_NUM_COARSE = 160
_NUM_FINE = 81
# Around the best offset: at least this far, and so many stddevs.
_FINE_REACH_S = 1.0
_FINE_REACH_STDDEVS = 6.0
_NUM_RANGES = 600


@dataclass(frozen=True)
class CostCurve:
    """What offsets of the clocks cost.

    Attributes:
        offsets_s: (m,) increasing: all offsets at which log and photos overlap, closer together
            near the best one.
        costs_m: (m,) robust stddev (1.4826 times the median of the absolute values) of the
            residuals of the ranges on the path, with the anchors and the scale that suit each
            offset best, corrected for the number of these unknowns.
    """

    offsets_s: Array
    costs_m: Array


def cost_curve(
    ranges: TimedRanges, path: PathSamples, scanned: OffsetCurve, best: OffsetFit, stddev_s: float, cell_s: float
) -> CostCurve:
    """The best offset of each stretch of those scanned, and evenly spaced ones around the best of all.

    Args:
        ranges: of all anchors.
        path: of the moving camera.
        scanned: all offsets.
        best: the fit at the offset found.
        stddev_s: of that offset.
        cell_s: ranges to one anchor within such a time count as one measurement.
    """
    reach_s = max(_FINE_REACH_S, _FINE_REACH_STDDEVS * stddev_s)
    fine = best.offset_s + reach_s * np.linspace(-1, 1, _NUM_FINE)
    coarse = _best_of_each_stretch(scanned)
    coarse = coarse[np.abs(coarse - best.offset_s) > reach_s]
    offsets, costs = [], []
    for offset_s in np.sort(np.concatenate([coarse, fine])).tolist():
        near = ranges_on_path(ranges, path, offset_s, _NUM_RANGES, seed=0)
        if len(near.range_m):
            fit = fit_at_offset(near, path, offset_s, cell_s, best.squares.scale)
            if fit.is_testable:
                offsets.append(offset_s)
                costs.append(fit.residual_stddev_m)
    return CostCurve(np.array(offsets), np.array(costs))


def _best_of_each_stretch(scanned: OffsetCurve) -> Array:
    if len(scanned.offsets_s) <= _NUM_COARSE:
        return scanned.offsets_s
    stretches = np.array_split(np.arange(len(scanned.offsets_s)), _NUM_COARSE)
    return scanned.offsets_s[[rows[np.argmax(scanned.scores[rows])] for rows in stretches]]

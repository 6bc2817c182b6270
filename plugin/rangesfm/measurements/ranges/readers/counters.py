"""Clocks that count up to a power of two and then begin again at 0, such as microseconds in 32 bits."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rangesfm.arrays import Array
from rangesfm.measurements.ranges.twr import DW1000_TICK_S

# Counters in order of preference, as bits and unit: those of the numbers in the file, those of another unit, and the
# clock of a DW1000.
_DECADES = 10.0 ** np.arange(-6, 7, 3)
_COUNTERS = (
    *((bits, 1.0) for bits in (16, 24, 32, 40)),
    *((bits, decade) for bits in (16, 24, 32) for decade in _DECADES if decade != 1),
    *((40, DW1000_TICK_S * decade) for decade in 10.0 ** np.arange(0, 10, 3)),
)
# A clock goes back if a step is below minus this share of all times' span. If more than a share of the steps does, the
# rows are in no order.
_BACK_SHARE, _MOST_GOING_BACK = 0.25, 0.15
# A step back fits a counter if what remains is no longer than a few of the longer intervals between times, or than a
# share of the counter's period; then the log has a gap there.
_NUM_USUAL, _USUAL_PERCENTILE, _GAP_SHARE = 2.0, 99.0, 0.02
# A counter of a period that is not far longer than the intervals cannot be told from another.
_LONGEST_INTERVAL_SHARE = 0.1
_LATE_SHARE = 0.95  # a step forward by more than this share of the period leads to a late row from before the wrap


class Counter(NamedTuple):
    """A counter that begins again at 0.

    Attributes:
        bits, period: its size, and after how much it begins again, in the unit of the file.
        num_wraps: how often it begins again.
    """

    bits: int
    period: float
    num_wraps: int

    @property
    def counts_dw1000_ticks(self) -> bool:
        """Whether the numbers in the file are ticks of a DW1000, whose clock is the one that has 40 bits."""
        return self.period == 2.0**40

    def __str__(self) -> str:
        times = "once" if self.num_wraps == 1 else f"{self.num_wraps} times"
        return f"is a counter of {self.bits} bits that begins again at 0 {times} (after {self.period:.10g})"


def continued(times: Array) -> tuple[Array, Counter | None]:
    """Return times (n,) that do not go back where a counter begins again, and the counter; None if there is none.

    Args:
        times: in the order of the log, in any unit.
    """
    steps, span = np.diff(times), float(np.ptp(times)) if len(times) else 0.0
    back, forward = steps[steps < -_BACK_SHARE * span], steps[steps > 0]
    if not len(forward) or not 0 < len(back) <= _MOST_GOING_BACK * len(steps):
        return times, None
    # In a log of several cycles the steps forward do not contain the wraps themselves.
    usual = _NUM_USUAL * float(np.percentile(forward, _USUAL_PERCENTILE))
    for bits, unit in _COUNTERS:
        period = float(2.0**bits * unit)
        rest = period + float(back.min())  # of the largest step back, which has the smallest gap
        if span <= period and usual <= _LONGEST_INTERVAL_SHARE * period and rest <= max(usual, _GAP_SHARE * period):
            break
    else:
        return times, None
    turns = np.cumsum((steps < -_BACK_SHARE * span).astype(np.int64) - (steps > _LATE_SHARE * period))
    return times + period * np.concatenate([[0], turns]), Counter(bits, period, int(turns.max()))

"""Clocks that do not run at the same rate: the offset with a drift, where the ranges show one."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rangesfm.arrays import Array
from rangesfm.ranging.clock.fit import OffsetFit, Timing, refine_offset
from rangesfm.ranging.clock.path import PathSamples
from rangesfm.ranging.clock.search import TimedRanges

# A drift of fewer stddevs than this may be chance and is left alone.
_MIN_STDDEVS = 3.0
_MAX_NUM_STEPS = 6
_CONVERGED_STDDEVS = 0.05


class ClockFit(NamedTuple):
    """Offset and drift of the clocks.

    Attributes:
        fit: at the offset, of ranges whose times are freed of the drift that is followed.
        timing: what that fit says of the offset, and of the drift that is left.
        followed_drift: what camera time gains on radio time, seconds a second, where it is beyond doubt; else 0.
        reference_s: radio's time at which the offset holds.
    """

    fit: OffsetFit
    timing: Timing
    followed_drift: float
    reference_s: float


def fit_clocks(ranges: TimedRanges, path: PathSamples, offset_s: float) -> ClockFit:
    """Descend to the offset; if the ranges then show a drift beyond doubt, to both.

    Args:
        ranges: (nearly) all are on the path at ``offset_s``.
        path: of the moving camera.
        offset_s: to start from.
    """
    reference_s = float(ranges.times_s.mean())
    fit = refine_offset(ranges, path, offset_s)
    timing, followed, least_stddevs = fit.timing(), 0.0, _MIN_STDDEVS
    for _ in range(_MAX_NUM_STEPS):
        if not abs(timing.drift) > least_stddevs * timing.drift_stddev:
            break
        followed, least_stddevs = followed + timing.drift, _CONVERGED_STDDEVS
        fit = refine_offset(without_drift(ranges, followed, reference_s), path, fit.offset_s)
        timing = fit.timing()
    return ClockFit(fit, timing, followed, reference_s)


def without_drift(ranges: TimedRanges, drift: float, reference_s: float) -> TimedRanges:
    """Ranges with times of a radio clock that runs like the camera's."""
    return ranges._replace(times_s=ranges.times_s + drift * (ranges.times_s - reference_s))


def drift_note(drift: float, stddev: float, times_s: Array) -> str:
    """What a user should know of a drift that was found."""
    half_span_s = float(np.ptp(times_s)) / 2
    return (
        f"the clocks drift: the camera's gains {1e6 * drift:+.0f} ppm on the radio's (stddev {1e6 * stddev:.0f} ppm); "
        f"this is corrected for: the time offset differs by {drift * half_span_s:+.3f} s at the end of the log from "
        f"that in its middle"
    )

"""TimeOffset: what was found of the offset between two clocks."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from rangesfm.arrays import Array


@dataclass(frozen=True)
class CostCurve:
    """Cost of time offsets.

    Attributes:
        offsets_s: (m,) offsets at which log and photos overlap, increasing, and denser near the best one.
        costs_m: (m,) root mean square of the residuals of the ranges on the path, with the anchors and the scale that
            fit best at each offset; each range has its weight at the best offset.
    """

    offsets_s: Array
    costs_m: Array


@dataclass(frozen=True)
class TimeOffset:
    """Offset of the clocks: image time = range time + ``value_s``.

    Attributes:
        value_s: the offset; if the clocks drift, at the radio's time ``reference_s``.
        stddev_s: its standard deviation, which accounts for correlated residuals.
        curve: cost of all offsets, for the report; of none where the offset was given.
        offset_matters: False if any offset near the value puts the ranges at the same photos.
        drift: gain of the camera's clock on the radio's, seconds per second.
        drift_stddev: its standard deviation; infinite if no drift was estimated.
        drift_is_followed: whether the drift is significant, so that ``at`` follows it.
        reference_s: radio's time at which the clocks differ by ``value_s``.
        note: message for the user; empty without one.
        probability: probability that the value is the right offset, and none of the rivals is.
        rivals: other offsets that cannot be ruled out, the most likely first; no drift is followed with them.
        is_certain: whether the error of a range due to ``stddev_s`` is smaller than its noise.
    """

    value_s: float
    stddev_s: float
    curve: CostCurve = CostCurve(np.zeros(0), np.zeros(0))
    offset_matters: bool = True
    drift: float = 0.0
    drift_stddev: float = np.inf
    drift_is_followed: bool = False
    reference_s: float = 0.0
    note: str = ""
    probability: float = 1.0
    rivals: tuple[TimeOffset, ...] = ()
    is_certain: bool = True

    @classmethod
    def given(cls, value_s: float) -> TimeOffset:
        """Return an offset that was not searched for."""
        return cls(value_s, 0.0)

    @property
    def is_given(self) -> bool:
        """Whether it was not searched for."""
        return not len(self.curve.offsets_s)

    def beside(self, rivals: Iterable[tuple[float, float]]) -> TimeOffset:
        """Return the offset with others that may be the right one; the drift was estimated for the present value.

        Args:
            rivals: values in seconds, and their probabilities.
        """
        others = (replace(self, value_s=at, drift_is_followed=False, probability=chance) for at, chance in rivals)
        return replace(self, rivals=tuple(others))

    def at(self, radio_times_s: Array) -> Array:
        """Return the offsets (n,) at times (n,) of the radio's clock."""
        drift = self.drift if self.drift_is_followed else 0.0
        return self.value_s + drift * (radio_times_s - self.reference_s)

"""TimeOffset: what was found of the offset between two clocks."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import maximum_filter1d

from rangesfm.arrays import Array, Indices

# Number of offsets in the curve for the report that are taken from all, and of those nearest to the best one.
_NUM_SHOWN = 200


@dataclass(frozen=True)
class OffsetCurve:
    """Fit of what was observed at each of m time offsets, with the other unknowns that fit best there.

    Attributes:
        offsets_s: (m,) offsets at which log and photos overlap, increasing; in a report denser near the best one.
        weight: (m,) sum of the weights of the observations on the path.
        variation, residual: (m,) their weighted sums of squares about their means, and about the fit.
    """

    offsets_s: Array
    weight: Array
    variation: Array
    residual: Array

    def take(self, rows: Indices) -> OffsetCurve:
        """Return some of the offsets."""
        return OffsetCurve(self.offsets_s[rows], self.weight[rows], self.variation[rows], self.residual[rows])

    @property
    def costs(self) -> Array:
        """(m,) root mean square of the residuals; each observation has its weight at the best offset."""
        return np.asarray(np.sqrt(self.residual / np.maximum(self.weight, 1.0)))

    @property
    def scores(self) -> Array:
        """(m,) logarithm of the observations' own variation over their residuals; 0 if nothing is explained."""
        return np.asarray(0.5 * np.log(self.variation / self.residual))

    def around(self, best_s: float) -> OffsetCurve:
        """Return a curve for the report: the best offset of each interval, and those nearest to the best one of all."""
        fine = np.argsort(np.abs(self.offsets_s - best_s))[:_NUM_SHOWN]
        stretches = np.array_split(np.arange(len(self.offsets_s)), min(_NUM_SHOWN, len(self.offsets_s)))
        costs = self.costs
        return self.take(np.unique([*fine, *(rows[np.argmin(costs[rows])] for rows in stretches)]))

    def peaks(self, separation_s: float, max_num: int) -> list[float]:
        """Return the offsets whose score is the highest within ``separation_s``, the best first."""
        if len(self.offsets_s) < 2:
            return list(map(float, self.offsets_s))
        step_s, scores = float(np.median(np.diff(self.offsets_s))), self.scores
        highest = maximum_filter1d(scores, 2 * round(separation_s / step_s) + 1)
        peaks = np.flatnonzero(scores == highest)
        best = peaks[np.argsort(-scores[peaks], kind="stable")[:max_num]]
        return list(map(float, self.offsets_s[best]))


NO_CURVE = OffsetCurve(*np.zeros((4, 0)))


@dataclass(frozen=True)
class TimeOffset:
    """Offset of the clocks: image time = time of the log + ``value_s``.

    Attributes:
        value_s: the offset; if the clocks drift, at the log's time ``reference_s``.
        stddev_s: its standard deviation, which accounts for correlated residuals.
        curve: cost of all offsets, for the report; of none where the offset was given.
        offset_matters: False if any offset near the value puts the observations at the same photos.
        drift: gain of the camera's clock on the log's, seconds per second.
        drift_stddev: its standard deviation; infinite if no drift was estimated.
        drift_is_followed: whether the drift is significant, so that ``at`` follows it.
        reference_s: the log's time at which the clocks differ by ``value_s``.
        note: message for the user; empty without one.
        probability: probability that the value is the right offset, and none of the rivals is.
        rivals: other offsets that cannot be ruled out, the most likely first; no drift is followed with them.
        is_certain: whether the error of an observation due to ``stddev_s`` is smaller than its noise.
    """

    value_s: float
    stddev_s: float
    curve: OffsetCurve = NO_CURVE
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

    def at(self, times_s: Array) -> Array:
        """Return the offsets (n,) at times (n,) of the log's clock."""
        drift = self.drift if self.drift_is_followed else 0.0
        return self.value_s + drift * (times_s - self.reference_s)


NO_OFFSET = TimeOffset.given(0.0)

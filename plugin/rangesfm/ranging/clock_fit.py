"""The robust fit of ranges to the path at one offset of the clocks, and how well it fixes the offset."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from rangesfm.ranging.clock_path import PathSamples
from rangesfm.ranging.clock_search import TimedRanges
from rangesfm.ranging.clock_squares import MIN_RESIDUAL_M, SquaresFit, fit_squares, robust_stddev, rows_by_anchor

Array = npt.NDArray[np.float64]

_MAX_NUM_STEPS = 12
_MAX_STEP_S = 1.0
_CONVERGED_STEP_S = 1e-4
# A descent that leaves more of its ranges than this off the path leads nowhere.
_MIN_KEPT_SHARE = 0.5
# If the other unknowns explain all but this share of the ranges' rate of change, the rest is round-off.
_MIN_OWN_RATE = 1e-3
# Residuals of real radios stay correlated for seconds: blocks this long count as independent.
_BLOCK_S = 10.0
_MIN_NUM_BLOCKS = 12
# The tag's delay makes all ranges read too long or too short by about this.
_RANGE_BIAS_STDDEV_M = 0.05
# A rival's mean log residual must exceed the best one's by this and by this many stddevs.
_MIN_LEAD = 0.05
_MIN_LEAD_STDDEVS = 3.0


class Timing(NamedTuple):
    """What ranges say of the clocks near an offset.

    Attributes:
        stddev_s: of the offset; infinite where the motion does not determine it.
        drift: what camera time gains on radio time, seconds a second.
        drift_stddev: of the drift.
        range_rate: root mean square of the ranges' rate of change, m/s.
    """

    stddev_s: float
    drift: float
    drift_stddev: float
    range_rate: float


class _MeanLoss(NamedTuple):
    """Mean Cauchy loss of residuals, and its variance if chance acts on blocks of time."""

    mean: float
    variance: float

    def is_below(self, other: _MeanLoss) -> bool:
        lead = other.mean - self.mean
        return lead > _MIN_LEAD and lead > _MIN_LEAD_STDDEVS * np.sqrt(self.variance + other.variance)


@dataclass(frozen=True)
class OffsetFit:
    """Ranges fitted to the path at one offset.

    Attributes:
        offset_s: image time - range time.
        ranges: the n on the path.
        squares: the fit of their squares.
        residuals_m: (n,) of that fit, enlarged by what its unknowns took from them.
        num_spare: how many independent ranges there are beyond the unknowns.
        deviations_m: (n,) of the ranges from their anchor's median.
        rates: (n,) change of each predicted range with the offset, m/s.
    """

    offset_s: float
    ranges: TimedRanges
    squares: SquaresFit
    residuals_m: Array
    num_spare: int
    deviations_m: Array
    rates: Array

    @property
    def score(self) -> float:
        """Natural log of how many times smaller the residuals are than the deviations (geometric means)."""
        return float(np.mean(np.log(_at_least_tiny(self.deviations_m) / _at_least_tiny(self.residuals_m))))

    @property
    def residual_stddev_m(self) -> float:
        return robust_stddev(self.residuals_m)

    @property
    def is_testable(self) -> bool:
        """Whether there are enough ranges to tell a fit from a coincidence."""
        return self.num_spare >= self.squares.num_unknowns

    def explains(self) -> bool:
        """Whether the path explains the ranges better than no motion at all."""
        stddev_m = self.residual_stddev_m
        return self._loss(self.residuals_m, stddev_m).is_below(self._loss(self.deviations_m, stddev_m))

    def beats(self, rival: OffsetFit) -> bool:
        """Whether, beyond doubt, the residuals are smaller than the rival's, or no larger while they explain more."""
        stddev_m = self.residual_stddev_m
        mine, other = self._loss(self.residuals_m, stddev_m), rival._loss(rival.residuals_m, stddev_m)
        my_gain = self._loss(self.deviations_m, stddev_m, self.residuals_m)
        other_gain = rival._loss(rival.deviations_m, stddev_m, rival.residuals_m)
        return mine.is_below(other) or (mine.mean <= other.mean and other_gain.is_below(my_gain))

    def fits_better_than(self, rival: OffsetFit) -> bool:
        """Whether the residuals are smaller than the rival's, be it by chance."""
        stddev_m = self.residual_stddev_m
        return self._loss(self.residuals_m, stddev_m).mean < rival._loss(rival.residuals_m, stddev_m).mean

    def _loss(self, errors_m: Array, stddev_m: float, less_errors_m: Array | None = None) -> _MeanLoss:
        loss = 0.5 * np.log1p((errors_m / stddev_m) ** 2)
        if less_errors_m is not None:
            loss -= 0.5 * np.log1p((less_errors_m / stddev_m) ** 2)
        block = _blocks(self.ranges.times_s)
        mean = float(loss.mean())
        excess = np.bincount(block, loss - mean)
        return _MeanLoss(mean, float(excess @ excess) / len(loss) ** 2 * len(excess) / max(len(excess) - 1, 1))

    def timing(self) -> Timing:
        """Offset and drift with stddevs that allow for residuals correlated within blocks of time."""
        times = self.ranges.times_s - self.ranges.times_s.mean()
        own = self.squares.unexplained(np.stack([self.rates, self.rates * times], axis=1))
        range_rate = float(np.sqrt(np.mean(self.rates**2)))
        if not _is_determined(own[:, 0], self.rates):
            return Timing(np.inf, 0.0, np.inf, range_rate)
        alone, both = _covariance(own[:, :1], self.squares, times), _covariance(own, self.squares, times)
        drift = np.linalg.lstsq(own, self.squares.weighted_residuals, rcond=None)[0][1]
        return Timing(float(np.sqrt(alone[0, 0])), float(drift), float(np.sqrt(both[1, 1])), range_rate)


def refine_offset(ranges: TimedRanges, path: PathSamples, offset_s: float, cell_s: float) -> OffsetFit:
    """Descend from an offset to the nearest one that explains the ranges best (Gauss-Newton).

    Args:
        ranges: (nearly) all are on the path at that offset.
        path: of a moving camera.
        offset_s: to start from.
        cell_s: ranges to one anchor within such a time count as one measurement.
    """
    found = fit_at_offset(ranges, path, offset_s, cell_s)
    for num_steps in range(_MAX_NUM_STEPS):
        own = found.squares.unexplained(found.rates[:, None])[:, 0]
        if not _is_determined(own, found.rates):
            break
        step_s = float(own @ found.squares.weighted_residuals / (own @ own))
        # The first steps also bring in the lever arm, which needs the scale.
        if abs(step_s) < _CONVERGED_STEP_S and num_steps >= 2:
            break
        offset_s = found.offset_s + float(np.clip(step_s, -_MAX_STEP_S, _MAX_STEP_S))
        if np.mean(path.knows(ranges.times_s + offset_s)) < _MIN_KEPT_SHARE:
            break
        found = fit_at_offset(ranges, path, offset_s, cell_s, found.squares.scale)
    return found


def fit_at_offset(
    ranges: TimedRanges, path: PathSamples, offset_s: float, cell_s: float, scale: float = np.inf
) -> OffsetFit:
    """Fit the ranges that an offset puts on the path.

    Args:
        scale: metres per model unit, for the lever arm; infinite to leave it out.
    """
    ranges = ranges.take(path.knows(ranges.times_s + offset_s))
    points, velocities = path.tag(ranges.times_s + offset_s, ranges.tag, scale)
    squares = fit_squares(points, ranges.range_m, ranges.anchor)
    deviations = ranges.range_m.copy()
    for rows in rows_by_anchor(ranges.anchor):
        deviations[rows] -= np.median(deviations[rows])
    num_cells = np.unique(np.stack([np.floor(ranges.times_s / cell_s), ranges.anchor]), axis=1).shape[1]
    num_spare = num_cells - squares.num_unknowns - 1
    residuals = squares.residuals_m * np.sqrt(num_cells / max(num_spare, 0.5))
    rates = np.einsum("ni,ni->n", squares.gradient, velocities)
    return OffsetFit(offset_s, ranges, squares, residuals, num_spare, deviations, rates)


def _at_least_tiny(values: Array) -> Array:
    return np.maximum(np.abs(values), MIN_RESIDUAL_M)


def _is_determined(own: Array, rates: Array) -> bool:
    """Whether the offset changes the ranges in a way that nothing else could."""
    return bool(own @ own > _MIN_OWN_RATE**2 * (rates @ rates))


def _blocks(times: Array) -> npt.NDArray[np.int64]:
    """(n,) number of the block of time each range falls into, without gaps."""
    block_s = max(min(_BLOCK_S, float(np.ptp(times)) / _MIN_NUM_BLOCKS), 1e-9)
    return np.unique(np.floor((times - times.min()) / block_s), return_inverse=True)[1]


def _covariance(own: Array, squares: SquaresFit, times: Array) -> Array:
    """(k, k) covariance of an M-estimate whose residuals are correlated within blocks of time.

    The sandwich H^-1 (sum of g g^T) H^-1 with H the curvature of the robust loss and g each
    block's gradient (Liang and Zeger, Biometrika 1986), and what a constant bias of all ranges does.
    """
    block = _blocks(times)
    curvature = own.T @ (own * (2 * squares.weights - 1)[:, None])
    scores = own * squares.weighted_residuals[:, None]
    gradients = np.stack([np.bincount(block, column) for column in scores.T], axis=1)
    inverse = np.linalg.pinv(curvature)
    sandwich = inverse @ (gradients.T @ gradients) @ inverse * len(gradients) / max(len(gradients) - 1, 1)
    shift = np.linalg.lstsq(own, _RANGE_BIAS_STDDEV_M * np.sqrt(squares.weights), rcond=None)[0]
    return np.asarray(sandwich + np.outer(shift, shift))

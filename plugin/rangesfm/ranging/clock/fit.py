"""The robust fit of ranges to the path at one offset of the clocks, how well it fixes the offset, and their drift."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy import special

from rangesfm.arrays import Array, Indices
from rangesfm.ranging.clock.search import PathSamples, TimedRanges
from rangesfm.ranging.clock.squares import SquaresFit, fit_squares, residual_stddev, rows_by_anchor

# Ranges to one anchor within a second say much the same where people carry the camera.
_CELL_S = 1.0
_MIN_NUM_STEPS, _MAX_NUM_STEPS = 2, 12
_MAX_STEP_S = 1.0
_CONVERGED_STEP_S = 1e-4
# Twice the residuals, and what that makes of the log of the odds.
_FAR_BEHIND, _HOPELESS = float(np.log(2)), 30.0
# A descent that leaves more of its ranges than this off the path leads nowhere.
_MIN_KEPT_SHARE = 0.5
# If the other unknowns explain all but this share of the ranges' rate of change, the rest is round-off.
_MIN_OWN_RATE = 1e-3
# Residuals of real radios stay correlated for seconds: blocks this long count as independent.
_BLOCK_S = 10.0
_MIN_NUM_BLOCKS = 12
# How long they stay so is not known: the stddev is that of the mean variance with so many blocks of time.
_JACKKNIFE_NUM_BLOCKS = (6, 12, 24)
# In longer logs than this there are more of them, of 40, 20 and 10 s.
_LONG_LOG_S = 240.0
# Without one block the others must still determine everything: of columns of length one.
_MIN_LEFT_CURVATURE = 1e-6
# The tag's delay makes all ranges read too long or too short by about this.
_RANGE_BIAS_STDDEV_M = 0.05
# The path explains the ranges if they are likelier on it by this many stddevs, as blocks of time have them: the best
# of some hundred offsets of a log of another walk reaches 6, of Student's distribution with a dozen blocks.
_MIN_GAIN_STDDEVS = 7.0
# A drift of fewer stddevs than this may be chance and is left alone.
_MIN_STDDEVS = 3.0
_MAX_NUM_DRIFTS = 6
_CONVERGED_STDDEVS = 0.05


class Timing(NamedTuple):
    """What ranges say of the clocks near an offset.

    Attributes:
        stddev_s: of the offset; infinite where the motion does not determine it.
        drift: what camera time gains on radio time, seconds a second.
        drift_stddev: of the drift.
    """

    stddev_s: float
    drift: float
    drift_stddev: float


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
    def residual_stddev_m(self) -> float:
        return residual_stddev(self.residuals_m)

    @property
    def is_testable(self) -> bool:
        """Whether there are enough ranges to tell a fit from a coincidence."""
        return self.num_spare >= self.squares.num_unknowns

    @cached_property
    def losses(self) -> Array:
        """(n,) negative log likelihood of each residual, up to a constant."""
        return _losses(self.residuals_m)

    @cached_property
    def gains(self) -> Array:
        """(n,) by how much each range's log likelihood is greater than if the camera stood still."""
        return _losses(self.deviations_m) - self.losses

    @property
    def score(self) -> float:
        """Mean gain: near the log of how many times smaller the residuals are than the deviations."""
        return float(self.gains.mean())

    @property
    def num_independent(self) -> float:
        """As many ranges that err each on its own say as much: errors that hang together vary more by block of time."""
        variance = _variance_of_mean(self.losses, self.ranges.times_s)
        return min(self.num_spare, float(np.var(self.losses)) / max(variance, 1e-300))

    def explains(self) -> bool:
        """Whether the path explains the ranges better than no motion at all."""
        least = _MIN_GAIN_STDDEVS * np.sqrt(_variance_of_mean(self.gains, self.ranges.times_s))
        return bool(self.score > least)

    def is_hopeless_beside(self, rival: OffsetFit) -> bool:
        """Whether its residuals are so much larger that what is left of a descent makes no difference."""
        behind = rival.score - self.score
        return behind > _FAR_BEHIND and behind * min(self.num_independent, rival.num_independent) > _HOPELESS

    def timing(self) -> Timing:
        """Offset and drift with stddevs that allow for residuals correlated within blocks of time."""
        times = self.ranges.times_s - self.ranges.times_s.mean()
        own = self.squares.unexplained(np.stack([self.rates, self.rates * times], axis=1))
        if not _is_determined(own[:, 0], self.rates):
            return Timing(np.inf, 0.0, np.inf)
        residuals = self.squares.weighted_residuals
        change = np.linalg.lstsq(own, residuals, rcond=None)[0]
        alone = self._variances(own[:, :1], residuals, times)
        both = self._variances(own, residuals - own @ change, times)
        return Timing(float(np.sqrt(alone[0])), float(change[1]), float(np.sqrt(both[1])))

    def _variances(self, own: Array, residuals: Array, times: Array) -> Array:
        """(k,) of the unknowns with columns ``own``, from chance and from a constant bias of all ranges."""
        span_s = float(np.ptp(times))
        num_blocks = [max(num, round(num * span_s / _LONG_LOG_S)) for num in _JACKKNIFE_NUM_BLOCKS]
        by_chance = _jackknife_variances(own, residuals, self.squares, [_blocks(times, num) for num in num_blocks])
        by_bias = np.linalg.lstsq(own, _RANGE_BIAS_STDDEV_M * np.sqrt(self.squares.weights), rcond=None)[0]
        return np.asarray(np.mean(by_chance, axis=0) + by_bias**2)


def refine_offset(ranges: TimedRanges, path: PathSamples, offset_s: float, rival: OffsetFit | None = None) -> OffsetFit:
    """Descend from an offset, at which (nearly) all ranges are on the path, to the nearest one that explains them best
    (Gauss-Newton).

    Args:
        rival: far behind which it is not worth going on; None: there is none.
    """
    found = fit_at_offset(ranges, path, offset_s)
    for num_steps in range(_MAX_NUM_STEPS):
        if rival is not None and num_steps >= _MIN_NUM_STEPS and found.is_hopeless_beside(rival):
            break
        own = found.squares.unexplained(found.rates[:, None])[:, 0]
        if not _is_determined(own, found.rates):
            break
        step_s = float(own @ found.squares.weighted_residuals / (own @ own))
        # The first steps also bring in the lever arm, which needs the scale.
        if abs(step_s) < _CONVERGED_STEP_S and num_steps >= _MIN_NUM_STEPS:
            break
        offset_s = found.offset_s + float(np.clip(step_s, -_MAX_STEP_S, _MAX_STEP_S))
        if np.mean(path.knows(ranges.times_s + offset_s)) < _MIN_KEPT_SHARE:
            break
        found = fit_at_offset(ranges, path, offset_s, found.squares.scale)
    return found


def fit_at_offset(ranges: TimedRanges, path: PathSamples, offset_s: float, scale: float = np.inf) -> OffsetFit:
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
    cells = np.floor(ranges.times_s / _CELL_S).astype(np.int64) * (ranges.anchor.max(initial=0) + 1) + ranges.anchor
    num_cells = len(np.unique(cells))
    num_spare = num_cells - squares.num_unknowns - 1
    residuals = squares.residuals_m * np.sqrt(num_cells / max(num_spare, 0.5))
    rates = np.einsum("ni,ni->n", squares.gradient, velocities)
    return OffsetFit(offset_s, ranges, squares, residuals, num_spare, deviations, rates)


def _losses(errors_m: Array) -> Array:
    """(n,) negative log likelihoods: Cauchy of the errors' own size, so that errors twice as large lose log 2."""
    stddev_m = residual_stddev(errors_m)
    return np.asarray(np.log(stddev_m) + np.log1p((errors_m / stddev_m) ** 2))


def _variance_of_mean(values: Array, times: Array) -> float:
    """Of n values if chance acts on blocks of time."""
    sums = np.bincount(_blocks(times, max(_MIN_NUM_BLOCKS, int(np.ptp(times) / _BLOCK_S))), values - values.mean())
    return float(sums @ sums) / len(values) ** 2 * len(sums) / max(len(sums) - 1, 1)


def _is_determined(own: Array, rates: Array) -> bool:
    """Whether the offset changes the ranges in a way that nothing else could."""
    return bool(own @ own > _MIN_OWN_RATE**2 * (rates @ rates))


def _blocks(times: Array, num_blocks: int) -> Indices:
    """(n,) number of the block of time each range falls into, without gaps."""
    length_s = max(float(np.ptp(times)) / num_blocks, 1e-9)
    return np.unique(np.minimum((times - times.min()) // length_s, num_blocks - 1), return_inverse=True)[1]


def _jackknife_variances(own: Array, residuals: Array, squares: SquaresFit, blocks: Sequence[Indices]) -> list[Array]:
    """(k,) variances of an M-estimate whose residuals are correlated within blocks of time, for each way to cut it.

    The delete-one-block jackknife, each time by one Newton step with everything that the fit adjusts
    (Bell and McCaffrey, Survey Methodology 2002). Sums of residuals over blocks, without the step, are
    too small where a block's own ranges pull the fit: on short logs by half. With Student's quantile in
    place of the Gaussian one, as there are few blocks.

    Args:
        own: (n, k) columns of the unknowns in question, which nothing else explains.
        residuals: (n,) weighted, metres, of the fit ``squares``.
        blocks: (n,) number of the block of each range.
    """
    sizes = np.linalg.norm(own, axis=0)
    columns = np.column_stack([squares.basis, own / sizes])
    curving = (2 * squares.weights - 1)[:, None]
    curvature = columns.T @ (curving * columns)

    def variances(block: Indices) -> Array:
        changes = []
        for rows in np.split(np.argsort(block, kind="stable"), np.cumsum(np.bincount(block))[:-1]):
            some = columns[rows]
            left = curvature - some.T @ (curving[rows] * some)
            if np.linalg.eigvalsh(left)[0] < _MIN_LEFT_CURVATURE:
                return np.full(len(sizes), np.inf)
            changes.append(np.linalg.solve(left, some.T @ residuals[rows])[-len(sizes) :] / sizes)
        num = len(changes)
        quantile = float(special.stdtrit(num - 1, 0.975) / special.ndtri(0.975)) if num > 1 else np.inf
        return np.asarray(quantile**2 * (num - 1) / num * np.sum(np.square(changes), axis=0))

    return [variances(block) for block in blocks]


def fit_clocks(ranges: TimedRanges, path: PathSamples, offset_s: float) -> tuple[OffsetFit, Timing, float, float]:
    """``refine_offset``; if the ranges then show a drift beyond doubt, offset and drift.

    Returns:
        the fit at the offset, of ranges whose times are freed of the drift that is followed; what it says of the offset
        and of the drift that is left; what camera time gains on radio time, seconds a second, where it is beyond doubt,
        else 0; and the radio's time at which the offset holds.
    """
    reference_s = float(ranges.times_s.mean())
    fit = refine_offset(ranges, path, offset_s)
    timing, followed, least_stddevs = fit.timing(), 0.0, _MIN_STDDEVS
    for _ in range(_MAX_NUM_DRIFTS):
        if not abs(timing.drift) > least_stddevs * timing.drift_stddev:
            break
        followed, least_stddevs = followed + timing.drift, _CONVERGED_STDDEVS
        # Of a radio clock that runs like the camera's.
        times_s = ranges.times_s + followed * (ranges.times_s - reference_s)
        fit = refine_offset(ranges._replace(times_s=times_s), path, fit.offset_s)
        timing = fit.timing()
    return fit, timing, followed, reference_s


def drift_note(drift: float, stddev: float, times_s: Array) -> str:
    """What a user should know of a drift that was found."""
    half_span_s = float(np.ptp(times_s)) / 2
    return (
        f"the clocks drift: the camera's gains {1e6 * drift:+.0f} ppm on the radio's (stddev {1e6 * stddev:.0f} ppm); "
        f"this is corrected for: the time offset differs by {drift * half_span_s:+.3f} s at the end of the log from "
        f"that in its middle"
    )

"""Robust fit of observations to the path at one time offset, with the offset's uncertainty and the drift of the clocks.

The observations are of any kind that follows the camera: ranges, coordinates of positions, turns of an inertial sensor.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from scipy import special

from rangesfm.arrays import Array, Indices, Mask, rows_by_key
from rangesfm.measurements.clock.offset import OffsetCurve, TimeOffset
from rangesfm.measurements.clock.path_samples import MIN_COVERAGE, PathSamples, scan_parts
from rangesfm.measurements.ranges.errors.noise import MIN_NOISE_M, STRETCH_S
from rangesfm.util.geometry.numerics import (
    MAX_NUM_ROUNDS,
    NEGLIGIBLE_STDDEVS,
    NORMAL_95,
    SIGNIFICANT_STDDEVS,
    UNDETERMINED,
)
from rangesfm.util.geometry.robust_statistics import robust_stddev

if TYPE_CHECKING:
    from typing_extensions import Self

# Ranges to one anchor within this time count as one independent range, because a carried camera hardly moves in it.
_CELL_S = 1.0
SEPARATION_S = 0.5
"""Offsets that are nearer to each other are one, and no step of a descent is longer."""
# A descent is given up if its residuals are at least twice a rival's, and the logarithm of the odds exceeds this.
_FAR_BEHIND, _HOPELESS = float(np.log(2)), 30.0
# Standard deviation of the error that all ranges share because of the tag's delay.
_COMMON_STDDEV_M = 0.05
# Smallest number of blocks of time whose errors count as independent.
_MIN_NUM_BLOCKS = 12
# The path explains the ranges if their gain in likelihood is this many standard deviations above 0, with blocks of time
# as independent samples. For a log of another walk, the best of some hundred offsets reaches 6, by Student's
# distribution with a dozen blocks.
_MIN_GAIN_STDDEVS = 7.0


@dataclass(frozen=True)
class Observed(ABC):
    """What was observed at m times along a path, such as ranges.

    Each time has as many numbers as a kind has coordinates, n in all, in metres.

    Attributes:
        times_s: (m,) times on the clock of the observing system. path: of the camera.
    """

    times_s: Array
    path: PathSamples

    name: ClassVar[str]
    """What they are, in words."""
    remedy: ClassVar[str]
    """What the user can do where the motion does not determine the offset."""
    may_drift: ClassVar[bool] = False
    """Whether a drift of the clocks is looked for."""

    @property
    @abstractmethod
    def numbers(self) -> Array:
        """(n,) observed numbers."""

    @property
    @abstractmethod
    def alike(self) -> Indices:
        """(n,) index of the series that each number belongs to, such as its anchor."""

    @property
    def start_weights(self) -> Array:
        """(m,) weights with which all offsets are compared at first."""
        return np.ones(len(self.times_s))

    @abstractmethod
    def scanned(self, weights: Array) -> OffsetCurve:
        """Return the best fit at every offset, with (m,) weights and without the lever arm."""

    @abstractmethod
    def fit(self, offset_s: float, before: OffsetFit | None = None) -> OffsetFit:
        """Fit those that are on the path at one offset.

        Args:
            before: fit at this offset or near it, whose scale the lever arm has; None: the lever arm is left out.
        """

    def on_path(self, offset_s: float) -> Mask:
        """Return which of them (m,) are on the path at an offset."""
        return self.path.knows(self.times_s + offset_s)

    def take(self, rows: Indices | Mask) -> Self:
        """Return some of the observations."""
        columns: dict[str, Any] = {
            each.name: values[rows]
            for each in fields(self)
            if isinstance(values := getattr(self, each.name), np.ndarray)
        }
        return replace(self, **columns)

    def first_on_path(self, offset_s: float, max_num: int) -> Self:
        """Return the first observations that are on the path at an offset, at most ``max_num``."""
        return self.take(np.flatnonzero(self.on_path(offset_s))[:max_num])

    def scan(self, weights: Array) -> OffsetCurve:
        """Fit at every offset at which observations and path overlap, without the lever arm.

        The lever arm makes little difference at this resolution.

        Args:
            weights: (m,).
        """
        return scan_parts(self.times_s, self.path.span_s, lambda rows: self.take(rows).scanned(weights[rows]))

    @property
    def deviations(self) -> Array:
        """Deviations (n,) from the median of all that are alike, such as the ranges to one anchor."""
        deviations = self.numbers.copy()
        for rows in rows_by_key(self.alike):
            deviations[rows] -= np.median(deviations[rows])
        return deviations


def residual_stddev(residuals: Array) -> float:
    """Return a robust standard deviation of residuals, at least the smallest noise."""
    return max(robust_stddev(residuals), MIN_NOISE_M)


@dataclass(frozen=True)
class OffsetFit:
    """Robust fit of observations on the path at one time offset, by linear unknowns of the kind.

    Attributes:
        offset_s: image time minus the time of the observations.
        observed: those on the path, with n numbers.
        weights: (n,) weights of the loss, in [0, 1].
        raw_residuals: (n,) measured minus fitted.
        rates: (n,) derivative of each fitted number by the offset, per second.
        basis: (n, p) orthonormal weighted columns of all unknowns.
        num_unknowns: their number, also of those that nothing determines.
        scale: metres per model unit; infinite if it is not determined, or no unknown.
    """

    offset_s: float
    observed: Observed
    weights: Array
    raw_residuals: Array
    rates: Array
    basis: Array
    num_unknowns: int
    scale: float = np.inf

    @property
    def weighted_residuals(self) -> Array:
        """Residuals times the roots of their weights (n,)."""
        return np.asarray(np.sqrt(self.weights) * self.raw_residuals)

    def unexplained(self, values: Array) -> Array:
        """Return weighted changes of the numbers (n, k) without the parts that the unknowns can explain."""
        weighted = np.sqrt(self.weights)[:, None] * values
        return np.asarray(weighted - self.basis @ (self.basis.T @ weighted))

    @property
    def num_each(self) -> int:
        """How many numbers each time has."""
        return len(self.weights) // max(len(self.observed.times_s), 1)

    @property
    def times_s(self) -> Array:
        """Times of the numbers (n,)."""
        return np.repeat(self.observed.times_s, self.num_each)

    @property
    def weights_of_each(self) -> Array:
        """Robust weights of the m observations."""
        return self.weights[:: self.num_each]

    @cached_property
    def _num_cells(self) -> int:
        """Number of observations whose errors may be independent."""
        alike = self.observed.alike
        cells = np.floor(self.times_s / _CELL_S).astype(np.int64) * (alike.max(initial=0) + 1) + alike
        return len(np.unique(cells))

    @property
    def num_spare(self) -> int:
        """Number of independent observations beyond the unknowns."""
        return self._num_cells - self.num_unknowns - 1

    @cached_property
    def residuals(self) -> Array:
        """Residuals (n,), enlarged to account for the number of unknowns."""
        return np.asarray(self.raw_residuals * np.sqrt(self._num_cells / max(self.num_spare, 0.5)))

    @property
    def residual_stddev(self) -> float:
        return residual_stddev(self.residuals)

    @property
    def is_testable(self) -> bool:
        """Return whether there are enough observations to tell a fit from a coincidence."""
        return self.num_spare >= self.num_unknowns

    def losses(self, stddev: float) -> Array:
        """Return the negative log-likelihood of each residual (n,) of this standard deviation, up to a constant."""
        return _losses(self.residuals, stddev)

    @cached_property
    def gains(self) -> Array:
        """Gain in each number's log-likelihood over a camera that stands still (n,)."""
        deviations = self.observed.deviations
        own = self.losses(self.residual_stddev)
        return _losses(deviations, residual_stddev(deviations)) - own

    @property
    def score(self) -> float:
        """Mean gain, which is about the logarithm of the ratio of the deviations' size to the residuals'."""
        return float(self.gains.mean())

    @property
    def num_independent(self) -> float:
        """Number of observations with independent errors that carry the same information.

        It is found from the variation of the losses between blocks of time, which is larger for correlated errors.
        """
        losses = self.losses(self.residual_stddev)
        variance = _variance_of_mean(losses, self.times_s)
        return min(self.num_spare, float(np.var(losses)) / max(variance, 1e-300))

    def explains(self) -> bool:
        """Return whether the path explains the observations better than no motion at all."""
        least = _MIN_GAIN_STDDEVS * np.sqrt(_variance_of_mean(self.gains, self.times_s))
        return bool(self.score > least)

    def is_hopeless_beside(self, rival: OffsetFit) -> bool:
        """Return whether its residuals are so much larger than a rival's that further descent makes no difference."""
        behind = rival.score - self.score
        return behind > _FAR_BEHIND and behind * min(self.num_independent, rival.num_independent) > _HOPELESS

    def timed(self) -> TimeOffset:
        """Return the offset and the drift, with standard deviations that account for errors alike in blocks of time.

        That of the offset is infinite if the motion does not determine it.
        """
        times = self.times_s - self.times_s.mean()
        own = self.unexplained(np.stack([self.rates, self.rates * times], axis=1))
        if not _is_determined(own[:, 0], self.rates):
            return TimeOffset(self.offset_s, np.inf)
        residuals = self.weighted_residuals
        change = np.linalg.lstsq(own, residuals, rcond=None)[0]
        alone = self._variances(own[:, :1], residuals, times)
        both = self._variances(own, residuals - own @ change, times)
        drift_stddev = float(np.sqrt(both[1]))
        return TimeOffset(self.offset_s, float(np.sqrt(alone[0])), drift=float(change[1]), drift_stddev=drift_stddev)

    def _variances(self, own: Array, residuals: Array, times: Array) -> Array:
        """Return the variances (k,) of unknowns with columns ``own`` (n, k), from noise and an error of all."""
        # The correlation time is not known. The variance is therefore the mean of the variances with blocks of one, two
        # and four stretches; short logs have the smallest number of blocks, half of it, and twice as many.
        usual = max(_MIN_NUM_BLOCKS, float(np.ptp(times)) / (2 * STRETCH_S))
        blocks = [_blocks(times, round(num)) for num in (usual / 2, usual, 2 * usual)]
        by_chance = _jackknife_variances(own, residuals, self, blocks)
        by_bias = np.linalg.lstsq(own, _COMMON_STDDEV_M * np.sqrt(self.weights), rcond=None)[0]
        return np.asarray(np.mean(by_chance, axis=0) + by_bias**2)


def orthonormal(columns: Array) -> Array:
    """Return an orthonormal basis (n, p) of the weighted columns (n, k) of unknowns that are determined."""
    lengths = np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    basis, strengths, _ = np.linalg.svd(columns / lengths, full_matrices=False)
    return np.asarray(basis[:, strengths > UNDETERMINED * strengths[0]])


def refine_offset(observed: Observed, offset_s: float, rival: OffsetFit | None = None) -> OffsetFit:
    """Refine an offset by Gauss-Newton steps to the nearest one that fits the observations best.

    Args:
        observed: those that are (nearly) all on the path at the given offset.
        offset_s: the offset to start from.
        rival: the refinement stops early if it is far behind this fit; None: there is none.
    """
    # The lever arm comes in only after the scale has been estimated.
    found = observed.fit(offset_s, observed.fit(offset_s))
    for _ in range(MAX_NUM_ROUNDS):
        if rival is not None and found.is_hopeless_beside(rival):
            break
        own = found.unexplained(found.rates[:, None])[:, 0]
        if not _is_determined(own, found.rates):
            break
        step_s = float(own @ found.weighted_residuals / (own @ own))
        if abs(step_s) * np.linalg.norm(own) < NEGLIGIBLE_STDDEVS * found.residual_stddev:
            break
        offset_s = found.offset_s + float(np.clip(step_s, -SEPARATION_S, SEPARATION_S))
        if np.mean(observed.on_path(offset_s)) < MIN_COVERAGE:
            break
        found = observed.fit(offset_s, found)
    return found


def _losses(errors: Array, stddev: float) -> Array:
    """Return the negative log-likelihoods (n,) of errors by a Cauchy distribution.

    Errors that are twice as large, as is their standard deviation, lose log 2.
    """
    return np.asarray(np.log(stddev) + np.log1p((errors / stddev) ** 2))


def _variance_of_mean(values: Array, times: Array) -> float:
    """Return the variance of the mean of n values that are correlated within blocks of time."""
    sums = np.bincount(_blocks(times, max(_MIN_NUM_BLOCKS, int(np.ptp(times) / STRETCH_S))), values - values.mean())
    return float(sums @ sums) / len(values) ** 2 * len(sums) / max(len(sums) - 1, 1)


def _is_determined(own: Array, rates: Array) -> bool:
    """Return whether the offset changes the ranges in a way that the other unknowns cannot explain."""
    return bool(own @ own > UNDETERMINED**2 * (rates @ rates))


def _blocks(times: Array, num_blocks: int) -> Indices:
    """Return the index of each range's block of time (n,); empty blocks are not counted."""
    length_s = max(float(np.ptp(times)) / num_blocks, 1e-9)
    return np.unique(np.minimum((times - times.min()) // length_s, num_blocks - 1), return_inverse=True)[1]


def _jackknife_variances(own: Array, residuals: Array, fit: OffsetFit, blocks: Sequence[Indices]) -> list[Array]:
    """Return the variances (k,) of an M-estimate with residuals correlated within blocks, for each set of blocks.

    This is the delete-one-block jackknife, with one Newton step of all unknowns of the fit for each block (Bell and
    McCaffrey, Survey Methodology 2002). Sums of residuals over blocks, without the step, are too small where a block's
    own ranges pull the fit; on short logs they are half as large. Because there are few blocks, the standard deviation
    is enlarged by the ratio of Student's quantile to the Gaussian one.

    Args:
        own: (n, k) columns of the unknowns, without the parts that other unknowns explain.
        residuals: (n,) weighted residuals of the fit ``fit``.
        fit: the fit.
        blocks: divisions, each the index (n,) of each range's block.
    """
    sizes = np.linalg.norm(own, axis=0)
    columns = np.column_stack([fit.basis, own / sizes])
    curving = (2 * fit.weights - 1)[:, None]
    curvature = columns.T @ (curving * columns)

    def variances(block: Indices) -> Array:
        changes = []
        for rows in np.split(np.argsort(block, kind="stable"), np.cumsum(np.bincount(block))[:-1]):
            some = columns[rows]
            left = curvature - some.T @ (curving[rows] * some)
            if np.linalg.eigvalsh(left)[0] < UNDETERMINED**2:  # the other blocks do not determine all unknowns
                return np.full(len(sizes), np.inf)
            changes.append(np.linalg.solve(left, some.T @ residuals[rows])[-len(sizes) :] / sizes)
        num = len(changes)
        quantile = float(special.stdtrit(num - 1, 0.975) / special.ndtri(0.975)) if num > 1 else np.inf
        return np.asarray(quantile**2 * (num - 1) / num * np.sum(np.square(changes), axis=0))

    return [variances(block) for block in blocks]


def fit_clocks(observed: Observed, offset_s: float) -> tuple[OffsetFit, TimeOffset]:
    """Refine an offset, and if the observations show a significant drift, offset and drift together.

    Returns:
        The fit, with the drift removed from the times of its observations, and the offset, which follows a significant
        drift.
    """
    reference_s = float(observed.times_s.mean())
    fit = refine_offset(observed, offset_s)
    found, followed, least_stddevs = fit.timed(), 0.0, SIGNIFICANT_STDDEVS
    for _ in range(MAX_NUM_ROUNDS if observed.may_drift else 0):
        if not abs(found.drift) > least_stddevs * found.drift_stddev:
            break
        followed, least_stddevs = followed + found.drift, NEGLIGIBLE_STDDEVS
        # The times become those of a radio clock that runs at the rate of the camera's.
        times_s = observed.times_s + followed * (observed.times_s - reference_s)
        fit = refine_offset(replace(observed, times_s=times_s), fit.offset_s)
        found = fit.timed()
    note = _drift_note(followed, found.drift_stddev, observed.times_s) if followed else ""
    drift, is_followed = followed or found.drift, followed != 0
    return fit, replace(found, drift=drift, drift_is_followed=is_followed, reference_s=reference_s, note=note)


def _drift_note(drift: float, stddev: float, times_s: Array) -> str:
    """Return a message for the user about a drift that was found."""
    half_span_s = float(np.ptp(times_s)) / 2
    return (
        f"the clocks drift: the camera's gains {1e6 * drift:+.0f} ppm on the radio's (within "
        f"{1e6 * NORMAL_95 * stddev:.0f} ppm, 95 %); the drift is corrected, and the time offset at the end of the log "
        f"differs by {drift * half_span_s:+.3f} s from that in its middle"
    )

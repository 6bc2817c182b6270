"""How noisy ranges are: found from their own residuals, or from the log alone.

From the log, by how much they miss a smooth curve through their neighbours. Nor is any range better than its rounding,
of radios that report whole centimetres or decimetres.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rangesfm.arrays import Array, Indices
from rangesfm.ranging.range_log import RangeLog

# Radios read up to 0.15 m short below about 2 m, every anchor alike, by an amount that depends
# on the antennas (Decawave application note APS011). An error common to all short ranges does
# not average out, so they are trusted far less than their scatter says.
_SHORT_RANGE_STDDEV_M = 2.0
SHORT_RANGE_LENGTH_M = 1.0
# Of a range of which nothing is known yet. Ranges that may be off together by more say nothing on the noise of others.
START_STDDEV_M = 0.1
MIN_STDDEV_M = 1e-9
# Of a Gaussian distribution over the median of its absolute values.
_STDDEV_PER_MAD = 1.4826
# In stddevs, root mean square: where residuals are no larger, rounding and the solver's last step are all that they
# have in common.
NO_ERROR = 1e-3
_MAX_INFLATION = 30.0
# Of fewer there is nothing to resample.
_MIN_NUM_STRETCHES = 8
# Of the mixture of noise and outliers: residuals that it is fitted to.
_MAX_MIXED = 4000
_NUM_MIXTURE_ROUNDS = 60
# The smallest tenth of Gaussian residuals lies within this many stddevs of zero.
_FIRST_SHARE, _FIRST_QUANTILE = 0.1, 0.1257
# Outliers err by this many stddevs in the mean, or they would be noise.
_MIN_OUTLIER_STDDEVS = 3.0
# Of fewer residuals a mixture can find anything.
_MIN_MIXED = 20
_MIN_DENSITY = 1e-300
# From the log alone.
_WINDOW = 11
_MAX_NUM_WINDOWS = 20_000
_MAX_STRETCH = 3.0  # a window so much longer than the typical one has a gap in it
_CAUCHY_SCALE = 2.4
_NUM_PARABOLA_ROUNDS = 8
_TINY = 1e-9
_STEPS_M = (0.1, 0.01)
_MIN_NUM_ROUNDED = 20
_ROUNDED_TO_M = 1e-5  # what 32-bit numbers leave of a range of some hundred metres


def robust_stddev(residuals: npt.ArrayLike) -> float:
    """Stddev of the Gaussian bulk of (n,): median absolute deviation from zero, scaled; never quite 0."""
    return float(robust_stddevs(np.reshape(residuals, (1, -1)))[0, 0]) if np.size(residuals) else MIN_STDDEV_M


def robust_stddevs(residuals: Array) -> Array:
    """(..., 1) the same of each row of (..., n)."""
    stddevs: Array = _STDDEV_PER_MAD * np.median(np.abs(residuals), axis=-1, keepdims=True)
    return np.maximum(stddevs, MIN_STDDEV_M)


def short_range_stddev(range_m: Array) -> Array:
    """(n,) how far a range of this length may be off for being short, metres."""
    return _SHORT_RANGE_STDDEV_M * np.exp(-range_m / SHORT_RANGE_LENGTH_M)


def shared_stddev(log: RangeLog) -> Array:
    """(n,) what all ranges of about this length may be off together: as the error curve says, else for being short."""
    return short_range_stddev(log.range_m) if log.shared_stddev_m is None else log.shared_stddev_m


def bias_whitening(own_stddev_m: Array, common_stddev_m: float) -> Array:
    """(m, m) turns range biases, each of its own stddev and a part that all share, into independent ones of stddev 1.

    Args:
        own_stddev_m: (m,) more than 0.
    """
    covariance = np.diag(own_stddev_m**2) + common_stddev_m**2
    return np.linalg.inv(np.linalg.cholesky(covariance)) if len(own_stddev_m) else np.zeros((0, 0))


def stretch_labels(times_s: Array, length_s: float) -> Indices:
    """(n,) labels of stretches of time, in which errors may go together: at least eight."""
    since = times_s - times_s.min()
    length_s = max(min(length_s, float(since.max()) / _MIN_NUM_STRETCHES), 1e-9)
    return np.asarray(np.floor(since / length_s).astype(np.int64))


def correlation_inflation(
    scaled_residuals: Array, weights: Array, groups: Indices, shares: Array | None = None
) -> float:
    """How much larger the stddev of a mean is than independent errors would make it.

    Residuals of one anchor and one stretch of time (a group) tend to err together. The
    variance of the groups' sums over the sum of variances is the square of what is returned.

    Args:
        scaled_residuals: (n,) in stddevs. weights: (n,) robust. groups: (n,) int labels.
        shares: (n,) by how much each counts besides, if not all alike: formally, one with half of it has twice the
            variance.
    """
    influence = scaled_residuals * weights
    shares = np.ones(len(influence)) if shares is None else shares
    _, index = np.unique(groups, return_inverse=True)
    sums = np.bincount(index, shares * influence)
    squares = float(np.sum(shares * influence**2))
    if squares <= NO_ERROR**2 * np.sum(shares) or len(sums) < 2:
        return 1.0
    return float(np.clip(np.sqrt(np.sum(sums**2) / squares), 1.0, _MAX_INFLATION))


@dataclass(frozen=True)
class InlierNoise:
    """What a mixture of noise and outliers says of residuals.

    Attributes:
        stddev: of the Gaussian bulk about zero, metres.
        num: how many residuals belong to it, in the mean.
        log_likelihood: of all residuals; of two ways to explain the same ranges, the higher one is the likelier.
    """

    stddev: float
    num: float
    log_likelihood: float


def inlier_noise(residuals: Array) -> InlierNoise:
    """The Gaussian bulk about zero, however small a share of the residuals (n,), metres, it is.

    A mixture of a Gaussian about zero and two exponential distributions, one for too long and one for too short
    ranges, fitted by expectation maximisation (Dempster, Laird and Rubin, 1977). The median absolute deviation, which
    it replaces, takes outliers for noise well before they are half of all.
    """
    if len(residuals) < _MIN_MIXED:
        return _gaussian(residuals)
    # Ordered, so that thinning keeps the distribution and the order of the ranges has no say.
    sizes = np.abs(residuals)
    thinned = np.sort(residuals)[np.linspace(0, len(residuals) - 1, min(len(residuals), _MAX_MIXED)).astype(np.int64)]
    stddev = max(float(np.quantile(sizes, _FIRST_SHARE)) / _FIRST_QUANTILE, MIN_STDDEV_M)
    means = np.maximum([_mean_or_zero(sizes[residuals > 0]), _mean_or_zero(sizes[residuals < 0])], stddev)
    shares = np.array([0.5, 0.25, 0.25])
    for _ in range(_NUM_MIXTURE_ROUNDS):
        means = np.maximum(means, _MIN_OUTLIER_STDDEVS * stddev)
        densities = _densities(thinned, stddev, means, shares)
        belongs = densities / np.maximum(densities.sum(axis=0), _MIN_DENSITY)
        counts = np.maximum(belongs.sum(axis=1), 1e-9)
        shares = counts / counts.sum()
        stddev = max(float(np.sqrt(belongs[0] @ thinned**2 / counts[0])), MIN_STDDEV_M)
        means = (belongs[1:] @ np.abs(thinned)) / counts[1:]
    means = np.maximum(means, _MIN_OUTLIER_STDDEVS * stddev)
    densities = np.maximum(_densities(thinned, stddev, means, shares).sum(axis=0), _MIN_DENSITY)
    return InlierNoise(stddev, float(shares[0]) * len(residuals), float(np.mean(np.log(densities))) * len(residuals))


def _densities(residuals: Array, stddev: float, means: Array, shares: Array) -> Array:
    """(3, n) of noise, of too short and of too long ranges."""
    gaussian = np.exp(-0.5 * (residuals / stddev) ** 2) / (np.sqrt(2 * np.pi) * stddev)
    sides = np.array([residuals > 0, residuals < 0])
    outlying = sides * np.exp(-np.abs(residuals) / means[:, None]) / means[:, None]
    return np.asarray(shares[:, None] * np.concatenate([gaussian[None], outlying]))


def _gaussian(residuals: Array) -> InlierNoise:
    stddev = robust_stddev(residuals)
    scaled = residuals / stddev
    normalization = len(residuals) * float(np.log(stddev * np.sqrt(2 * np.pi)))
    return InlierNoise(stddev, len(residuals), -0.5 * float(scaled @ scaled) - normalization)


def _mean_or_zero(values: Array) -> float:
    return float(values.mean()) if len(values) else 0.0


def estimate_noise_m(timestamp_s: Array, range_m: Array) -> float | None:
    """Robust stddev of the ranges between one tag and one anchor.

    A parabola is fitted robustly to every 11 ranges in a row; the middle one's distance from it, corrected
    for its own pull on the fit, is a sample of the noise. Errors that last longer than a window, such as a
    bias, are not seen; motion that is no parabola within a window counts as noise.

    Args:
        timestamp_s: (n,) in any order.
        range_m: (n,).

    Returns:
        Metres; None for fewer than two windows' worth of ranges, or if they are absurd.
    """
    if len(range_m) < 2 * _WINDOW:
        return None
    order = np.argsort(timestamp_s, kind="stable")
    times = np.lib.stride_tricks.sliding_window_view(timestamp_s[order], _WINDOW)
    ranges = np.lib.stride_tricks.sliding_window_view(range_m[order], _WINDOW)
    span = times[:, -1] - times[:, 0]
    whole = np.flatnonzero(span <= _MAX_STRETCH * np.median(span))
    chosen = whole[:: -(-len(whole) // _MAX_NUM_WINDOWS)]
    with np.errstate(over="ignore", invalid="ignore"):  # times or ranges that no radio can mean
        misses = _misses_of_parabola(times[chosen], ranges[chosen])
        noise = robust_stddev(misses - np.median(misses))
    return noise if np.isfinite(noise) else None


def _misses_of_parabola(times: Array, ranges: Array) -> Array:
    """What the middle of each row of (m, 11) ranges is off a robust parabola, as if it had not pulled on it, (m,)."""
    middle = _WINDOW // 2
    centred = times - times[:, middle : middle + 1]
    scaled = centred / np.maximum(np.abs(centred).max(axis=1, keepdims=True), _TINY)
    powers = np.stack([np.ones_like(scaled), scaled, scaled**2], axis=2)
    weights = np.ones_like(ranges)
    offset = np.median(ranges, axis=1, keepdims=True)
    for _ in range(_NUM_PARABOLA_ROUNDS):
        normal = np.einsum("mi,mij,mik->mjk", weights, powers, powers) + _TINY * np.eye(3)
        right = np.einsum("mi,mij,mi->mj", weights, powers, ranges - offset)
        coefficients = np.linalg.solve(normal, right[..., np.newaxis])
        residuals = ranges - offset - (powers @ coefficients)[..., 0]
        weights = 1 / (1 + (residuals / (_CAUCHY_SCALE * robust_stddevs(residuals))) ** 2)
    plain = np.einsum("mij,mik->mjk", powers, powers) + _TINY * np.eye(3)
    pull = np.linalg.inv(plain)[:, 0, 0]  # of the middle, where the powers are 1, 0, 0
    return np.asarray(residuals[:, middle] / np.sqrt(np.maximum(1 - pull, _TINY)), np.float64)


def find_quantization_m(range_m: Array) -> float | None:
    """The step (0.1 or 0.01 m) of which all ranges are multiples; None if of neither, or too few to tell."""
    if len(range_m) < _MIN_NUM_ROUNDED:
        return None
    for step in _STEPS_M:
        if np.all(np.abs(range_m - np.round(range_m / step) * step) < _ROUNDED_TO_M):
            return step
    return None


def quantization_stddev_m(step_m: float) -> float:
    """Of the rounding error, which is uniform over one step."""
    return step_m / math.sqrt(12)

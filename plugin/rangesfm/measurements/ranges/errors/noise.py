"""The noise of ranges, and its correlation in time and in space, estimated from residuals, or from a log alone.

From a log, noise is the distance of ranges from a smooth curve through their neighbours. For radios that report whole
centimetres or decimetres, the rounding error is a lower limit.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from rangesfm.arrays import Array, Indices
from rangesfm.util.geometry.numerics import MAX_NUM_ROUNDS, NUM_REWEIGHTINGS, ROUNDING, SIGNIFICANT_STDDEVS
from rangesfm.util.geometry.robust_statistics import (
    CAUCHY,
    MIN_STDDEV_M,
    RobustLoss,
    robust_stddev,
    robust_stddevs,
    stddevs_within,
)
from rangesfm.util.geometry.similarity import rounding_of

# Standard deviation, metres, at distance 0, and its decay length: radios read up to 0.15 m short below about 2 m, all
# anchors alike, by an amount that depends on the antennas (Decawave application note APS011). An error common to all
# short ranges does not average out, so they are trusted far less than their scatter suggests.
_SHORT_RANGE_STDDEV_M = 2.0
SHORT_RANGE_LENGTH_M = 1.0
START_STDDEV_M = 0.1
"""Noise of a usual radio, metres, assumed before an estimate: in ``examples/radios.md`` 0.03 to 0.1, one has more."""
MIN_NUM_OF_SCATTER = 20
"""Smallest number of residuals that show a scatter, or a share of outliers."""
MIN_ORDINARY = 0.3
"""Smallest share of ranges without a large common error for which the noise is estimated from these alone."""
MIN_NOISE_M = 1e-3
"""Smallest noise of a range, metres: radios resolve only about a centimetre."""
# Root mean square of residuals, in standard deviations, below which they are only rounding and the solver's tolerance.
NO_ERROR = 1e-3
STRETCH_S = 10.0
"""Length of stretches of time, seconds, in which errors may be correlated; where a log names photos, each is one."""
# Edge of a place, metres: some wavelengths, the scale at which echoes that overlap the direct path change. On real logs
# any value from 0.1 to 0.5 m gives scales within 0.7 % of each other.
_PLACE_SIZE_M = 0.2
# Smallest number of stretches of time for an estimate of the correlation.
_MIN_NUM_STRETCHES = 8
# Largest number of residuals, or of windows of a log, from which noise is estimated: two percent is close enough.
_MAX_NUM_SAMPLES = 4000
# The noise is first taken from this share of the residuals, the smallest, as most of the others may be outliers.
_FIRST_SHARE = 0.1
# For the estimate from the log alone.
_WINDOW = 11
_MAX_STRETCH = 3.0  # a window longer than this many typical ones has a gap in it
_STEPS_M = (0.1, 0.01)
_ROUNDING = np.finfo(np.float32).eps  # of a log with 32-bit numbers, relative


def short_range_stddev(distance_m: Array) -> Array:
    """Return the (n,) standard deviation, metres, of the systematic error of ranges at short distances."""
    return _SHORT_RANGE_STDDEV_M * np.exp(-distance_m / SHORT_RANGE_LENGTH_M)


def shared_stddev(distance_m: Array, curve_stddev_m: Array) -> Array:
    """Return the (n,) stddev of errors that ranges of similar length share, by the error curve or for short ranges.

    Args:
        curve_stddev_m: (n,) of a learnt error curve that was subtracted; NaN if none was.
    """
    return np.where(np.isnan(curve_stddev_m), short_range_stddev(distance_m), curve_stddev_m)


def bias_whitening(own_stddev_m: Array, common_stddev_m: float) -> Array:
    """Return the (m, m) matrix that whitens range biases, each with its own stddev and all with a common part.

    Args:
        own_stddev_m: (m,) positive.
    """
    covariance = np.diag(own_stddev_m**2) + common_stddev_m**2
    return np.linalg.inv(np.linalg.cholesky(covariance)) if len(own_stddev_m) else np.zeros((0, 0))


def stretch_labels(times_s: Array, length_s: float) -> Indices:
    """Return (n,) labels of stretches of time in which errors may be correlated; there are at least eight."""
    since = times_s - times_s.min(initial=np.inf)
    length_s = max(min(length_s, float(since.max(initial=0.0)) / _MIN_NUM_STRETCHES), 1e-9)
    return np.asarray(np.floor(since / length_s).astype(np.int64))


def correlation_inflation(scaled_residuals: Array, weights: Array, groups: Indices, shares: Array) -> float:
    """Return the ratio of the standard deviation of a mean to its value for independent errors.

    Residuals of one anchor in one stretch of time (a group) tend to err alike. The result is the square root of the
    variance of the groups' sums over the sum of variances.

    Args:
        scaled_residuals: (n,) in standard deviations. weights: (n,) robust. groups: (n,) int labels.
        shares: (n,) further weights: a share of one half formally means twice the variance.
    """
    influence = scaled_residuals * weights
    _, index = np.unique(groups, return_inverse=True)
    sums = np.bincount(index, shares * influence)
    squares = float(np.sum(shares * influence**2))
    if squares <= NO_ERROR**2 * np.sum(shares) or len(sums) < 2:
        return 1.0
    return max(float(np.sqrt(np.sum(sums**2) / squares)), 1.0)


def place_labels(tags_m: Array, anchor_index: Indices) -> Indices:
    """Return (n,) labels, equal for ranges to one anchor from one cell of a grid: walls make them err alike.

    Args:
        tags_m: (n, 3) antenna positions in the metric world. anchor_index: (n,).
    """
    labels, in_cells = anchor_index, tags_m / _PLACE_SIZE_M
    # A path at a height of 1.6 m, or at the first camera's 0, lies on grid planes: rounding would choose the cell.
    for axis in np.floor(in_cells + rounding_of(in_cells)).astype(np.int64).T:
        # The axes are combined one after the other, since a single number for all would overflow at large sites.
        cells, row = np.unique(axis, return_inverse=True)
        labels = np.unique(labels * len(cells) + row, return_inverse=True)[1]
    return np.asarray(labels, dtype=np.int64)


def shares_by_residuals(labels: Indices, scaled_residuals: Array, loss: RobustLoss) -> Array:
    """Return the (n,) weight of each range besides its noise, so that a place counts as much as the mean of its ranges.

    The mean of c ranges with a correlation is worth c / (1 + correlation (c - 1)) independent ones. The weights are
    normalised so that a weighted estimate's formal covariance is also right for independent errors.

    Args:
        labels: (n,) of places, counted from 0. scaled_residuals: (n,) in standard deviations.
        loss: that of the fit, which reduces outliers.
    """
    toned_down = scaled_residuals * loss.weights(scaled_residuals)
    worth = 1 / (1 + correlation_in_place(toned_down, labels) * (np.bincount(labels)[labels] - 1))
    return np.asarray(worth * (worth.sum() / np.sum(worth**2)), dtype=np.float64)


def correlation_in_place(errors: Array, labels: Indices) -> float:
    """Return the share, 0 to 1, of the errors' variance about zero that errors of one place have in common.

    This is the intraclass correlation by analysis of variance (Donner, "A review of inference procedures for the
    intraclass correlation coefficient in the one-way random effects model", 1986), with the mean known to be zero.

    Args:
        errors: (n,) without outliers or with outliers reduced. labels: (n,) of places, counted from 0.
    """
    counts = np.bincount(labels)
    num_places = len(counts)
    within_degrees = len(errors) - num_places
    if len(errors) < MIN_NUM_OF_SCATTER or within_degrees < MIN_NUM_OF_SCATTER:
        return 0.0
    means = np.bincount(labels, errors) / counts
    within = float(np.sum((errors - means[labels]) ** 2)) / within_degrees
    between = float(np.sum(counts * means**2)) / num_places
    typical_count = len(errors) / num_places
    total = between + (typical_count - 1) * within
    return float(np.clip((between - within) / total, 0.0, 1.0)) if total > NO_ERROR**2 else 0.0


@dataclass(frozen=True)
class InlierNoise:
    """Result of fitting a mixture of noise and outliers to residuals.

    Attributes:
        stddev: of the Gaussian bulk about zero, metres.
        num: expected number of residuals that belong to the bulk.
        log_likelihood: of all residuals; it compares two explanations of the same ranges.
    """

    stddev: float
    num: float
    log_likelihood: float


def inlier_noise(residuals: Array) -> InlierNoise:
    """Estimate the Gaussian bulk about zero of (n,) residuals, metres, however small its share is.

    A mixture of a Gaussian about zero and two exponential distributions, one for too long and one for too short ranges,
    is fitted by expectation maximisation (Dempster, Laird and Rubin, 1977). The median absolute deviation would take
    outliers for noise well before they are half of all residuals.
    """
    if len(residuals) < MIN_NUM_OF_SCATTER:
        return _gaussian(residuals)
    # Sorted, so that thinning keeps the distribution and the result does not depend on the order.
    sizes = np.abs(residuals)
    thinned = np.sort(residuals)[
        np.linspace(0, len(residuals) - 1, min(len(residuals), _MAX_NUM_SAMPLES)).astype(np.int64)
    ]
    stddev = max(float(np.quantile(sizes, _FIRST_SHARE)) / stddevs_within(_FIRST_SHARE), MIN_STDDEV_M)
    means = np.maximum([_mean_or_zero(sizes[residuals > 0]), _mean_or_zero(sizes[residuals < 0])], stddev)
    shares = np.array([0.5, 0.25, 0.25])
    before = np.zeros(6)
    for _ in range(MAX_NUM_ROUNDS):
        # Smaller errors than significant ones would be noise.
        means = np.maximum(means, SIGNIFICANT_STDDEVS * stddev)
        densities = _densities(thinned, stddev, means, shares)
        belongs = densities / np.maximum(densities.sum(axis=0), 1e-300)
        counts = np.maximum(belongs.sum(axis=1), 1e-9)
        shares = counts / counts.sum()
        stddev = max(float(np.sqrt(belongs[0] @ thinned**2 / counts[0])), MIN_STDDEV_M)
        means = (belongs[1:] @ np.abs(thinned)) / counts[1:]
        now = np.array([stddev, *means, *shares])
        if np.all(np.abs(now - before) <= ROUNDING * now):
            break
        before = now
    means = np.maximum(means, SIGNIFICANT_STDDEVS * stddev)
    densities = np.maximum(_densities(thinned, stddev, means, shares).sum(axis=0), 1e-300)
    return InlierNoise(stddev, float(shares[0]) * len(residuals), float(np.mean(np.log(densities))) * len(residuals))


def _densities(residuals: Array, stddev: float, means: Array, shares: Array) -> Array:
    """Return the (3, n) weighted densities: of noise, of too long and of too short ranges."""
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
    """Estimate a robust standard deviation of the ranges between one tag and one anchor.

    A parabola is fitted robustly to every 11 consecutive ranges. The middle range's distance from it, corrected for
    its own effect on the fit, is a sample of the noise. Errors that last longer than a window, such as a bias, are not
    seen; motion that is no parabola within a window counts as noise.

    Args:
        timestamp_s: (n,) in any order.
        range_m: (n,).

    Returns:
        Metres; None for fewer ranges than two windows, or for absurd values.
    """
    if len(range_m) < 2 * _WINDOW:
        return None
    order = np.argsort(timestamp_s, kind="stable")
    times = np.lib.stride_tricks.sliding_window_view(timestamp_s[order], _WINDOW)
    ranges = np.lib.stride_tricks.sliding_window_view(range_m[order], _WINDOW)
    span = times[:, -1] - times[:, 0]
    whole = np.flatnonzero(span <= _MAX_STRETCH * np.median(span))
    chosen = whole[:: -(-len(whole) // _MAX_NUM_SAMPLES)]
    with np.errstate(over="ignore", invalid="ignore"):  # times or ranges that no radio gives
        misses = _misses_of_parabola(times[chosen], ranges[chosen])
        noise = robust_stddev(misses - np.median(misses))
    return noise if np.isfinite(noise) else None


def _misses_of_parabola(times: Array, ranges: Array) -> Array:
    """Return (m,) distances of the middle of each row of (m, 11) ranges from a robust parabola through the others."""
    middle = _WINDOW // 2
    centred = times - times[:, middle : middle + 1]
    scaled = centred / np.maximum(np.abs(centred).max(axis=1, keepdims=True), MIN_STDDEV_M)
    powers = np.stack([np.ones_like(scaled), scaled, scaled**2], axis=2)
    weights = np.ones_like(ranges)
    offset = np.median(ranges, axis=1, keepdims=True)
    for _ in range(NUM_REWEIGHTINGS):
        normal = np.einsum("mi,mij,mik->mjk", weights, powers, powers) + MIN_STDDEV_M * np.eye(3)
        right = np.einsum("mi,mij,mi->mj", weights, powers, ranges - offset)
        coefficients = np.linalg.solve(normal, right[..., np.newaxis])
        residuals = ranges - offset - (powers @ coefficients)[..., 0]
        weights = CAUCHY.weights(residuals / robust_stddevs(residuals))
    plain = np.einsum("mij,mik->mjk", powers, powers) + MIN_STDDEV_M * np.eye(3)
    pull = np.linalg.inv(plain)[:, 0, 0]  # effect of the middle range on its fit; its powers are 1, 0, 0
    return np.asarray(residuals[:, middle] / np.sqrt(np.maximum(1 - pull, MIN_STDDEV_M)), np.float64)


def find_quantization_m(range_m: Array) -> float | None:
    """Return the step (0.1 or 0.01 m) of which all ranges are multiples; None if there is none or too few ranges."""
    if len(range_m) < MIN_NUM_OF_SCATTER:
        return None
    for step in _STEPS_M:
        if np.all(np.abs(range_m - np.round(range_m / step) * step) <= _ROUNDING * range_m):
            return step
    return None


def quantization_stddev_m(step_m: float) -> float:
    """Return the standard deviation of the rounding error, which is uniform over one step."""
    return step_m / math.sqrt(12)

"""The noise of the ranges that fit, where many or most do not."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rangesfm.arrays import Array
from rangesfm.ranging.errors.noise import robust_stddev

_MAX_NUM = 4000
_NUM_ROUNDS = 60
# The smallest tenth of Gaussian residuals lies within this many stddevs of zero.
_FIRST_SHARE, _FIRST_QUANTILE = 0.1, 0.1257
# Outliers err by this many stddevs in the mean, or they would be noise.
_MIN_OUTLIER_STDDEVS = 3.0
# Of fewer residuals a mixture can find anything.
_MIN_NUM = 20
_MIN_STDDEV_M = 1e-9
_MIN_DENSITY = 1e-300


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
    """The Gaussian bulk about zero, however small a share of the residuals it is.

    A mixture of a Gaussian about zero and two exponential distributions, one for too long and one for too short
    ranges, fitted by expectation maximisation (Dempster, Laird and Rubin, 1977). The median absolute deviation, which
    it replaces, takes outliers for noise well before they are half of all.

    Args:
        residuals: (n,) metres.
    """
    if len(residuals) < _MIN_NUM:
        return _gaussian(residuals)
    # Ordered, so that thinning keeps the distribution and the order of the ranges has no say.
    sizes = np.abs(residuals)
    thinned = np.sort(residuals)[np.linspace(0, len(residuals) - 1, min(len(residuals), _MAX_NUM)).astype(np.int64)]
    stddev = max(float(np.quantile(sizes, _FIRST_SHARE)) / _FIRST_QUANTILE, _MIN_STDDEV_M)
    means = np.maximum([_mean_or_zero(sizes[residuals > 0]), _mean_or_zero(sizes[residuals < 0])], stddev)
    shares = np.array([0.5, 0.25, 0.25])
    for _ in range(_NUM_ROUNDS):
        means = np.maximum(means, _MIN_OUTLIER_STDDEVS * stddev)
        densities = _densities(thinned, stddev, means, shares)
        belongs = densities / np.maximum(densities.sum(axis=0), _MIN_DENSITY)
        counts = np.maximum(belongs.sum(axis=1), 1e-9)
        shares = counts / counts.sum()
        stddev = max(float(np.sqrt(belongs[0] @ thinned**2 / counts[0])), _MIN_STDDEV_M)
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

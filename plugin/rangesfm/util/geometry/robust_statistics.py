"""Robust statistics: losses that limit the effect of outliers, and the scatter of values with outliers among them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy import special

from rangesfm.arrays import Array
from rangesfm.util.geometry.numerics import SIGNIFICANT_STDDEVS

MIN_STDDEV_M = 1e-9
"""Smallest standard deviation, metres; what is divided by is at least as large."""
# Relative difference of costs below which two fits are equal: rounding and the solver's tolerance.
SAME_COST = 1e-6
# Share of the degrees of freedom that is left, at least, where an estimate absorbs nearly all of the residuals.
_LEAST_LEFT = 0.1


def cost_of_deviation(num_stddevs: float) -> float:
    """Return the cost, a negative log-likelihood, of one deviation of so many standard deviations."""
    return num_stddevs**2 / 2


# Difference of costs from which the worse of two fits is ruled out.
MIN_COST_GAP = cost_of_deviation(SIGNIFICANT_STDDEVS)


@dataclass(frozen=True)
class RobustLoss:
    """A loss with ``rho(z) = z`` for small squared residuals z, and less for large ones.

    Attributes:
        width: residual, in standard deviations, from which a range gets less weight.
        is_bounded: True: Geman-McClure's loss z / (1 + z / width^2), bounded by width^2. False: Cauchy's loss,
            width^2 log(1 + z / width^2), which keeps growing and so converges from further away.
    """

    width: float
    is_bounded: bool

    def scaled(self, factor: float) -> RobustLoss:
        """Return the loss with its width multiplied by a factor, as for residuals in another unit."""
        return replace(self, width=factor * self.width)

    def rho(self, squared: Array) -> Array:
        """Return (3, n) the loss and its first two derivatives by the squared residual, as scipy needs them."""
        ratio = 1 + squared / self.width**2
        with np.errstate(over="ignore"):  # a step that goes astray may end anywhere; what overflows there is 0 then
            if self.is_bounded:
                return np.stack([squared / ratio, 1 / ratio**2, -2 / (self.width**2 * ratio**3)])
            logarithm = np.log1p(squared / self.width**2)
            return np.stack([self.width**2 * logarithm, 1 / ratio, -1 / (self.width * ratio) ** 2])

    def weights(self, scaled_residuals: Array) -> Array:
        """Return (n,) weights in (0, 1] of the weighted least squares with the same gradient."""
        return np.asarray(self.rho(scaled_residuals**2)[1])


# Width for 95 % efficiency under Gaussian noise. Used in first rounds, and where a start may be far off.
CAUCHY = RobustLoss(2.385, is_bounded=False)
# One percent less efficient; many outliers on one side shift the estimate far less. Used in last rounds.
GEMAN_MCCLURE = RobustLoss(3.46, is_bounded=True)


def wider(bounded: RobustLoss) -> RobustLoss:
    """Return Cauchy's loss that corresponds to a bounded loss as CAUCHY does to GEMAN_MCCLURE."""
    return CAUCHY.scaled(bounded.width / GEMAN_MCCLURE.width)


def factor_of_stddevs(scaled: Array, num_absorbed: float) -> float:
    """Return the factor of standard deviations that (g, d) residuals show, by the median of the lengths of all g.

    Args:
        scaled: residuals in these standard deviations, independent. num_absorbed: degrees of freedom of the residuals
            that an estimate has absorbed.
    """
    freedom = scaled.size / max(scaled.size - num_absorbed, _LEAST_LEFT * scaled.size)
    expected = float(np.sqrt(special.chdtri(scaled.shape[1], 0.5)))
    return float(np.sqrt(freedom) * np.median(np.linalg.norm(scaled, axis=1))) / expected


def robust_stddev(residuals: npt.ArrayLike) -> float:
    """Return the stddev of the Gaussian bulk of (n,) residuals: scaled median absolute deviation from 0, never 0."""
    return float(robust_stddevs(np.reshape(residuals, (1, -1)))[0, 0]) if np.size(residuals) else MIN_STDDEV_M


def robust_stddevs(residuals: Array) -> Array:
    """Return the (..., 1) robust standard deviations of the rows of (..., n) residuals."""
    stddevs: Array = np.median(np.abs(residuals), axis=-1, keepdims=True) / stddevs_within(1 / 2)
    return np.maximum(stddevs, MIN_STDDEV_M)


def stddevs_within(share: float) -> float:
    """Return the distance from the mean, in standard deviations, within which a share of a normal distribution is."""
    return float(special.ndtri((1 + share) / 2))

"""Losses that limit what an outlier can do, as functions of residuals in stddevs."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rangesfm.arrays import Array

# Costs that two fits have alike, but for rounding and a solver's last step, differ by less.
SAME_COST = 1e-6


@dataclass(frozen=True)
class RobustLoss:
    """``rho(z) = z`` for small squared residuals z, less for large ones.

    Attributes:
        width: residual, in stddevs, from which a range counts for less.
        is_bounded: Geman-McClure's loss z / (1 + z / width^2), which no outlier raises beyond width^2; otherwise
            Cauchy's, width^2 log(1 + z / width^2), which grows on and so leads to a minimum from further away.
    """

    width: float
    is_bounded: bool

    def scaled(self, factor: float) -> RobustLoss:
        """Of another width, as for residuals in another unit."""
        return replace(self, width=factor * self.width)

    def rho(self, squared: Array) -> Array:
        """(3, n) the loss and its first two derivatives by the squared residual, as scipy wants them."""
        ratio = 1 + squared / self.width**2
        if self.is_bounded:
            return np.stack([squared / ratio, 1 / ratio**2, -2 / (self.width**2 * ratio**3)])
        return np.stack([self.width**2 * np.log1p(squared / self.width**2), 1 / ratio, -1 / (self.width * ratio) ** 2])

    def weights(self, scaled_residuals: Array) -> Array:
        """(n,) in (0, 1]: of the weighted least squares with the same gradient."""
        return np.asarray(self.rho(scaled_residuals**2)[1])

    def slopes(self, scaled_residuals: Array) -> Array:
        """(n,) derivative of the root of the loss by the residual: of residuals whose squares are the loss."""
        rho, first, _ = self.rho(scaled_residuals**2)
        root = np.sqrt(rho)
        return np.where(root > 0, first * np.abs(scaled_residuals) / np.maximum(root, 1e-300), 1.0)


# Of this width the efficiency under Gaussian noise is 95 %. For first rounds, and where a start may be far off.
CAUCHY = RobustLoss(2.385, is_bounded=False)
# A percent less, and many outliers to one side shift the estimate by a small part as much. For last rounds.
GEMAN_MCCLURE = RobustLoss(3.46, is_bounded=True)


def wider(bounded: RobustLoss) -> RobustLoss:
    """Cauchy's loss that stands to one of Geman and McClure's as CAUCHY to GEMAN_MCCLURE."""
    return CAUCHY.scaled(bounded.width / GEMAN_MCCLURE.width)

"""Losses that limit what an outlier can do, as functions of residuals in stddevs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rangesfm.ranging.observations import CAUCHY_WIDTH

Array = npt.NDArray[np.float64]


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

    def rho(self, squared: Array) -> Array:
        """(3, n) the loss and its first two derivatives by the squared residual, as scipy wants them."""
        ratio = 1 + squared / self.width**2
        if self.is_bounded:
            return np.stack([squared / ratio, 1 / ratio**2, -2 / (self.width**2 * ratio**3)])
        return np.stack([self.width**2 * np.log(ratio), 1 / ratio, -1 / (self.width * ratio) ** 2])

    def weights(self, scaled_residuals: Array) -> Array:
        """(n,) in (0, 1]: of the weighted least squares with the same gradient."""
        weights: Array = self.rho(scaled_residuals**2)[1]
        return weights

    def curvatures(self, scaled_residuals: Array) -> Array:
        """(n,) second derivative of half the loss by the residual."""
        squared = scaled_residuals**2
        _, first, second = self.rho(squared)
        curvatures: Array = first + 2 * squared * second
        return curvatures


CAUCHY = RobustLoss(CAUCHY_WIDTH, is_bounded=False)
# Of this width the efficiency under Gaussian noise is 94 %, a percent less than that of CAUCHY, and many outliers to
# one side shift the estimate by a small part as much.
GEMAN_MCCLURE = RobustLoss(3.46, is_bounded=True)

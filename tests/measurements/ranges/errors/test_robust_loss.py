"""The robust losses: their derivatives, their limits and their cost in efficiency without outliers."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from rangesfm.util.geometry.robust_statistics import CAUCHY, GEMAN_MCCLURE, RobustLoss

BOTH = pytest.mark.parametrize("loss", [CAUCHY, GEMAN_MCCLURE], ids=["Cauchy", "Geman-McClure"])


@BOTH
def test_derivatives_are_those_of_the_loss(loss: RobustLoss) -> None:
    squared, step = np.linspace(0.1, 60.0, 200), 1e-4
    _, first, second = loss.rho(squared)
    higher, lower = loss.rho(squared + step), loss.rho(squared - step)
    np.testing.assert_allclose(first, (higher[0] - lower[0]) / (2 * step), rtol=1e-6)
    np.testing.assert_allclose(second, (higher[1] - lower[1]) / (2 * step), rtol=1e-5, atol=1e-9)


def curvatures(loss: RobustLoss, residuals: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return the second derivative of half the loss by the residual."""
    _, first, second = loss.rho(residuals**2)
    return np.asarray(first + 2 * residuals**2 * second)


@BOTH
def test_under_gaussian_noise_it_is_nearly_as_good_as_least_squares(loss: RobustLoss) -> None:
    z, step = np.linspace(-9.0, 9.0, 20_001, retstep=True)
    density = np.exp(-0.5 * z**2) / np.sqrt(2 * np.pi) * step
    efficiency = (density @ curvatures(loss, z)) ** 2 / (density @ (z * loss.weights(z)) ** 2)
    assert 0.93 < efficiency < 0.96


def test_only_the_bounded_one_is_bounded() -> None:
    assert GEMAN_MCCLURE.rho(np.array([1e12]))[0, 0] == pytest.approx(GEMAN_MCCLURE.width**2)
    assert CAUCHY.rho(np.array([1e12]))[0, 0] > 100

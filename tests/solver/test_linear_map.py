"""Least squares with correlated errors and priors is that of the textbook."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from rangesfm.solver.linear_map import Solved

Array = npt.NDArray[np.float64]


def correlated(num: int, rng: np.random.Generator) -> Array:
    root = rng.standard_normal((num, num))
    covariance: Array = root @ root.T + 0.5 * np.eye(num)
    return covariance


def test_the_estimate_is_that_of_generalised_least_squares_with_priors() -> None:
    rng = np.random.default_rng(0)
    covariance, design, residual = correlated(8, rng), rng.standard_normal((8, 3)), rng.standard_normal(8)
    prior_design, prior_residual = rng.standard_normal((2, 3)), rng.standard_normal(2)
    # The units of the unknowns may be as different as they like.
    units = np.array([1.0, 1e9, 1e-9])
    solved = Solved(covariance, np.vstack([design, prior_design]) * units, np.append(residual, prior_residual))
    information = design.T @ np.linalg.solve(covariance, design) + prior_design.T @ prior_design
    right = design.T @ np.linalg.solve(covariance, residual) + prior_design.T @ prior_residual
    step = -np.linalg.solve(information, right)
    np.testing.assert_allclose(solved.covariance * np.outer(units, units), np.linalg.inv(information), rtol=1e-8)
    np.testing.assert_allclose(solved.step * units, step, rtol=1e-8)
    left, prior_left = residual + design @ step, prior_residual + prior_design @ step
    squares = left @ np.linalg.solve(covariance, left) + prior_left @ prior_left
    assert solved.residual @ solved.residual == pytest.approx(squares, rel=1e-8)
    assert len(solved.residual) == 10
    np.testing.assert_allclose(solved.residual[8:], prior_left, rtol=1e-7)

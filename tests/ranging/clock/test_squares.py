"""The linear fit of squared ranges to a path finds scale, slopes and weights without any start."""

from __future__ import annotations

import numpy as np
import pytest

from rangesfm.arrays import Array, Indices
from rangesfm.ranging.clock.squares import fit_squares

ANCHORS_M = np.array([[4.0, -3.0, 2.0], [-5.0, 1.0, 1.0]])
SCALE = 0.7


def a_path(num: int = 40, seed: int = 0) -> tuple[Array, Indices]:
    """Return scattered places far from the origin, model units, and the anchor of the range at each."""
    rng = np.random.default_rng(seed)
    return np.array([30.0, -20.0, 5.0]) + 3 * rng.normal(size=(num, 3)), np.arange(num) % 2


def distances_m(points: Array, anchor: Indices) -> Array:
    """Return the ranges to the anchors, which stand around the place (30, -20, 5) of the path."""
    return np.asarray(np.linalg.norm(SCALE * (points - [30, -20, 5]) - ANCHORS_M[anchor], axis=1))


def slopes_of(points: Array, anchor: Indices) -> Array:
    """Return the derivatives of the ranges by the points: the scale times the direction from the anchor."""
    away = SCALE * (points - [30, -20, 5]) - ANCHORS_M[anchor]
    return np.asarray(SCALE * away / np.linalg.norm(away, axis=1)[:, None])


def test_exact_ranges_give_the_scale_and_the_slopes_and_leave_nothing() -> None:
    points, anchor = a_path()
    fit = fit_squares(points, distances_m(points, anchor), anchor)
    assert fit.scale == pytest.approx(SCALE, rel=1e-9)
    np.testing.assert_allclose(fit.residuals_m, 0.0, atol=1e-10)
    np.testing.assert_allclose(fit.weights, 1.0)
    np.testing.assert_allclose(fit.gradient, slopes_of(points, anchor), atol=1e-9)
    assert fit.num_unknowns == 9

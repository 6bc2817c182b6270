"""Errors that ranges share: the covariance that their modes stand for."""

from __future__ import annotations

import numpy as np

from rangesfm.ranging.errors.shared_errors import ANTENNA_STDDEV_M, antenna_modes, curve_modes


def test_an_error_curve_is_as_large_as_said_and_smooth_in_the_logarithm_of_distance() -> None:
    distance, stddev = np.geomspace(0.5, 20.0, 60), np.linspace(0.05, 0.1, 60)
    modes = curve_modes(distance, stddev)
    apart = np.log(distance[:, None] / distance)
    expected = stddev[:, None] * stddev * np.exp(-0.5 * apart**2)
    np.testing.assert_allclose(modes @ modes.T, expected, atol=0.02 * 0.1**2)


def test_an_antenna_errs_by_the_angle_between_two_directions_alone() -> None:
    directions = np.random.default_rng(0).standard_normal((50, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    modes, cosine = antenna_modes(directions), directions @ directions.T
    expected = ANTENNA_STDDEV_M**2 * (cosine / 2 + (3 * cosine**2 - 1) / 4)
    np.testing.assert_allclose(modes @ modes.T, expected, atol=1e-12)

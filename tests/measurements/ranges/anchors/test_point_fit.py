"""The residuals of a point fitted to ranges at known positions, and their derivatives."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from rangesfm.measurements.ranges.anchors.point_fit import (
    PointProblem,
)

Array = npt.NDArray[np.float64]

POINT = np.array([3.0, -2.0, 1.5])


def scattered(num: int, seed: int = 0) -> Array:
    positions: Array = np.random.default_rng(seed).uniform(-4.0, 4.0, (num, 3))
    return np.asarray(positions + np.array([0.0, 0.0, 1.0]))


def distances(positions: Array, point: Array = POINT) -> Array:
    return np.asarray(np.linalg.norm(positions - point, axis=-1))


def problem_of(positions: Array, off_m: Array | float = 0.0, *, bias_stddev_m: float = 0.1) -> PointProblem:
    num = len(positions)
    return PointProblem(
        positions_m=positions,
        range_m=distances(positions) + off_m,
        stddev_m=np.full(num, 0.05),
        shared_stddev_m=np.zeros(num),
        prior_mean=np.zeros(4),
        prior=np.array([[0.0, 0.0, 0.0, 1 / bias_stddev_m]]),
    )


class TestProblem:
    def test_residuals_are_predicted_minus_measured_and_slopes_their_derivatives(self) -> None:
        problem = problem_of(scattered(6), 0.3)
        x = np.append(POINT + np.array([0.1, -0.2, 0.3]), 0.2)
        np.testing.assert_allclose(
            problem.residuals_m(x), distances(scattered(6), x[:3]) + 0.2 - distances(scattered(6)) - 0.3
        )
        step = 1e-6 * np.eye(4)
        differences = [(problem.residuals_m(x + h) - problem.residuals_m(x - h)) / 2e-6 for h in step]
        np.testing.assert_allclose(problem.slopes(x), np.transpose(differences), atol=1e-7)
        halved = replace(problem, stddev_m=np.linspace(0.1, 0.6, 6))
        np.testing.assert_allclose(halved.jacobian(x), problem.slopes(x) / np.linspace(0.1, 0.6, 6)[:, None])

"""The prior of a map's placement: its derivatives, and its minimum at its mean."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from rangesfm.measurements.ranges.scale.placement_prior import PlacementPrior
from rangesfm.util.geometry.similarity import Similarity

STEP = 1e-6


def random_similarity(rng: np.random.Generator) -> Similarity:
    rotation = Rotation.from_rotvec(rng.standard_normal(3)).as_matrix()
    return Similarity(float(np.exp(rng.standard_normal())), rotation, rng.standard_normal(3))


def test_residuals_vanish_at_the_mean_and_their_derivatives_are_right() -> None:
    rng = np.random.default_rng(1)
    for _ in range(5):
        mean, root = random_similarity(rng), rng.standard_normal((7, 7)) + 3 * np.eye(7)
        prior = PlacementPrior(mean, np.linalg.inv(np.linalg.cholesky(root @ root.T)))
        np.testing.assert_allclose(prior.residuals(mean), 0.0, atol=1e-12)
        at = random_similarity(rng)

        def moved(step: np.typing.NDArray[np.float64], at: Similarity = at) -> Similarity:
            rotation = Rotation.from_rotvec(step[1:4]).as_matrix() @ at.rotation
            return Similarity(at.scale * float(np.exp(step[0])), rotation, at.translation + step[4:])

        numeric = np.column_stack(
            [(prior.residuals(moved(STEP * e)) - prior.residuals(moved(-STEP * e))) / (2 * STEP) for e in np.eye(7)]
        )
        np.testing.assert_allclose(prior.jacobian(at, np.eye(3)), numeric, atol=1e-6)

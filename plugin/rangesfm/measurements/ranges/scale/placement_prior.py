"""Prior on the similarity from a model to the site, as known positions give it, for the range equation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from rangesfm.arrays import Array
from rangesfm.util.geometry.rotations import cross_matrices, left_jacobians
from rangesfm.util.geometry.similarity import Similarity


@dataclass(frozen=True)
class PlacementPrior:
    """Normal distribution of a similarity.

    Attributes:
        mean: site_from_model.
        middle: (3,) point of the model about which the covariance is.
        whitening: (7, 7) of the errors of the logarithm of the scale, a turn and a shift of that point.
    """

    mean: Similarity
    middle: Array
    whitening: Array

    @classmethod
    def with_covariance(cls, mean: Similarity, middle: Array, covariance: Array) -> PlacementPrior:
        """Return the prior with this (7, 7) covariance."""
        return cls(mean, middle, np.linalg.inv(np.linalg.cholesky(covariance)))

    def residuals(self, similarity: Similarity) -> Array:
        """Return the residuals (7,) of a similarity, in standard deviations."""
        return np.asarray(self.whitening @ self._off(similarity))

    def _off(self, similarity: Similarity) -> Array:
        turn = Rotation.from_matrix(similarity.rotation @ self.mean.rotation.T).as_rotvec()
        shift = similarity.apply(self.middle[None])[0] - self.mean.apply(self.middle[None])[0]
        return np.array([np.log(similarity.scale / self.mean.scale), *turn, *shift])

    def jacobian(self, similarity: Similarity, left: Array) -> Array:
        """Return the (7, 7) derivatives of the residuals by the logarithm of the scale, a turn and a translation.

        Args:
            left: (3, 3) left Jacobian of the rotation vector, as in ``Gravity.jacobian``.
        """
        grown = similarity.scale * similarity.rotation @ self.middle
        own = left_jacobians(Rotation.from_matrix(similarity.rotation @ self.mean.rotation.T).as_rotvec())
        slopes = np.zeros((7, 7))
        slopes[0, 0] = 1.0
        slopes[1:4, 1:4] = np.linalg.inv(own) @ left
        slopes[4:, 0] = grown
        slopes[4:, 1:4] = -cross_matrices(grown[None])[0] @ left
        slopes[4:, 4:] = np.eye(3)
        return np.asarray(self.whitening @ slopes)

"""Prior on the similarity from a model to the site, as known positions give it, for the range equation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from rangesfm.arrays import Array
from rangesfm.util.geometry.rotations import left_jacobians
from rangesfm.util.geometry.similarity import Similarity


@dataclass(frozen=True)
class PlacementPrior:
    """Normal distribution of a similarity.

    Attributes:
        mean: site_from_model.
        whitening: (7, 7) of the errors of the logarithm of the scale, a turn and a shift about the model's origin.
    """

    mean: Similarity
    whitening: Array

    def _turn(self, similarity: Similarity) -> Array:
        return np.asarray(Rotation.from_matrix(similarity.rotation @ self.mean.rotation.T).as_rotvec())

    def residuals(self, similarity: Similarity) -> Array:
        """Return the residuals (7,) of a similarity, in standard deviations."""
        log_scale, shift = np.log(similarity.scale / self.mean.scale), similarity.translation - self.mean.translation
        return np.asarray(self.whitening @ np.array([log_scale, *self._turn(similarity), *shift]))

    def jacobian(self, similarity: Similarity, left: Array) -> Array:
        """Return the (7, 7) derivatives of the residuals by the logarithm of the scale, a turn and a translation.

        Args:
            left: (3, 3) left Jacobian of the rotation vector, as in ``Gravity.jacobian``.
        """
        slopes = np.eye(7)
        slopes[1:4, 1:4] = np.linalg.inv(left_jacobians(self._turn(similarity))) @ left
        return np.asarray(self.whitening @ slopes)

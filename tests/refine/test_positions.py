"""Known positions that hold a map in the refinement: which take part, and the residuals that they become."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from rangesfm.refine.bundle_adjustment import BundleAdjustment

Array = npt.NDArray[np.float64]


def residuals_added(bundle: BundleAdjustment) -> Array:
    """Return the residuals after those of the photos, but for the ties, which are always zero."""
    residuals = np.asarray(bundle.adjuster.problem.evaluate_residuals())[bundle.num_reprojections :]
    return np.asarray(residuals[residuals != 0])

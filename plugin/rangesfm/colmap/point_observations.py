"""Points that the photos of a model see, and their image coordinates."""

from __future__ import annotations

import numpy as np
import pycolmap
from scipy.sparse import csr_array

from rangesfm.arrays import Array, Indices


def seen_in(image: pycolmap.Image) -> tuple[Indices, Array]:
    """Return the ids (n,) of the 3-D points that a photo sees, and their image coordinates (n, 2) in pixels."""
    seen = [(point.point3D_id, point.x(), point.y()) for point in image.get_observation_points2D()]
    columns = np.array(seen, dtype=np.float64).reshape(-1, 3)
    return columns[:, 0].astype(np.int64), columns[:, 1:]


def overlaps_in(model: pycolmap.Reconstruction) -> csr_array:
    """Return the sparse matrix (n, n) of the numbers of points that pairs of the n registered photos both see."""
    photos = [
        [point.point3D_id for point in model.image(image_id).get_observation_points2D()]
        for image_id in model.reg_image_ids()
    ]
    starts = np.cumsum([0, *map(len, photos)])
    of_point = np.unique(np.concatenate(photos).astype(np.int64), return_inverse=True)[1]
    sees = csr_array((np.ones(len(of_point)), of_point, starts), shape=(len(photos), int(of_point.max(initial=-1)) + 1))
    return csr_array(sees @ sees.T)

"""Resection: the pose of a photo by the points of other photos that it was matched with."""

from __future__ import annotations

from typing import Any

import numpy as np
import pycolmap

from rangesfm.arrays import Array, Mask
from rangesfm.colmap.pieces import MIN_NUM_SHARED

# Largest error of a match, in pixels: that of COLMAP's two-view geometries, which these matches have passed.
_MAX_ERROR_PX = pycolmap.TwoViewGeometryOptions().ransac.max_error


def resection_options(seed: int) -> pycolmap.AbsolutePoseEstimationOptions:
    """Return COLMAP's options for a resection, with the error that matches may have and the seed of its draws."""
    options = pycolmap.AbsolutePoseEstimationOptions()
    options.ransac.random_seed, options.ransac.max_error = seed, _MAX_ERROR_PX
    return options


def resect(pixels: Array, points: Array, camera: pycolmap.Camera, seed: int) -> tuple[pycolmap.Rigid3d, Mask] | None:
    """Return cam_from_world of a photo and which of its features fit; None if too few of them agree on a pose.

    Args:
        pixels, points: (m, 2), (m, 3) features of the photo, and the points that they show.
        seed: of the draws.
    """
    found: dict[str, Any] | None = None
    if len(points) >= MIN_NUM_SHARED:
        found = pycolmap.estimate_and_refine_absolute_pose(pixels, points, camera, resection_options(seed))
    if found is None or int(found["num_inliers"]) < MIN_NUM_SHARED:
        return None
    return found["cam_from_world"], np.asarray(found["inlier_mask"])

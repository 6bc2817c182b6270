"""Reprojection errors of a model, and the test whether model, photos and cameras belong together."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pycolmap

from rangesfm.arrays import Array
from rangesfm.colmap.point_observations import seen_in

# COLMAP keeps no observation with a larger error, in pixels (IncrementalPipelineOptions.filter_max_reproj_error).
_MAX_ERROR_PX = 4.0
# The same limit for large photos, as a fraction of the longer side, because features of large photos are less precise.
_MAX_ERROR_SHARE = 0.005
MISMATCHED = "check that model, photos and the camera's parameters belong together"


@dataclass(frozen=True)
class PointErrors:
    """Reprojection errors of n points.

    Attributes:
        error_px: (n,) mean over the photos that see a point, in pixels; huge where it lies behind one of them.
        points: (n, 3) positions in the model's world.
        max_median_px: largest median error that a model of these photos can have, in pixels.
    """

    error_px: Array
    points: Array
    max_median_px: float

    @property
    def median_px(self) -> float:
        """Median of the points' errors in pixels; NaN without points."""
        return float(np.median(self.error_px)) if len(self.error_px) else float("nan")

    @property
    def fit(self) -> bool:
        """Return whether the points can belong to these photos and cameras; true without points."""
        return not self.median_px > self.max_median_px

    def apart(self, whose: str, photos: str = "the photos") -> str:
        """Return a message that says how far off the points are.

        Args:
            whose: name of the model.
            photos: words for the photos.
        """
        return (
            f"{whose}'s points lie {self.median_px:.3g} px (median) from where {photos} show them, expected below "
            f"{self.max_median_px:.3g} px"
        )


def point_errors(model: pycolmap.Reconstruction) -> PointErrors:
    """Compute the reprojection errors of a model's points, in the order of their ids."""
    measured = pycolmap.Reconstruction(model)
    measured.update_point_3d_errors()
    points = [point for _, point in sorted(measured.points3D.items())]
    longest_px = max((max(camera.width, camera.height) for camera in measured.cameras.values()), default=0)
    return PointErrors(
        np.array([point.error for point in points], dtype=np.float64),
        np.array([point.xyz for point in points], dtype=np.float64).reshape(-1, 3),
        max(_MAX_ERROR_PX, _MAX_ERROR_SHARE * longest_px),
    )


def photo_errors_px(model: pycolmap.Reconstruction) -> dict[str, float]:
    """Return the median reprojection error in pixels of each registered photo that sees points, by name.

    It is infinite if most of its points lie behind the photo.
    """
    medians = {}
    xyz = {point_id: point.xyz for point_id, point in model.points3D.items()}
    for image_id in sorted(model.reg_image_ids()):
        image = model.image(image_id)
        ids, xy = seen_in(image)
        if not len(ids):
            continue
        in_cam = image.cam_from_world() * np.array([xyz[point_id] for point_id in ids.tolist()])
        pixels = np.asarray(model.camera(image.camera_id).img_from_cam(in_cam), dtype=np.float64)
        off_px = np.linalg.norm(pixels - xy, axis=1)
        medians[image.name] = float(np.median(np.where((in_cam[:, 2] > 0) & np.isfinite(off_px), off_px, np.inf)))
    return medians

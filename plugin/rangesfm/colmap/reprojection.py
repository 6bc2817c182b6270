"""How far a model's points lie from where its photos show them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pycolmap

from rangesfm.arrays import Array
from rangesfm.colmap.observations import seen_in

# COLMAP itself keeps no observation that is farther off (IncrementalPipelineOptions.filter_max_reproj_error).
_MAX_ERROR_PX = 4.0
# Of the longer side of a photo: features of large photos are coarser.
_MAX_ERROR_SHARE = 0.005
MISMATCHED = "check that model, photos and the camera's parameters belong together"


@dataclass(frozen=True)
class PointErrors:
    """Of n points.

    Attributes:
        error_px: (n,) mean over the photos that see a point; huge where it lies behind one of them.
        points: (n, 3) in the model's world.
        max_median_px: more than that, in the middle, no model of these photos has.
    """

    error_px: Array
    points: Array
    max_median_px: float

    @property
    def median_px(self) -> float:
        """NaN without points."""
        return float(np.median(self.error_px)) if len(self.error_px) else float("nan")

    @property
    def fit(self) -> bool:
        """Whether the points are of these photos and cameras at all; nothing speaks against no points."""
        return not self.median_px > self.max_median_px

    def apart(self, whose: str, photos: str = "the photos") -> str:
        """In words, how far points lie that do not fit."""
        return (
            f"{whose}'s points lie {self.median_px:.3g} px (median) from where {photos} show them, expected below "
            f"{self.max_median_px:.3g} px"
        )


def point_errors(model: pycolmap.Reconstruction) -> PointErrors:
    """Of a model's points, in the order of their ids."""
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
    """Median reprojection error of each registered photo that sees points, by name; infinite where most lie behind."""
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

"""Reprojection errors of a model, and the test whether model, photos and cameras belong together."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product

import numpy as np
import pycolmap

from rangesfm.arrays import Array
from rangesfm.colmap.pieces import seen_in

# COLMAP keeps no observation with a larger error, in pixels (IncrementalPipelineOptions.filter_max_reproj_error).
_MAX_ERROR_PX = 4.0
# The same limit for large photos, as a fraction of the longer side, because features of large photos are less precise.
_MAX_ERROR_SHARE = 0.005
# Photos on which other axes are tried.
_NUM_PHOTOS = 30
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


def wrong_axes(model: pycolmap.Reconstruction) -> str | None:
    """Return in words which axes of a model are not as COLMAP has them; None if none are found.

    Programs with left-handed axes write models that are mirrored, and others have cameras that look along -z. Each
    choice of signs, or exchange of two axes, is tried on points that do not fit their photos as they are.
    """
    errors = point_errors(model)
    if errors.fit:
        return None
    sample = list(_observations(model))
    for cameras, points in sorted(product(_OF_CAMERAS, _OF_POINTS), key=lambda both: sum(map(len, both))):
        if _median_px(model, sample, _OF_CAMERAS[cameras], _OF_POINTS[points]) <= errors.max_median_px:
            is_mirrored = min(np.linalg.det(_OF_CAMERAS[cameras]), np.linalg.det(_OF_POINTS[points])) < 0
            kind = "is mirrored, as left-handed programs write it" if is_mirrored else "has other axes than COLMAP"
            changed = " and ".join(filter(None, (points, cameras)))
            return (
                f"the model {kind}: its points are where its photos show them only with {changed}, expected "
                "right-handed coordinates and cameras with x right, y down, z forward: export it so"
            )
    return None


def _signs(letters: str) -> Array:
    return np.diag([-1.0 if letter in letters else 1.0 for letter in "xyz"])


_SIGNS = ("x", "y", "z", "xy", "xz", "yz", "xyz")
# What is changed, in words, with the matrix that changes it: axes of the cameras, and coordinates of the points.
_OF_CAMERAS = {"": np.eye(3)} | {f"the cameras' {' and '.join(s)} in the other direction": _signs(s) for s in _SIGNS}
_OF_POINTS = (
    {"": np.eye(3)}
    | {f"the other sign of the points' {' and '.join(s)}": _signs(s) for s in _SIGNS}
    | {
        f"the points' {words} exchanged": np.eye(3)[order]
        for words, order in {"x and y": [1, 0, 2], "x and z": [2, 1, 0], "y and z": [0, 2, 1]}.items()
    }
)


def _observations(model: pycolmap.Reconstruction) -> Iterator[tuple[pycolmap.Image, Array, Array]]:
    """Yield some photos with the points (n, 3) that they see, and where they see them (n, 2), in pixels."""
    ids = sorted(model.reg_image_ids())
    for image_id in ids[:: -(-len(ids) // _NUM_PHOTOS)]:
        image = model.image(image_id)
        seen, xy = seen_in(image)
        if len(seen):
            yield image, np.array([model.point3D(point_id).xyz for point_id in seen.tolist()]), xy


def _median_px(
    model: pycolmap.Reconstruction, sample: list[tuple[pycolmap.Image, Array, Array]], cameras: Array, points: Array
) -> float:
    """Return the median reprojection error in pixels after a change of axes; infinite where most are behind."""
    return float(
        np.median(np.concatenate([_off_px(model, image, xyz @ points.T, xy, cameras) for image, xyz, xy in sample]))
    )


def _off_px(model: pycolmap.Reconstruction, image: pycolmap.Image, xyz: Array, xy: Array, cameras: Array) -> Array:
    """Return how far (n,) points are from where a photo sees them, in pixels; infinite for those behind it."""
    in_cam = (image.cam_from_world() * xyz) @ cameras.T
    pixels = np.asarray(model.camera(image.camera_id).img_from_cam(in_cam), dtype=np.float64)
    off_px = np.linalg.norm(pixels - xy, axis=1)
    return np.where((in_cam[:, 2] > 0) & np.isfinite(off_px), off_px, np.inf)


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
        points = np.array([xyz[point_id] for point_id in ids.tolist()])
        medians[image.name] = float(np.median(_off_px(model, image, points, xy, np.eye(3))))
    return medians

"""Photos that see the same part of the site, as the refined map predicts."""

from __future__ import annotations

from collections.abc import Mapping, Set
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import pycolmap

from rangesfm.arrays import Array, Indices
from rangesfm.colmap.pieces import ids_seen_in

# Points of a photo that stand for all that it sees, evenly chosen from them.
_NUM_POINTS = 40
MIN_OVERLAP = 0.3
"""Smallest share of them that has to fall into the other photo. Neighbours in time usually share more than half."""

# SIFT features are hardly found again from a direction that differs by more, or at another size than this: Lowe,
# "Distinctive image features from scale-invariant keypoints", IJCV 2004, section 3.3 and figure 8.
_MAX_ANGLE_DEG, _MAX_SIZE_RATIO = 45.0, 2.0


@dataclass(frozen=True)
class Views:
    """Views of n photos in a metric map, in the order of their keyframes.

    Attributes:
        image_ids, frame: (n,) ids of the photos, and indices of their keyframes.
        world_from_cam: (n, 3, 3) rotations. centers: (n, 3) projection centres.
        points: (n, m, 3) some of the points that each photo sees.
        focal_px, middle_px, size_px: (n, 2) focal lengths, principal point and size of each photo.
    """

    image_ids: Indices
    frame: Indices
    world_from_cam: Array
    centers: Array
    points: Array
    focal_px: Array
    middle_px: Array
    size_px: Array

    @classmethod
    def in_model(cls, model: pycolmap.Reconstruction, frame_ids: Indices) -> Views:
        """Return the views of the photos of these frames that see any points."""
        place = {frame_id: k for k, frame_id in enumerate(frame_ids.tolist())}
        images = [model.image(image_id) for image_id in model.reg_image_ids()]
        images = [image for image in images if image.frame_id in place and image.num_points3D]
        images.sort(key=lambda image: (image.camera_id, place[image.frame_id]))
        cameras = [model.camera(image.camera_id) for image in images]
        return cls(
            np.array([image.image_id for image in images], dtype=np.int64),
            np.array([place[image.frame_id] for image in images], dtype=np.int64),
            np.array([image.cam_from_world().rotation.matrix().T for image in images]).reshape(-1, 3, 3),
            np.array([image.projection_center() for image in images]).reshape(-1, 3),
            np.array([_some_points(model, image) for image in images]).reshape(-1, _NUM_POINTS, 3),
            np.array([(camera.focal_length_x, camera.focal_length_y) for camera in cameras]).reshape(-1, 2),
            np.array([(camera.principal_point_x, camera.principal_point_y) for camera in cameras]).reshape(-1, 2),
            np.array([(camera.width, camera.height) for camera in cameras], dtype=np.float64).reshape(-1, 2),
        )

    @cached_property
    def row_of(self) -> dict[int, int]:
        """Return the row of each photo by its id."""
        return {id_: row for row, id_ in enumerate(self.image_ids.tolist())}

    @cached_property
    def targets(self) -> Array:
        """Return the (n, 3) middles of what the photos see."""
        return np.asarray(np.median(self.points, axis=1))

    def overlaps(self, first: int, others: Indices, margin_m: Array, *, from_anywhere: bool) -> Array:
        """Return the (k,) shares of the points of one photo that can be found again in k others.

        Lenses without distortion do for this.

        Args:
            margin_m: (k,) by how much the other photos may be out of place.
            from_anywhere: whether to count points that are seen from another direction or distance, too.
        """
        from_first = self.points[first] - self.centers[first]
        from_others = self.points[first] - self.centers[others, None]
        distance, other_distance = (np.linalg.norm(rays, axis=-1) for rays in (from_first, from_others))
        cosine = np.einsum("mi,kmi->km", from_first, from_others) / (distance * other_distance)
        is_alike = cosine > np.cos(np.radians(_MAX_ANGLE_DEG))
        is_alike &= np.abs(np.log(other_distance / distance)) < np.log(_MAX_SIZE_RATIO)
        in_cam = from_others @ self.world_from_cam[others]
        depth = np.maximum(in_cam[..., 2:], 1e-9)
        focal, middle, size = (of[others, None] for of in (self.focal_px, self.middle_px, self.size_px))
        pixel, margin = focal * in_cam[..., :2] / depth + middle, focal * margin_m[:, None, None] / depth
        is_inside = np.all((pixel > -margin) & (pixel < size + margin), axis=-1) & (in_cam[..., 2] > 0)
        return np.asarray(np.mean((is_alike | from_anywhere) & is_inside, axis=1))


def _some_points(model: pycolmap.Reconstruction, image: pycolmap.Image) -> Array:
    ids = ids_seen_in(image)
    chosen = ids[np.linspace(0, len(ids) - 1, _NUM_POINTS).round().astype(np.int64)]
    return np.array([model.point3D(point_id).xyz for point_id in chosen.tolist()])


def best_apart(
    others: Indices, worth: Array, image_ids: Indices, known: Mapping[int, Set[int]], max_num: int
) -> list[int]:
    """Return the photos of largest worth, at most ``max_num`` and none that knows a better one of them."""
    chosen: list[int] = []
    told: set[int] = set()
    for k in np.argsort(-worth, kind="stable").tolist():
        id_ = int(image_ids[others[k]])
        if worth[k] <= 0 or len(chosen) == max_num:
            break
        if id_ not in told:
            chosen.append(int(others[k]))
            told |= {id_, *known.get(id_, ())}
    return chosen

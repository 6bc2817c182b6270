"""How far each range should have been, by the reference's camera positions."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from rangesfm.arrays import Array
from rangesfm.geometry.trajectory import Trajectory
from rangesfm.result.ranges_as_used import RangesAsUsed

MAX_KEYFRAME_SHARE = 0.1
"""A range counts as taken at a photo if it is no farther from it, in parts of the way to the next."""


def true_ranges_m(
    ranges: RangesAsUsed,
    path: Trajectory,
    reference_by_photo: Mapping[str, Array],
    anchors_m: Mapping[str, Array],
    tags_in_cam_m: Array,
) -> Array:
    """(n,) distances from the tag at the reference's camera to the anchor, NaN where unknown.

    Only of ranges used and taken at a photo: what the camera did in between the reference may
    not say. The camera is turned as in ``path``, with each range's tag at ``tags_in_cam_m`` (n, 3) in its frame;
    anchors stand where the map has them.
    """
    index_of = {name: i for i, name in enumerate(path.image_names)}
    distances = np.full(len(ranges.status), np.nan)
    for row in np.flatnonzero(np.isfinite(ranges.weight) & ranges.is_used):
        weight = float(ranges.weight[row])
        name = (ranges.keyframe_before if weight < 0.5 else ranges.keyframe_after)[row]
        position, anchor = reference_by_photo.get(name), anchors_m.get(ranges.anchor_id[row])
        is_at_photo = min(weight, 1 - weight) <= MAX_KEYFRAME_SHARE and name in index_of
        if is_at_photo and position is not None and anchor is not None:
            tag = position + path.world_from_cam[index_of[name]] @ tags_in_cam_m[row]
            distances[row] = np.linalg.norm(tag - anchor)
    return distances

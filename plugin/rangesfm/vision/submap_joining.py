"""Overlapping submaps laid onto each other by the photos that they share, and put into one model."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Sequence

import numpy as np
import pycolmap

# Of a similarity: fewer centres leave a turn open.
_MIN_NUM_COMMON = 3


def join_submaps(parts: Sequence[pycolmap.Reconstruction], seed: int) -> list[pycolmap.Reconstruction]:
    """As few models as the common photos allow, each in the world of its first part.

    A photo that two parts have keeps the pose of the earlier one. Tracks of two parts that hold the same feature
    become one. The camera's parameters are the medians of the parts'. Nothing is adjusted.

    Args:
        parts: of one camera and one database, whose ids they have; changed.
        seed: of COLMAP's robust similarities.
    """
    pycolmap.set_random_seed(seed)
    return [_one_model([(parts[k], motion) for k, motion in sorted(group.items())]) for group in _groups(parts)]


def _groups(parts: Sequence[pycolmap.Reconstruction]) -> list[dict[int, pycolmap.Sim3d]]:
    """Which parts hang together; by their numbers the similarities into the world of each group's first."""
    groups: dict[int, dict[int, pycolmap.Sim3d]] = {}  # of each part that which it is in
    holders: dict[int, list[int]] = defaultdict(list)  # of each photo the parts that have it
    for k, part in enumerate(parts):
        groups[k] = {k: pycolmap.Sim3d()}
        photos = part.reg_image_ids()
        shared = Counter(j for photo in photos for j in holders[photo])
        for j, num in sorted(shared.items(), key=lambda item: (-item[1], item[0])):
            if num < _MIN_NUM_COMMON or groups[j] is groups[k]:
                continue
            j_from_k = pycolmap.align_reconstructions_via_reprojections(part, parts[j])
            if j_from_k is not None:
                _unite(groups, j, k, j_from_k)
        for photo in photos:
            holders[photo].append(k)
    return list({id(group): group for group in groups.values()}.values())


def _unite(groups: dict[int, dict[int, pycolmap.Sim3d]], j: int, k: int, j_from_k: pycolmap.Sim3d) -> None:
    """Put the group of part ``k`` into that of part ``j``."""
    into, moved = groups[j], groups[k]
    into_from_moved = into[j] * j_from_k * moved[k].inverse()
    for member, moved_from_part in moved.items():
        into[member] = into_from_moved * moved_from_part
        groups[member] = into


def _one_model(parts: Sequence[tuple[pycolmap.Reconstruction, pycolmap.Sim3d]]) -> pycolmap.Reconstruction:
    """All parts, each with the similarity into the world of the model."""
    (joined, world_from_first), *others = parts
    joined.transform(world_from_first)
    for camera_id, camera in joined.cameras.items():
        camera.params = np.median([part.cameras[camera_id].params for part, _ in parts], axis=0)
    for part, world_from_part in others:
        part.transform(world_from_part)
        _add(joined, part)
    return joined


def _add(joined: pycolmap.Reconstruction, part: pycolmap.Reconstruction) -> None:
    for image_id in sorted(set(part.reg_image_ids()) - set(joined.reg_image_ids())):
        image = part.image(image_id)
        pixels = np.array([point.xy for point in image.points2D], dtype=np.float64).reshape(-1, 2)
        copy = pycolmap.Image(name=image.name, keypoints=pixels, camera_id=image.camera_id, image_id=image_id)
        joined.add_image_with_trivial_frame(copy, image.cam_from_world())
    for _, point in sorted(part.points3D.items()):
        elements = [(element.image_id, element.point2D_idx) for element in point.track.elements]
        seen = [joined.image(image_id).points2D[index] for image_id, index in elements]
        known = {feature.point3D_id for feature in seen if feature.has_point3D()}
        new = [
            pycolmap.TrackElement(*element)
            for element, feature in zip(elements, seen, strict=True)
            if not feature.has_point3D()
        ]
        if not known:
            joined.add_point3D(point.xyz, pycolmap.Track(new))
        elif len(known) == 1:  # two points that are one are for the refinement to merge
            (point_id,) = known
            for element in new:
                joined.add_observation(point_id, element)

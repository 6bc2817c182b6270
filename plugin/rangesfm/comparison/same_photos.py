"""Models of the same photos side by side: their common photos, lengths between these, and reprojection errors."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pycolmap

from rangesfm.arrays import Array
from rangesfm.util.geometry.similarity import rmse
from rangesfm.util.geometry.trajectory import Trajectory

Length = tuple[str, str, tuple[float, ...]]
"""A distance between two photos: their names, and the length in each model, in the unit of that model."""


def common_photos(first: Trajectory, second: Trajectory) -> tuple[tuple[str, ...], Array, Array]:
    """Return the names of the n photos in both paths, and their camera centres (n, 3) in each path."""
    index = {name: i for i, name in enumerate(second.image_names)}
    rows = [(i, index[name]) for i, name in enumerate(first.image_names) if name in index]
    ours, theirs = np.array(rows, dtype=np.int64).reshape(-1, 2).T
    return tuple(first.image_names[i] for i in ours), first.centers[ours], second.centers[theirs]


def lengths_along(paths: Sequence[Trajectory]) -> tuple[Length, ...]:
    """Return distances between photos that all paths have: over the whole path, its halves and some of its quarters."""
    places = [dict(zip(path.image_names, path.centers)) for path in paths]
    names = [name for name in paths[0].image_names if all(name in place for place in places)]
    quarters = [(len(names) - 1) * share // 4 for share in range(5)]
    pairs = [(quarters[i], quarters[j]) for i, j in ((0, 4), (0, 2), (2, 4), (1, 3), (0, 1), (3, 4))]
    distinct = dict.fromkeys((names[a], names[b]) for a, b in pairs if a != b)
    return tuple((a, b, tuple(float(np.linalg.norm(place[a] - place[b])) for place in places)) for a, b in distinct)


def reprojection_rms_px(reconstruction: pycolmap.Reconstruction) -> float:
    """Return the root mean square distance between observed and projected points in pixels; NaN without points."""
    errors = [np.zeros((0, 2))]
    for image in reconstruction.images.values():
        observed = list(image.get_observation_points2D()) if image.has_pose else []
        if observed:
            in_world = np.array([reconstruction.point3D(point.point3D_id).xyz for point in observed])
            projected = image.camera.img_from_cam(image.cam_from_world() * in_world, check_cheirality=False)
            errors.append(projected - np.array([point.xy for point in observed]))
    return rmse(np.concatenate(errors))

"""The matches of a simulated model as COLMAP's database, from which a mapper begins."""

from __future__ import annotations

from collections import defaultdict
from itertools import combinations
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pycolmap

from rangesfm.sfm.database import create_database

Array = npt.NDArray[np.float64]


def write_database(path: Path, model: pycolmap.Reconstruction, pixel_errors: Array) -> None:
    """Write the features of all photos, and matches wherever two photos see the same point.

    Args:
        pixel_errors: (num_observations, 2), added to the features in the order of the images' ids.
    """
    image_ids = sorted(model.reg_image_ids())
    (camera,) = model.cameras.values()
    names = [model.image(image_id).name for image_id in image_ids]
    create_database(path, names, [pycolmap.Camera(camera.todict())], [0] * len(names))
    ends = np.cumsum([len(model.image(image_id).points2D) for image_id in image_ids])
    matches = _matches(model)
    with pycolmap.Database.open(path) as database, pycolmap.DatabaseTransaction(database):
        for image_id, end in zip(image_ids, ends, strict=True):
            exact = np.array([point.xy for point in model.image(image_id).points2D])
            database.write_keypoints(image_id, (exact + pixel_errors[end - len(exact) : end]).astype(np.float32))
        for (first, second), pairs in matches.items():
            database.write_matches(first, second, pairs)
            geometry = pycolmap.TwoViewGeometry()
            geometry.config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
            geometry.inlier_matches = pairs
            database.write_two_view_geometry(first, second, geometry)


def _matches(model: pycolmap.Reconstruction) -> dict[tuple[int, int], npt.NDArray[np.uint32]]:
    """Return (m, 2) feature indices of the same points in two images, by the images' ids."""
    pairs: dict[tuple[int, int], list[tuple[int, int]]] = defaultdict(list)
    for _, point in sorted(model.points3D.items()):
        seen = sorted((element.image_id, element.point2D_idx) for element in point.track.elements)
        for (first, place), (second, other) in combinations(seen, 2):
            pairs[first, second].append((place, other))
    return {images: np.array(places, dtype=np.uint32) for images, places in pairs.items()}

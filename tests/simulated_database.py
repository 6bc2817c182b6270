"""COLMAP's database of a simulated survey: features and matches without photos, for what comes after matching."""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path

import numpy as np
import pycolmap

from rangesfm.options import CameraOptions
from rangesfm.vision.database import create_database
from rangesfm.vision.matched_photos import MatchedPhotos
from rangesfm.vision.photos import Photos


def write_database(path: Path, truth: pycolmap.Reconstruction) -> None:
    """The features of a model of one camera, and as matches what its tracks say."""
    names = [image.name for _, image in sorted(truth.images.items())]
    camera = pycolmap.Camera(next(iter(truth.cameras.values())).todict())
    camera.has_prior_focal_length = True
    create_database(path, names, camera)
    matches: dict[tuple[int, int], list[tuple[int, int]]] = defaultdict(list)
    for point in truth.points3D.values():
        seen = sorted((element.image_id, element.point2D_idx) for element in point.track.elements)
        for i, (first, at_first) in enumerate(seen):
            for second, at_second in seen[i + 1 :]:
                matches[first, second].append((at_first, at_second))
    with pycolmap.Database.open(path) as database, pycolmap.DatabaseTransaction(database):
        for image_id, image in truth.images.items():
            database.write_keypoints(image_id, np.array([point.xy for point in image.points2D], dtype=np.float32))
        for (first, second), pairs in sorted(matches.items()):
            found = np.array(pairs, dtype=np.uint32)
            database.write_matches(first, second, found)
            geometry = pycolmap.TwoViewGeometry(
                config=pycolmap.TwoViewGeometryConfiguration.CALIBRATED, inlier_matches=found
            )
            database.write_two_view_geometry(first, second, geometry)


def matched_photos(database_path: Path) -> MatchedPhotos:
    """The photos of such a database, as if they had been read; each is known by its name."""
    with pycolmap.Database.open(database_path) as database:
        names = tuple(image.name for image in sorted(database.read_all_images(), key=lambda image: image.image_id))
        camera = database.read_all_cameras()[0]
    photos = Photos(database_path.parent, names, camera.width, camera.height, {})
    return MatchedPhotos(photos, dict(zip(names, names, strict=True)), "", "", only_by_place=True)


def camera_options(database_path: Path) -> CameraOptions:
    """Its camera, as known."""
    with pycolmap.Database.open(database_path) as database:
        camera = database.read_all_cameras()[0]
    return CameraOptions(model=camera.model_name, params=tuple(camera.params.tolist()))

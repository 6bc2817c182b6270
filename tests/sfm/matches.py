"""The content of a database of features and matches, for comparison."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pycolmap


def content_of(database_path: Path) -> dict[Any, list[bytes]]:
    """Return features and matches by the ids of photos and pairs of photos."""
    with pycolmap.Database.open(database_path) as database:
        found: dict[Any, list[bytes]] = {}
        for image in database.read_all_images():
            descriptors = database.read_descriptors(image.image_id)
            found[image.name, image.image_id] = [
                database.read_keypoints(image.image_id).tobytes(),
                descriptors.data.tobytes(),
            ]
        for pair_id, geometry in zip(*database.read_two_view_geometries(), strict=True):
            pair = pycolmap.pair_id_to_image_pair(pair_id)
            found[pair] = [
                database.read_matches(*pair).tobytes(),
                geometry.inlier_matches.tobytes(),
                str((geometry.config, geometry.E, geometry.F, geometry.H, geometry.cam2_from_cam1)).encode(),
            ]
    return found

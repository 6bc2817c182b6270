"""Models that COLMAP makes up."""

from __future__ import annotations

from typing import Any

import pycolmap

from rangesfm.arrays import Array


def synthesized(num_photos: int, num_points: int, seed: int, **others: Any) -> pycolmap.Reconstruction:
    """Photos of one camera, or of ``num_rigs``; the other options too are those of COLMAP."""
    pycolmap.set_random_seed(seed)
    options = pycolmap.SyntheticDatasetOptions()
    given = {"num_rigs": 1, "num_frames_per_rig": num_photos, "num_points3D": num_points, **others}
    for name, value in given.items():
        setattr(options, name, value)
    return pycolmap.synthesize_dataset(options)


def centers_of(model: pycolmap.Reconstruction) -> dict[str, Array]:
    return {image.name: image.projection_center() for image in model.images.values()}

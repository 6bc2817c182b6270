"""Synthetic models made by COLMAP, and readers for exports of them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pycolmap

from rangesfm.arrays import Array

PLY_CODES = {"double": "<f8", "float": "<f4", "uchar": "u1"}


def synthesized(num_photos: int, num_points: int, seed: int, **others: Any) -> pycolmap.Reconstruction:
    """Synthesize a model with photos of one camera, or of ``num_rigs``; other options are passed to COLMAP."""
    pycolmap.set_random_seed(seed)
    options = pycolmap.SyntheticDatasetOptions()
    given = {"num_rigs": 1, "num_frames_per_rig": num_photos, "num_points3D": num_points, **others}
    for name, value in given.items():
        setattr(options, name, value)
    return pycolmap.synthesize_dataset(options)


def centers_of(model: pycolmap.Reconstruction) -> dict[str, Array]:
    return {image.name: image.projection_center() for image in model.images.values()}


def read_ply(path: Path) -> npt.NDArray[np.void]:
    """Read the vertices of a binary PLY file as its header describes them."""
    head, _, body = path.read_bytes().partition(b"end_header\n")
    lines = [line.split() for line in head.decode("ascii").splitlines()]
    assert lines[:2] == [["ply"], ["format", "binary_little_endian", "1.0"]]
    columns = [
        (name, PLY_CODES[code])
        for keyword, code, name in (line[:3] for line in lines if len(line) == 3)
        if keyword == "property"
    ]
    (num,) = (int(line[2]) for line in lines if line[:2] == ["element", "vertex"])
    vertices = np.frombuffer(body, dtype=columns)
    assert len(vertices) == num
    return vertices


def xyz(vertices: npt.NDArray[np.void]) -> Array:
    return np.column_stack([vertices[axis] for axis in "xyz"])

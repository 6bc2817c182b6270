"""A room with printed tags on its walls: photos, and a model of them as from COLMAP."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from PIL import Image
from tests.rendering.photos import PhotoCamera, develop, render
from tests.rendering.scene import Rectangle, Scene, Sky, Surface, Texture
from tests.simulated.model import SyntheticModel, synthetic_model
from tests.simulated.path import look_at

DICTIONARY, SIDE_M = "APRILTAG_36h11", 0.36
NUM_TAGS, NUM_PHOTOS = 3, 8
_SIZE_PX, _FOCAL_PX = (400, 300), 330.0
# Modules of a tag of this family with its black rim, and modules of white paper around it.
_MODULES, _RIM = 8, 2
_TEXELS = 16


def tagged_room(folder: Path, *, with_tags: bool = True) -> SyntheticModel:
    """Write the photos to ``folder``, and a model of them to ``folder.parent / "sparse"``."""
    angles = np.linspace(-0.5, 0.5, NUM_PHOTOS)
    centers_m = np.column_stack([3.2 * np.sin(angles), -2.6 * np.cos(angles), 1.2 + 0.3 * np.cos(5 * angles)])
    rotations = look_at(centers_m, np.tile([0.0, 0.4, 1.1], (NUM_PHOTOS, 1)), 4 * np.sin(9 * angles))
    made = synthetic_model(
        np.arange(NUM_PHOTOS, dtype=np.float64),
        centers_m,
        rotations,
        num_observations=60,
        depth_range_m=(1.5, 5.0),
        pixel_stddev=0.3,
        image_size=_SIZE_PX,
        focal_px=_FOCAL_PX,
        seed=3,
    )
    plaster = np.random.default_rng(5).uniform(0.05, 0.45, (1, 512, 512)).astype(np.float32)
    wall = Surface(_upright(0.0, 0.01, 1.2, 7.0), Texture(np.repeat(plaster, 3, axis=0)))
    tags = [_tag(k, x_m, z_m) for k, (x_m, z_m) in enumerate([(-0.9, 1.5), (0.1, 0.8), (0.8, 1.5)])]
    scene = Scene([wall, *(tags if with_tags else [])], Sky(np.zeros((4, 4), dtype=np.float32)))
    camera = PhotoCamera(*_SIZE_PX, _FOCAL_PX)
    folder.mkdir(parents=True)
    for name, center, rotation in zip(made.timestamps_s, centers_m, rotations, strict=True):
        radiance = render(scene, camera, np.column_stack([rotation.T, -rotation.T @ center]))
        Image.fromarray(develop(radiance, 1.0, np.random.default_rng(len(name)))).save(folder / name, quality=92)
    sparse = folder.parent / "sparse"
    sparse.mkdir(exist_ok=True)
    made.reconstruction.write(sparse)
    return made


def _upright(x_m: float, y_m: float, z_m: float, size_m: float) -> Rectangle:
    """A square with its middle at this point, facing south."""
    corner = np.array([x_m - size_m / 2, y_m, z_m + size_m / 2])
    return Rectangle(corner, np.array([size_m, 0, 0]), np.array([0, 0, -size_m]))


def _tag(number: int, x_m: float, z_m: float) -> Surface:
    known = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{DICTIONARY}"))
    picture = np.asarray(cv2.aruco.generateImageMarker(known, number, _TEXELS * _MODULES))
    paper = np.pad(picture, _TEXELS * _RIM, constant_values=255)
    radiance = np.broadcast_to((0.02 + 0.6 * paper / 255).astype(np.float32), (3, *paper.shape)).copy()
    size_m = SIDE_M * (_MODULES + 2 * _RIM) / _MODULES
    return Surface(_upright(x_m, 0.0, z_m, size_m), Texture(radiance))

"""A wall with printed tags: photos, and a model of them as from COLMAP."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
from PIL import Image
from tests.simulated.model import SyntheticModel, synthetic_model
from tests.simulated.path import look_at

DICTIONARY, SIDE_M = "APRILTAG_36h11", 0.36
NUM_TAGS, NUM_PHOTOS = 3, 8
_SIZE_PX, _FOCAL_PX = (400, 300), 330.0
# Modules of a tag of this family with its black rim, and modules of white paper around it.
_MODULES, _RIM = 8, 2
_TEXELS = 9  # of the wall's picture in a module: somewhat more than photos show
_TEXEL_M = SIDE_M / (_MODULES * _TEXELS)
_WALL_M, _SPOT_M = 7.0, 0.014
_CORNER_M = np.array([-3.5, 0.0, 4.7])  # upper left one of the wall, which is upright and seen from the south
_NOISE = 2.0  # of a pixel, white is 255


def tagged_room(folder: Path) -> SyntheticModel:
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
    rng = np.random.default_rng(5)
    num_spots, num_texels = round(_WALL_M / _SPOT_M), round(_WALL_M / _TEXEL_M)
    spots = rng.uniform(30, 190, (num_spots, num_spots)).astype(np.float32)
    wall = np.asarray(cv2.resize(spots, (num_texels, num_texels), interpolation=cv2.INTER_LINEAR), dtype=np.float32)
    for number, (x_m, z_m) in enumerate([(-0.9, 1.5), (0.1, 0.8), (0.8, 1.5)]):
        tag = _tag(number)
        column, row = (np.array([x_m - _CORNER_M[0], _CORNER_M[2] - z_m]) / _TEXEL_M).round().astype(int) - len(
            tag
        ) // 2
        wall[row : row + len(tag), column : column + len(tag)] = tag
    folder.mkdir(parents=True)
    for name, center, rotation in zip(made.timestamps_s, centers_m, rotations, strict=True):
        seen = _photo(wall, center, rotation) + _NOISE * rng.standard_normal(_SIZE_PX[::-1])
        Image.fromarray(np.clip(seen, 0, 255).astype(np.uint8)).save(folder / name, quality=92)
    sparse = folder.parent / "sparse"
    sparse.mkdir(exist_ok=True)
    made.reconstruction.write(sparse)
    return made


def _tag(number: int) -> npt.NDArray[np.uint8]:
    known = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{DICTIONARY}"))
    picture = np.asarray(cv2.aruco.generateImageMarker(known, number, _TEXELS * _MODULES), dtype=np.uint8)
    return np.pad(picture, _TEXELS * _RIM, constant_values=255)


def _photo(
    wall: npt.NDArray[np.float32], center_m: npt.NDArray[np.float64], world_from_cam: npt.NDArray[np.float64]
) -> npt.NDArray[np.float32]:
    """Return what a pinhole camera sees of the plane of the wall: a homography."""
    right, up = _TEXEL_M * np.eye(3)[0], _TEXEL_M * np.eye(3)[2]
    width, height = _SIZE_PX
    calibration = np.array([(_FOCAL_PX, 0, width / 2), (0, _FOCAL_PX, height / 2), (0, 0, 1)])
    pixel_from_texel = calibration @ world_from_cam.T @ np.column_stack([right, -up, _CORNER_M - center_m])
    # OpenCV counts from the middle of the first pixel, COLMAP from its corner.
    half = np.array([(1, 0, 0.5), (0, 1, 0.5), (0, 0, 1)])
    finer = np.diag([2.0, 2.0, 1.0])
    seen = cv2.warpPerspective(wall, np.linalg.inv(half) @ finer @ pixel_from_texel @ half, (2 * width, 2 * height))
    return np.asarray(cv2.resize(seen, _SIZE_PX, interpolation=cv2.INTER_AREA), dtype=np.float32)

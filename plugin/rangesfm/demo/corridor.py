"""A survey with drift: a walk along a corridor around a block, whose photos are rendered when the survey is made.

The path comes back to its start after 40 m, past four corners, and no photo sees around two of them. So photos that are
matched with their neighbours in time make a map that drifts, ranges to one anchor bend it back, and loops close it.

World: metres, x and y along the walls, z up, with the origin in a corner of the floor.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path

import numpy as np
import pycolmap
from scipy import ndimage
from scipy.spatial.transform import Rotation

from rangesfm.arrays import Array, Indices
from rangesfm.demo.simulated_radio import CameraPath, simulate_ranges
from rangesfm.demo.survey import RADIO, TAG_IN_CAM_M, DemoSurvey, simulate_phone, write_demo
from rangesfm.util.geometry.moments import ByPhoto
from rangesfm.util.geometry.reference import Reference

NUM_PHOTOS = 96
SIZE_PX, FOCAL_PX = (360, 240), 230.0

# The corridor lies between these two boxes, from lower to upper corner; the block stands for all that it goes around.
_WIDTH_M = 2.2
_HALL_M = np.array([(0.0, 0.0, 0.0), (15.0, 10.0, 2.6)])
_BLOCK_M = np.array([(_WIDTH_M, _WIDTH_M, -1.0), (15.0 - _WIDTH_M, 10.0 - _WIDTH_M, 3.6)])
_ANCHOR_M = np.array([4.0, 4.0, 2.0])  # in the block; UWB goes through its walls
_STEP_M, _CORNER_M = 0.5, 2.4
_NUM_AROUND = 3  # steps of a second before the first and after the last photo, in which the radio is on
_START_S = 1778768427.0  # seconds since 1970

_TEXEL_M = 0.01
_SPOTS = ((64, 0.10), (24, 0.12), (9, 0.14), (4, 0.10))  # sizes in texels and contrasts of the spots on the walls
_NOISE = 0.02  # of a pixel, white is 1
_RADIO = replace(RADIO, range_bias_m={"A1": 0.05})


def make_corridor_survey(folder: Path, *, num_photos: int = NUM_PHOTOS, seed: int = 0, imu: bool = False) -> DemoSurvey:
    """Write the survey into a folder; a folder that already holds the same survey is left as it is.

    Args:
        folder: a new or empty folder.
        num_photos: number of photos, from the first on. They are one second apart, and from the 80th on they show what
            the first ones show.
        seed: seed of the errors of the radio and of the inertial sensor.
        imu: whether the camera has an inertial sensor.

    Raises:
        InputError: the folder holds something else or cannot be written to.
    """
    centers, world_from_cam = _walk(num_photos + 2 * _NUM_AROUND)
    times = np.arange(len(centers), dtype=np.float64) + _START_S
    ranges = simulate_ranges(
        CameraPath.through(times, centers, world_from_cam), {"A1": _ANCHOR_M}, TAG_IN_CAM_M, _RADIO, seed
    )
    taken = slice(_NUM_AROUND, -_NUM_AROUND)
    survey = DemoSurvey(
        folder=folder,
        image_names=tuple(f"IMG_{k:04d}.png" for k in range(1, num_photos + 1)),
        timestamps_s=times[taken],
        centers_m=centers[taken],
        world_from_cam=world_from_cam[taken],
        ranges=ranges,
        imu=simulate_phone(times, centers, world_from_cam, seed) if imu else None,
    )
    x, y, z = (_ANCHOR_M - survey.centers_m[0]) @ survey.world_from_cam[0]
    rows = (f"{name},{time_s:.3f}" for name, time_s in zip(survey.image_names, survey.timestamps_s, strict=True))
    files = {
        "images.csv": "\n".join(["image_name,timestamp_s", *rows]) + "\n",
        "anchors.csv": f"anchor_id,x_m,y_m,z_m\nA1,{x:.3f},{y:.3f},{z:.3f}\n",
    }
    reference = Reference(survey.centers_m, ByPhoto(survey.image_names), survey.world_from_cam)
    write_demo(survey, reference, _survey_file(num_photos, seed), files, partial(_take_photo, survey))
    return survey


def _walk(num: int) -> tuple[Array, Array]:
    """Return the (num, 3) centres and (num, 3, 3) rotations world_from_cam of a walk that looks ahead and sways."""
    low, high = _HALL_M[0, :2] + _WIDTH_M / 2, _HALL_M[1, :2] - _WIDTH_M / 2
    corners = np.array([low, (high[0], low[1]), high, (low[0], high[1]), low])
    lengths = np.cumsum([0.0, *np.linalg.norm(np.diff(corners, axis=0), axis=1)])
    along = np.arange(0.0, lengths[-1], 0.05)
    ring = np.column_stack([np.interp(along, lengths, corners[:, axis]) for axis in (0, 1)])
    ring = ndimage.uniform_filter1d(ring, round(_CORNER_M / 0.05), axis=0, mode="wrap")  # cuts the corners
    at = 2.0 + _STEP_M * np.arange(num)
    here, ahead = (
        np.column_stack([np.interp(place, along, ring[:, axis], period=lengths[-1]) for axis in (0, 1)])
        for place in (at, at + 1.0)
    )
    k = np.arange(num)
    heading = np.unwrap(np.arctan2(*(ahead - here).T[::-1]))
    aside = 0.15 * np.sin(0.9 * k)
    height = 1.5 + 0.12 * np.sin(0.7 * k) + 0.05 * np.sin(2.1 * k)
    centers = np.column_stack([here[:, 0] - aside * np.sin(heading), here[:, 1] + aside * np.cos(heading), height])
    ahead_of_world = np.array([(0.0, 0.0, 1.0), (-1.0, 0.0, 0.0), (0.0, -1.0, 0.0)])  # the camera looks along x
    turns = np.column_stack([heading + 0.12 * np.sin(0.5 * k), 0.06 * np.sin(0.8 * k), 0.04 * np.sin(1.1 * k)])
    return centers, Rotation.from_euler("ZYX", turns).as_matrix() @ ahead_of_world


@dataclass(frozen=True)
class _Box:
    """A box with spots on its six sides.

    Attributes:
        corners_m: (2, 3) lower and upper corner.
        sides: pictures of each side, by the number of its axis and whether it is the upper one: the first with texels
            of ``_TEXEL_M``, each further one with texels twice as large.
    """

    corners_m: Array
    sides: dict[tuple[int, int], list[Array]]

    @classmethod
    def textured(cls, corners_m: Array, rng: np.random.Generator) -> _Box:
        size = np.ceil(np.diff(corners_m, axis=0)[0] / _TEXEL_M).astype(np.int64)
        sides = {
            (axis, side): list(_halved(_spots(tuple(np.delete(size, axis)), rng)))
            for axis in range(3)
            for side in (0, 1)
        }
        return cls(corners_m, sides)

    def crossings(self, center: Array, rays: Array) -> Array:
        """Return the (2, n, 3) multiples of n rays at which they enter and leave the box's slabs."""
        with np.errstate(divide="ignore"):
            return np.sort((self.corners_m[:, None] - center) / rays, axis=0)

    def brightness(self, center: Array, rays: Array, depth: Array, axis: Indices, side: Indices) -> Array:
        """Return the (n,) brightness where n rays meet sides of the box, at multiples ``depth`` of them."""
        found = np.zeros(len(rays))
        for (of_axis, of_side), pictures in self.sides.items():
            rows = np.flatnonzero((axis == of_axis) & (side == of_side))
            place = np.delete(center + depth[rows, None] * rays[rows] - self.corners_m[0], of_axis, axis=1) / _TEXEL_M
            length = np.linalg.norm(rays[rows], axis=1)
            seen_from_side = np.abs(rays[rows, of_axis]) / length
            texels = depth[rows] * length / (FOCAL_PX * _TEXEL_M * np.sqrt(seen_from_side))
            level = np.clip(np.log2(np.maximum(texels, 1.0)).round(), 0, len(pictures) - 1)
            for number, picture in enumerate(pictures):
                chosen = level == number
                texel = (place[chosen].T + 0.5) / 2**number - 0.5
                found[rows[chosen]] = ndimage.map_coordinates(picture, texel, order=1, mode="nearest")
            found[rows] *= 0.8 + 0.1 * of_axis + 0.05 * of_side
        return found


def _spots(shape: tuple[int, ...], rng: np.random.Generator) -> Array:
    picture = np.full(shape, 0.5)
    for texels, contrast in _SPOTS:
        coarse = rng.standard_normal([num // texels + 3 for num in shape])
        picture += contrast * ndimage.zoom(coarse, texels, order=1)[: shape[0], : shape[1]]
    return np.asarray(np.clip(picture, 0.0, 1.0))


def _halved(picture: Array) -> Iterator[Array]:
    """Yield a picture, and again and again the means of 2 by 2 of its texels."""
    while min(picture.shape) > 8:
        yield picture
        rows, columns = (num // 2 for num in picture.shape)
        picture = picture[: 2 * rows, : 2 * columns].reshape(rows, 2, columns, 2).mean(axis=(1, 3))


@cache
def _boxes() -> tuple[_Box, _Box]:
    rng = np.random.default_rng(0)
    return _Box.textured(_HALL_M, rng), _Box.textured(_BLOCK_M, rng)


def render(center: Array, world_from_cam: Array) -> Array:
    """Return the brightness (height, width) that a camera in the corridor sees, black is 0 and white is 1."""
    width, height = SIZE_PX
    row, column = np.mgrid[:height, :width] + 0.5
    in_cam = np.stack(
        [(column - width / 2) / FOCAL_PX, (row - height / 2) / FOCAL_PX, np.ones((height, width))], axis=-1
    )
    rays = in_cam.reshape(-1, 3) @ world_from_cam.T
    hall, block = _boxes()
    leaves = hall.crossings(center, rays)[1]  # the camera is in the hall, and each ray ends at a wall of it ...
    axis = leaves.argmin(axis=1)
    upper = np.take_along_axis(rays, axis[:, None], axis=1)[:, 0] > 0
    seen = hall.brightness(center, rays, leaves.min(axis=1), axis, upper.astype(np.int64))
    enters, ends = block.crossings(center, rays)  # ... unless it meets the block before
    meets = enters.max(axis=1)
    rows = np.flatnonzero((meets > 0) & (meets < np.minimum(ends.min(axis=1), leaves.min(axis=1))))
    axis = enters[rows].argmax(axis=1)
    upper = np.take_along_axis(rays[rows], axis[:, None], axis=1)[:, 0] < 0
    seen[rows] = block.brightness(center, rays[rows], meets[rows], axis, upper.astype(np.int64))
    return seen.reshape(height, width)


def _take_photo(survey: DemoSurvey, number: int, path: Path) -> None:
    seen = render(survey.centers_m[number], survey.world_from_cam[number])
    seen = seen + _NOISE * np.random.default_rng([number, 1]).standard_normal(seen.shape)
    pycolmap.Bitmap.from_array((255 * np.clip(seen, 0.0, 1.0)).astype(np.uint8)).write(path)


def _survey_file(num_photos: int, seed: int) -> str:
    x, y, z = TAG_IN_CAM_M
    return f"""\
# A survey of a simulated corridor: {num_photos} photos, a radio with seed {seed}.
# Paths are relative to this file.

[images]
path = "images"
times = "images.csv"            # image_name,timestamp_s

[camera]
model = "PINHOLE"               # fx, fy, cx, cy
params = [{FOCAL_PX:g}, {FOCAL_PX:g}, {SIZE_PX[0] / 2:g}, {SIZE_PX[1] / 2:g}]

[mapper]
matching = "sequential"         # with neighbours in time; the refined map finds the loops

[mapper.pairing]
overlap = 3
quadratic_overlap = false

[mapper.features.sift]
max_num_features = 1000

[ranges]
path = "uwb.csv"                # timestamp_s,anchor_id,range_m
time_offset = "auto"            # radio and camera have different clocks: image time = range time + offset

[anchors]
path = "anchors.csv"            # one anchor, measured from where the first photo was taken
frame = "first_camera"

[tag]
tag_in_cam_m = [{x:g}, {y:g}, {z:g}]   # lever arm of the antenna: x right, y down, z forward

[report]
reference = "reference.csv"     # the true poses, used for comparison only

[output]
path = "out"
"""

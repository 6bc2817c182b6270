"""Lit, textured rectangles under a sky, which the simulated camera looks at."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
from tests.rendering.canvas import FloatArray

# Radiance that a texture's byte 255 stands for; bytes hold its square root, which is finer in the dark, like the eye.
_MAX_RADIANCE = 2.0
_NUM_MIP_LEVELS = 5


@dataclass(frozen=True)
class Rectangle:
    """A parallelogram seen from its front, as a picture is: u runs right and v runs down.

    Attributes:
        corner_m: (3,) its upper left corner in the world.
        edge_u_m, edge_v_m: (3,) from there to its upper right and its lower left corner.
    """

    corner_m: npt.NDArray[np.float64]
    edge_u_m: npt.NDArray[np.float64]
    edge_v_m: npt.NDArray[np.float64]

    @property
    def width_m(self) -> float:
        return float(np.linalg.norm(self.edge_u_m))

    @property
    def height_m(self) -> float:
        return float(np.linalg.norm(self.edge_v_m))

    @cached_property
    def normal(self) -> npt.NDArray[np.float64]:
        """(3,) unit vector towards the viewer."""
        normal = np.cross(self.edge_v_m, self.edge_u_m)
        return np.asarray(normal / np.linalg.norm(normal))

    @property
    def corners_m(self) -> npt.NDArray[np.float64]:
        """(4, 3) around the rectangle."""
        u, v = self.edge_u_m, self.edge_v_m
        return np.asarray(self.corner_m + np.array([0 * u, u, u + v, v]))

    def point(self, u: float, v: float) -> npt.NDArray[np.float64]:
        """(3,) the point at ``u``, ``v`` in [0, 1] across and down."""
        return self.corner_m + u * self.edge_u_m + v * self.edge_v_m


class Texture:
    """Radiance on a rectangle at several resolutions, each half of the one before."""

    def __init__(self, radiance: FloatArray):
        """Take (3, h, w) linear radiance, row 0 the upper edge, texels filling the rectangle."""
        levels = [radiance]
        while len(levels) < _NUM_MIP_LEVELS and levels[-1].shape[1] % 2 == 0 and levels[-1].shape[2] % 2 == 0:
            fine = levels[-1]
            levels.append(_halved(fine))
        self._heights = np.array([level.shape[1] for level in levels])
        self._widths = np.array([level.shape[2] for level in levels])
        self._starts = np.concatenate([[0], np.cumsum(self._heights * self._widths)])
        self._texels = np.concatenate([_encode(level) for level in levels])

    @property
    def num_texels(self) -> int:
        """Number of texels at the finest resolution."""
        return int(self._starts[1])

    def sample(self, u: FloatArray, v: FloatArray, level: npt.NDArray[np.int8]) -> FloatArray:
        """(n, 3) radiance at ``u``, ``v`` in [0, 1], interpolated on the resolution ``level``, 0 the finest."""
        level = np.clip(level, 0, len(self._widths) - 1)
        width, height = self._widths[level], self._heights[level]
        x = np.clip(u * width.astype(np.float32) - np.float32(0.5), 0, None)
        y = np.clip(v * height.astype(np.float32) - np.float32(0.5), 0, None)
        left, top = np.minimum(x.astype(np.intp), width - 1), np.minimum(y.astype(np.intp), height - 1)
        weight_x, weight_y = np.minimum(x - left, 1)[:, None], np.minimum(y - top, 1)[:, None]
        right = np.where(left < width - 1, 1, 0)
        below = np.where(top < height - 1, width, 0)
        index = self._starts[level] + top * width + left
        upper = _mix(self._texels.take(index), self._texels.take(index + right), weight_x)
        index += below
        lower = _mix(self._texels.take(index), self._texels.take(index + right), weight_x)
        root = upper + weight_y * (lower - upper)
        return np.asarray(root[:, :3] ** 2 * np.float32(_MAX_RADIANCE / 255**2))


class Sky:
    """Radiance of the sky behind everything: bright at the horizon, blue above, with clouds."""

    zenith = np.array([0.20, 0.36, 0.72], dtype=np.float32)
    horizon = np.array([0.66, 0.78, 0.94], dtype=np.float32)
    cloud = np.array([1.32, 1.29, 1.25], dtype=np.float32)

    def __init__(self, clouds: FloatArray):
        """Take a square field in [0, 1], 1 where the cloud is thick; it repeats, far away."""
        self._clouds = clouds

    def radiance(self, directions: FloatArray) -> FloatArray:
        """(n, 3) along (n, 3) world directions of any length."""
        unit = directions / np.linalg.norm(directions, axis=1, keepdims=True)
        up = np.maximum(unit[:, 2:], 0)
        clear = self.horizon + (1 - np.exp(-4 * up)) * (self.zenith - self.horizon)
        size = self._clouds.shape[0]
        # Clouds lie on a plane overhead; the added height keeps them from crowding at the horizon.
        position = unit[:, :2] / (up + np.float32(0.15)) * np.float32(0.07 * size) + np.float32(0.5 * size)
        low = np.floor(position).astype(np.intp)
        weight = (position - low).astype(np.float32)
        x0, y0 = (low % size).T
        x1, y1 = ((low + 1) % size).T
        upper = self._clouds[y0, x0] * (1 - weight[:, 0]) + self._clouds[y0, x1] * weight[:, 0]
        lower = self._clouds[y1, x0] * (1 - weight[:, 0]) + self._clouds[y1, x1] * weight[:, 0]
        thick = (upper + weight[:, 1] * (lower - upper))[:, None]
        return np.asarray(clear + thick * (self.cloud - clear), dtype=np.float32)


@dataclass(frozen=True)
class Surface:
    """A rectangle and the light that leaves it, the same in all directions."""

    rectangle: Rectangle
    texture: Texture


@dataclass(frozen=True)
class Scene:
    """Everything a photo can show."""

    surfaces: Sequence[Surface]
    sky: Sky


def _encode(radiance: FloatArray) -> npt.NDArray[np.uint32]:
    """(h * w,) four bytes per texel in one word, so that one look-up fetches a colour."""
    root = np.sqrt(np.clip(radiance, 0, _MAX_RADIANCE) * np.float32(255**2 / _MAX_RADIANCE)) + np.float32(0.5)
    texels = np.zeros((radiance.shape[1] * radiance.shape[2], 4), dtype=np.uint8)
    for channel in range(3):
        texels[:, channel] = root[channel].ravel()
    return texels.view(np.uint32)[:, 0]


def _halved(fine: FloatArray) -> FloatArray:
    """Means of two by two texels."""
    rows = fine[:, ::2] + fine[:, 1::2]
    return np.asarray(np.float32(0.25) * (rows[:, :, ::2] + rows[:, :, 1::2]))


def _mix(left: npt.NDArray[np.uint32], right: npt.NDArray[np.uint32], weight: FloatArray) -> FloatArray:
    left_bytes = left.view(np.uint8).reshape(-1, 4).astype(np.float32)
    right_bytes = right.view(np.uint8).reshape(-1, 4).astype(np.float32)
    right_bytes -= left_bytes
    right_bytes *= weight
    right_bytes += left_bytes
    return right_bytes

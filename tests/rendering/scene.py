"""Lit, textured rectangles under a sky, which the simulated camera looks at."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
from scipy.ndimage import map_coordinates
from tests.rendering.canvas import FloatArray

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
        self._levels = [radiance]
        while len(self._levels) < _NUM_MIP_LEVELS and not (np.array(self._levels[-1].shape[1:]) % 2).any():
            fine = self._levels[-1]
            self._levels.append(fine.reshape(3, fine.shape[1] // 2, 2, fine.shape[2] // 2, 2).mean(axis=(2, 4)))

    @property
    def num_texels(self) -> int:
        """Number of texels at the finest resolution."""
        return int(self._levels[0][0].size)

    def sample(self, u: FloatArray, v: FloatArray, level: npt.NDArray[np.int8]) -> FloatArray:
        """(n, 3) radiance at ``u``, ``v`` in [0, 1], interpolated on the resolution ``level``, 0 the finest."""
        found = np.empty((len(u), 3), dtype=np.float32)
        level = np.clip(level, 0, len(self._levels) - 1)
        for number, texels in enumerate(self._levels):
            chosen = level == number
            _, height, width = texels.shape
            at = np.stack([v[chosen] * height, u[chosen] * width]) - np.float32(0.5)
            found[chosen] = np.stack([map_coordinates(band, at, order=1, mode="nearest") for band in texels], axis=1)
        return found


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
        thick = map_coordinates(self._clouds, position.T[::-1], order=1, mode="grid-wrap")[:, None]
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

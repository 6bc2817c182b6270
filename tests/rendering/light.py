"""Light a scene once, for all photos: sun with shadows, visible sky, and light that the surroundings reflect."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from tests.rendering.canvas import Canvas, FloatArray, Material, resize_linear
from tests.rendering.scene import Rectangle, Surface, Texture

_SUN_GRID_M = 0.03
_SKY_GRID_M = 0.15
# Points of the sun's disc, as offsets of its direction.
_SUN_DISC = 0.006 * np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]])
_NUM_SKY_DIRECTIONS = 48
# Shadows in the light of the whole sky are soft: things smaller than this cast none worth computing.
_MIN_SKY_OCCLUDER_M2 = 0.25
# Occluders are processed together as long as their values on the grid fit into the processor's cache.
_MAX_VALUES_AT_ONCE = 30_000
# Surfaces closer than this are as dark as the corner that they share.
_NEAR_M = 0.5


@dataclass(frozen=True)
class Panel:
    """A rectangle of the scene before it is painted and lit."""

    rectangle: Rectangle
    paint: Callable[[Canvas], Material]


@dataclass(frozen=True)
class Light:
    """Sources of light, as the linear RGB radiance that leaves white paint.

    Attributes:
        sun_direction: (3,) towards the sun.
        sun, sky, surroundings: (3,) light of the full sun, of the open sky, of sunlit walls and ground around.
    """

    sun_direction: npt.NDArray[np.float64]
    sun: FloatArray
    sky: FloatArray
    surroundings: FloatArray

    @classmethod
    def afternoon(cls) -> Light:
        """Sun in the south-west, 46 degrees up."""
        direction = np.array([-0.50, -0.62, 0.82])
        return cls(
            direction / np.linalg.norm(direction),
            sun=np.array([1.75, 1.58, 1.32], dtype=np.float32),
            sky=np.array([0.46, 0.55, 0.70], dtype=np.float32),
            surroundings=np.array([0.27, 0.24, 0.20], dtype=np.float32),
        )


class Beam:
    """Parallel light from afar, and all rectangles that may stand in its way.

    For one direction and one rectangle, the distance along the ray to its plane and the place of the hit within it are
    affine in the point that the light is to reach.
    """

    def __init__(self, direction: npt.NDArray[np.float64], occluders: Sequence[Rectangle]):
        self.direction = direction / np.linalg.norm(direction)
        normal = np.array([r.normal for r in occluders])
        edges = np.array([np.stack([r.edge_u_m, r.edge_v_m, r.normal], axis=1) for r in occluders])
        across, down = np.linalg.inv(edges)[:, :2].transpose(1, 0, 2)
        slope = normal @ self.direction
        by_slope = normal / np.where(np.abs(slope) < 1e-9, 1e-9, slope)[:, None]
        self._corner = np.array([r.corner_m for r in occluders])
        self._functions = np.stack(
            [
                -by_slope,
                across - by_slope * (across @ self.direction)[:, None],
                down - by_slope * (down @ self.direction)[:, None],
            ],
            axis=1,
        )

    def hits(self, rectangle: Rectangle, shape: tuple[int, int]) -> tuple[npt.NDArray[np.bool_], npt.NDArray[np.bool_]]:
        """(h, w) whether something is in the way to each cell of ``rectangle``, and whether that is near."""
        at_corner = np.einsum("nij,nj->ni", self._functions, rectangle.corner_m - self._corner)
        along_u, along_v = self._functions @ rectangle.edge_u_m, self._functions @ rectangle.edge_v_m
        at_corners = np.stack([at_corner, at_corner + along_u, at_corner + along_v, at_corner + along_u + along_v])
        low, high = at_corners.min(axis=0), at_corners.max(axis=0)
        possible = (high[:, 0] > 1e-4) & (low[:, 1:] < 1).all(axis=1) & (high[:, 1:] > 0).all(axis=1)
        blocked, near = np.zeros(shape, dtype=np.bool_), np.zeros(shape, dtype=np.bool_)
        u = ((np.arange(shape[1], dtype=np.float32) + 0.5) / np.float32(shape[1]))[None, :]
        v = ((np.arange(shape[0], dtype=np.float32) + 0.5) / np.float32(shape[0]))[:, None]
        begin, step_u, step_v = (
            values[possible].astype(np.float32)[:, :, None, None] for values in (at_corner, along_u, along_v)
        )
        at_once = max(1, _MAX_VALUES_AT_ONCE // (shape[0] * shape[1]))
        for first in range(0, len(begin), at_once):
            some = slice(first, first + at_once)
            values = step_u[some] * u + step_v[some] * v
            values += begin[some]
            distance, across, down = values[:, 0], values[:, 1], values[:, 2]
            hit = (distance > 1e-4) & (across > 0) & (across < 1) & (down > 0) & (down < 1)
            blocked |= hit.any(axis=0)
            near |= (hit & (distance < _NEAR_M)).any(axis=0)
        return blocked, near


def light_panels(
    panels: Sequence[Panel], wanted: Sequence[int], light: Light, texel_m: Sequence[float]
) -> list[Surface]:
    """Paint and light some of the panels; all of them cast shadows.

    Args:
        panels: everything in the scene.
        wanted: indices of those to paint.
        light: where light comes from.
        texel_m: resolution of each panel's texture.
    """
    rectangles = [panel.rectangle for panel in panels]
    large = [rectangle for rectangle in rectangles if rectangle.width_m * rectangle.height_m > _MIN_SKY_OCCLUDER_M2]
    from_sun = [Beam(light.sun_direction + offset, rectangles) for offset in _SUN_DISC]
    from_sky = [Beam(direction, large) for direction in _directions(_NUM_SKY_DIRECTIONS)]
    seeds = np.random.SeedSequence(0).spawn(len(panels))

    def finish(index: int) -> Surface:
        rectangle = rectangles[index]
        canvas = Canvas.of_size(
            rectangle.width_m, rectangle.height_m, texel_m[index], np.random.default_rng(seeds[index])
        )
        material = panels[index].paint(canvas)
        ambient = _ambient_light(rectangle, canvas.shape, from_sky, light)
        sunny = _sun_share(rectangle, canvas.shape, from_sun) * _facing_sun(rectangle, canvas, material, light)
        radiance = np.clip(material.albedo, 0.01, 0.95)
        radiance *= ambient + sunny * light.sun[:, None, None]
        return Surface(rectangle, Texture(radiance))

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        return list(pool.map(finish, wanted))


def _facing_sun(rectangle: Rectangle, canvas: Canvas, material: Material, light: Light) -> FloatArray:
    """(h, w) cosine between the sun and the normal, which the relief tilts."""
    right, down = rectangle.edge_u_m / rectangle.width_m, rectangle.edge_v_m / rectangle.height_m
    sun = [np.float32(axis @ light.sun_direction) for axis in (right, down, rectangle.normal)]
    slope_right = np.diff(material.height_m, axis=1, append=material.height_m[:, -1:]) / np.float32(canvas.texel_m[1])
    slope_down = np.diff(material.height_m, axis=0, append=material.height_m[-1:]) / np.float32(canvas.texel_m[0])
    cosine = sun[2] - slope_right * sun[0] - slope_down * sun[1]
    cosine /= np.sqrt(1 + slope_right**2 + slope_down**2)
    return np.asarray(np.clip(cosine, 0, 1))


def _sun_share(rectangle: Rectangle, shape: tuple[int, int], sun: Sequence[Beam]) -> FloatArray:
    """(h, w) share of the sun's disc that each texel sees, in [0, 1]."""
    grid = _grid(rectangle, shape, _SUN_GRID_M)
    share = np.zeros(grid, dtype=np.float32)
    for beam in sun:
        if rectangle.normal @ beam.direction > 0:
            share += ~beam.hits(rectangle, grid)[0]
    return resize_linear(share / np.float32(len(sun)), shape)


def _ambient_light(rectangle: Rectangle, shape: tuple[int, int], sky: Sequence[Beam], light: Light) -> FloatArray:
    """(3, h, w) light from the sky and, where the sky is hidden, from what hides it."""
    grid = _grid(rectangle, shape, _SKY_GRID_M)
    from_sky, from_surroundings = np.zeros(grid, dtype=np.float32), np.zeros(grid, dtype=np.float32)
    total = np.float32(0)
    for beam in sky:
        cosine = np.float32(rectangle.normal @ beam.direction)
        if cosine <= 0:
            continue
        total += cosine
        blocked, near = beam.hits(rectangle, grid)
        from_surroundings += cosine * (blocked & ~near)
        if beam.direction[2] > 0:
            from_sky += cosine * ~blocked
    coarse = from_sky * light.sky[:, None, None] + from_surroundings * light.surroundings[:, None, None]
    return np.stack([resize_linear(channel / total + np.float32(0.015), shape) for channel in coarse])


def _directions(count: int) -> npt.NDArray[np.float64]:
    """(count, 3) unit vectors spread evenly over the sphere, on a golden spiral."""
    index = np.arange(count) + 0.5
    z = 1 - 2 * index / count
    angle = np.pi * (1 + np.sqrt(5)) * index
    return np.stack([np.sqrt(1 - z**2) * np.cos(angle), np.sqrt(1 - z**2) * np.sin(angle), z], axis=1)


def _grid(rectangle: Rectangle, shape: tuple[int, int], cell_m: float) -> tuple[int, int]:
    """Number of cells for a quantity that varies slowly: about ``cell_m`` large, at least four, at most the texels."""
    return (
        min(shape[0], max(4, round(rectangle.height_m / cell_m))),
        min(shape[1], max(4, round(rectangle.width_m / cell_m))),
    )

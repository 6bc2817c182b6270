"""Photos of a scene: perspective-correct texture mapping, followed by the effects of a real camera on the light."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
from tests.rendering.canvas import FloatArray
from tests.rendering.scene import Rectangle, Scene, Surface

# Rays per pixel in each direction: more than one makes edges smooth and keeps detail on slanted textures.
_SUPERSAMPLING = 2
_NEAR_M = 0.05


@dataclass(frozen=True)
class PhotoCamera:
    """COLMAP's SIMPLE_RADIAL camera; the upper left corner of the upper left pixel is (0, 0).

    Attributes:
        width_px, height_px: of the photo.
        focal_px: focal length; the principal point is the middle.
        distortion: x_distorted = x (1 + distortion r^2), r in units of the focal length.
    """

    width_px: int
    height_px: int
    focal_px: float
    distortion: float = 0.0

    model = "SIMPLE_RADIAL"

    @property
    def params(self) -> tuple[float, float, float, float]:
        """Parameters in COLMAP's order: f, cx, cy, k."""
        return (self.focal_px, self.width_px / 2, self.height_px / 2, self.distortion)

    def project(self, points_in_cam: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """(n, 2) pixels of (n, 3) points before the camera."""
        plane = points_in_cam[:, :2] / points_in_cam[:, 2:]
        radial = 1 + self.distortion * np.sum(plane**2, axis=1, keepdims=True)
        return np.asarray(self.focal_px * plane * radial + np.array([self.width_px, self.height_px]) / 2)

    @cached_property
    def rays(self) -> tuple[FloatArray, FloatArray]:
        """x and y at depth 1 of all rays, two (h, w) arrays for ``_SUPERSAMPLING`` times the pixels."""
        step = 1 / _SUPERSAMPLING
        columns = (np.arange(self.width_px * _SUPERSAMPLING) + 0.5) * step - self.width_px / 2
        rows = (np.arange(self.height_px * _SUPERSAMPLING) + 0.5) * step - self.height_px / 2
        x, y = np.meshgrid(columns / self.focal_px, rows / self.focal_px)
        radius = np.hypot(x, y)
        undistorted = radius
        for _ in range(20):
            undistorted = radius / (1 + self.distortion * undistorted**2)
        ratio = undistorted / np.maximum(radius, 1e-12)
        return (x * ratio).astype(np.float32), (y * ratio).astype(np.float32)

    @cached_property
    def extents(self) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Least and greatest ray x of each column, and ray y of each row."""
        x, y = self.rays
        return x.min(axis=0), x.max(axis=0), y.min(axis=1), y.max(axis=1)


def render(scene: Scene, camera: PhotoCamera, cam_from_world: npt.NDArray[np.float64]) -> FloatArray:
    """The light that reaches each pixel.

    Args:
        scene: what there is.
        camera: where rays go.
        cam_from_world: (3, 4) rotation and translation, metres.

    Returns:
        (height, width, 3) linear radiance.
    """
    x, y = camera.rays
    seen = [view for view in (_View.of(surface, camera, cam_from_world) for surface in scene.surfaces) if view]
    nearest = np.zeros(x.shape, dtype=np.float32)
    index = np.full(x.shape, -1, dtype=np.int16)
    for i, view in enumerate(seen):
        view.draw(i, nearest, index, x, y)
    radiance = np.empty((*x.shape, 3), dtype=np.float32)
    for i, view in enumerate(seen):
        view.shade(i, index, radiance, x, y, camera.focal_px * _SUPERSAMPLING)
    open_sky = index < 0
    directions = np.stack([x[open_sky], y[open_sky], np.ones(int(open_sky.sum()), np.float32)], axis=1)
    radiance[open_sky] = scene.sky.radiance(directions @ cam_from_world[:, :3].astype(np.float32))
    step = _SUPERSAMPLING
    total = sum(radiance[row::step, column::step] for row in range(step) for column in range(step))
    return np.asarray(total / np.float32(step**2))


def develop(radiance: FloatArray, exposure: float, rng: np.random.Generator) -> npt.NDArray[np.uint8]:
    """Turn radiance into 8-bit pixels as sensor and camera do: vignetting, noise, tone curve.

    Args:
        radiance: (h, w, 3) linear.
        exposure: factor on the light.
        rng: of the noise.
    """
    height, width = radiance.shape[:2]
    row = np.linspace(-1, 1, height, dtype=np.float32)[:, None]
    column = np.linspace(-1, 1, width, dtype=np.float32)[None, :] * np.float32(width / height)
    light = radiance * (exposure / (1 + 0.10 * (row**2 + column**2)) ** 2)[..., None].astype(np.float32)
    light += np.sqrt(1e-5 + 1.2e-4 * light) * rng.standard_normal(light.shape, dtype=np.float32)
    # Stray light in the lens, and crosstalk of colours on the sensor.
    light = np.maximum(light + np.float32(0.006), 0)
    light += np.float32(0.12) * ((light @ np.full((3, 1), 1 / 3, dtype=np.float32)) - light)
    # A film-like tone curve: deep shadows go black, and the sky does not burn out. Then the screen's gamma.
    toned = light**1.3 / (light**1.3 + np.float32(0.5))
    return np.asarray((255 * np.clip(1.2 * toned, 0, 1) ** np.float32(1 / 2.2) + 0.5).astype(np.uint8))


@dataclass(frozen=True)
class _View:
    """A surface as one camera sees it.

    On the picture, 1 / depth, u / depth and v / depth are affine in the ray's x and y: the rows of ``affine`` are these
    three functions.
    """

    surface: Surface
    affine: npt.NDArray[np.float64]
    rows: slice
    columns: slice

    @classmethod
    def of(cls, surface: Surface, camera: PhotoCamera, cam_from_world: npt.NDArray[np.float64]) -> _View | None:
        """Return the view of a surface, or None if the camera sees its back or it lies outside the picture."""
        rotation, translation = cam_from_world[:, :3], cam_from_world[:, 3]
        rectangle = surface.rectangle
        frame = np.stack(
            [
                rotation @ rectangle.edge_u_m,
                rotation @ rectangle.edge_v_m,
                rotation @ rectangle.corner_m + translation,
            ],
            axis=1,
        )
        # depth * (x, y, 1) = frame @ (u, v, 1); a front has u x v pointing away from the camera.
        if np.linalg.det(frame) < 1e-9:
            return None
        bounds = _picture_bounds(rectangle, rotation, translation)
        if bounds is None:
            return None
        x_low, x_high, y_low, y_high = camera.extents
        columns = slice(int(np.searchsorted(x_high, bounds[0])), int(np.searchsorted(x_low, bounds[1], "right")))
        rows = slice(int(np.searchsorted(y_high, bounds[2])), int(np.searchsorted(y_low, bounds[3], "right")))
        if columns.start >= columns.stop or rows.start >= rows.stop:
            return None
        return cls(surface, np.asarray(np.linalg.inv(frame), dtype=np.float64), rows, columns)

    def draw(
        self, number: int, nearest: FloatArray, index: npt.NDArray[np.int16], x: FloatArray, y: FloatArray
    ) -> None:
        """Write ``number`` where this surface is nearer (its 1 / depth greater) than what was drawn before."""
        block = (self.rows, self.columns)
        u, v, inverse_depth = (_evaluate(row, x[block], y[block]) for row in self.affine)
        hit = inverse_depth > nearest[block]
        hit &= (u >= 0) & (v >= 0)
        hit &= (u <= inverse_depth) & (v <= inverse_depth)
        np.copyto(nearest[block], inverse_depth, where=hit)
        np.copyto(index[block], np.int16(number), where=hit)

    def shade(
        self,
        number: int,
        index: npt.NDArray[np.int16],
        radiance: FloatArray,
        x: FloatArray,
        y: FloatArray,
        rays_per_unit: float,
    ) -> None:
        """Fill in the radiance where ``number`` was drawn last."""
        block = (self.rows, self.columns)
        visible = index[block] == number
        rows, columns = np.nonzero(visible)
        if len(rows) == 0:
            return
        ray_x, ray_y = x[block][visible], y[block][visible]
        u, v, inverse_depth = (_evaluate(row, ray_x, ray_y) for row in self.affine)
        depth = np.float32(1) / inverse_depth
        # The number of texels under one ray: the determinant of the map from rays to texels, and its root is a length.
        scale = self.surface.texture.num_texels * np.linalg.det(self.affine) / rays_per_unit**2
        level = 0.5 * np.log2(np.float32(scale) * depth**3)
        # The rays of one pixel are spread over two neighbouring levels, so that they blend.
        dither = ((rows % 2) * 2 + (columns % 2)).astype(np.float32) / 4 + np.float32(0.125)
        chosen = np.clip(level + dither, 0, 100).astype(np.int8)
        radiance[rows + self.rows.start, columns + self.columns.start] = self.surface.texture.sample(
            u * depth, v * depth, chosen
        )


def _evaluate(coefficients: npt.NDArray[np.float64], x: FloatArray, y: FloatArray) -> FloatArray:
    a, b, c = coefficients.astype(np.float32)
    value = a * x
    value += b * y
    value += c
    return np.asarray(value)


def _picture_bounds(
    rectangle: Rectangle, rotation: npt.NDArray[np.float64], translation: npt.NDArray[np.float64]
) -> tuple[float, float, float, float] | None:
    """Least and greatest x and y at depth 1 of the part in front of the camera; None if there is none."""
    corners = rectangle.corners_m @ rotation.T + translation
    following = np.roll(corners, -1, axis=0)
    crosses = (corners[:, 2] < _NEAR_M) != (following[:, 2] < _NEAR_M)
    share = (_NEAR_M - corners[crosses, 2]) / (following[crosses, 2] - corners[crosses, 2])
    cut = corners[crosses] + share[:, None] * (following[crosses] - corners[crosses])
    polygon = np.concatenate([corners[corners[:, 2] >= _NEAR_M], cut])
    if len(polygon) == 0:
        return None
    plane = polygon[:, :2] / polygon[:, 2:]
    return float(plane[:, 0].min()), float(plane[:, 0].max()), float(plane[:, 1].min()), float(plane[:, 1].max())

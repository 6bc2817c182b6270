"""Photos of a scene: perspective-correct texture mapping, followed by the effects of a real camera on the light."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pycolmap
from tests.rendering.canvas import FloatArray
from tests.rendering.scene import Rectangle, Scene

# Rays per pixel in each direction: more than one makes edges smooth and keeps detail on slanted textures.
_SUPERSAMPLING = 2


def render(scene: Scene, camera: pycolmap.Camera, cam_from_world: npt.NDArray[np.float64]) -> FloatArray:
    """The light that reaches each pixel.

    Args:
        scene: what there is.
        camera: where rays go.
        cam_from_world: (3, 4) rotation and translation, metres.

    Returns:
        (height, width, 3) linear radiance.
    """
    x, y = _rays(camera)
    views = [_view(surface.rectangle, cam_from_world) for surface in scene.surfaces]
    nearest = np.zeros(x.shape, dtype=np.float32)  # as 1 / depth
    index = np.full(x.shape, -1, dtype=np.int16)
    for number, view in enumerate(views):
        if np.linalg.det(view) <= 0:
            continue  # the camera sees its back
        u, v, inverse_depth = (a * x + b * y + c for a, b, c in view)
        hit = (inverse_depth > nearest) & (u >= 0) & (v >= 0) & (u <= inverse_depth) & (v <= inverse_depth)
        np.copyto(nearest, inverse_depth, where=hit)
        np.copyto(index, np.int16(number), where=hit)
    radiance = np.empty((*x.shape, 3), dtype=np.float32)
    for number in np.unique(index[index >= 0]):
        texture, view, (rows, columns) = scene.surfaces[number].texture, views[number], np.nonzero(index == number)
        u, v, inverse_depth = (a * x[rows, columns] + b * y[rows, columns] + c for a, b, c in view)
        # The number of texels under one ray: the determinant of the map from rays to texels, and its root is a length.
        scale = texture.num_texels * np.linalg.det(view) / (camera.focal_length * _SUPERSAMPLING) ** 2
        level = 0.5 * np.log2(np.float32(scale) / inverse_depth**3)
        # The rays of one pixel are spread over two neighbouring levels, so that they blend.
        dither = ((rows % 2) * 2 + (columns % 2)).astype(np.float32) / 4 + np.float32(0.125)
        chosen = np.clip(level + dither, 0, 100).astype(np.int8)
        radiance[rows, columns] = texture.sample(u / inverse_depth, v / inverse_depth, chosen)
    open_sky = index < 0
    directions = np.stack([x[open_sky], y[open_sky], np.ones(int(open_sky.sum()), np.float32)], axis=1)
    radiance[open_sky] = scene.sky.radiance(directions @ cam_from_world[:, :3].astype(np.float32))
    step = _SUPERSAMPLING
    total = sum(radiance[row::step, column::step] for row in range(step) for column in range(step))
    return np.asarray(total / np.float32(step**2))


def _rays(camera: pycolmap.Camera) -> FloatArray:
    """(2, h, w) x and y at depth 1 of all rays, ``_SUPERSAMPLING`` times the pixels."""
    sizes_px, step = (camera.width, camera.height), 1 / _SUPERSAMPLING
    columns, rows = (np.arange(0.5 * step, size, step) for size in sizes_px)
    pixels = np.stack(np.meshgrid(columns, rows), axis=-1)
    rays = np.asarray(camera.cam_from_img(pixels.reshape(-1, 2)), dtype=np.float32)
    return rays.T.reshape(2, *pixels.shape[:2])


def _view(rectangle: Rectangle, cam_from_world: npt.NDArray[np.float64]) -> FloatArray:
    """(3, 3) how a camera sees a rectangle: u / depth, v / depth and 1 / depth, each affine in a ray's x and y.

    The determinant is negative where the camera sees its back.
    """
    rotation, translation = cam_from_world[:, :3], cam_from_world[:, 3]
    at_corner = rotation @ rectangle.corner_m + translation
    # depth * (x, y, 1) = frame @ (u, v, 1); a front has u x v pointing away from the camera.
    frame = np.stack([rotation @ rectangle.edge_u_m, rotation @ rectangle.edge_v_m, at_corner], axis=1)
    return np.asarray(np.linalg.inv(frame), dtype=np.float32)


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

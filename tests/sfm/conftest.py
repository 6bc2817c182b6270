"""Photos of the corner of a textured room, rendered in a fraction of a second."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from PIL import Image
from tests.listener import Listener

from rangesfm.options import CameraOptions

WIDTH, HEIGHT, FOCAL_LENGTH = 256, 192, 240.0


@dataclass(frozen=True)
class Room:
    """A rendered walk: n photos in time order, of one camera."""

    folder: Path
    names: tuple[str, ...]
    centers: npt.NDArray[np.float64]
    camera: CameraOptions


@pytest.fixture
def listener() -> Listener:
    return Listener()


@pytest.fixture(scope="session")
def render_room() -> Callable[..., Room]:
    return _render_room


@pytest.fixture(scope="session")
def room(tmp_path_factory: pytest.TempPathFactory) -> Room:
    return _render_room(tmp_path_factory.mktemp("room"), num_photos=6)


def _render_room(folder: Path, num_photos: int, *, seed: int = 0, prefix: str = "photo") -> Room:
    """Render a walk past the corner where the planes x = 0, y = 0 and z = 0 meet; ``seed`` sets their textures."""
    rng = np.random.default_rng(seed)
    textures = [_texture(rng) for _ in range(3)]
    names = tuple(f"{prefix}{index:03d}.png" for index in range(num_photos))
    along = np.linspace(-0.5, 0.5, num_photos)
    angle = 0.7 + 0.06 * num_photos * along
    centers = np.stack([2.5 * np.cos(angle), 2.5 * np.sin(angle), 1.2 + 0.4 * np.sin(5 * along)], axis=1)
    folder.mkdir(parents=True, exist_ok=True)
    for name, center, s in zip(names, centers, along, strict=True):
        target = np.array([0.3, 0.3 + 0.3 * s, 0.6])
        Image.fromarray(_photograph(textures, center, target)).save(folder / name)
    camera = CameraOptions(model="SIMPLE_PINHOLE", params=(FOCAL_LENGTH, WIDTH / 2, HEIGHT / 2))
    return Room(folder, names, centers, camera)


def _texture(rng: np.random.Generator) -> npt.NDArray[np.float64]:
    layers, size = [], 512
    for cell in (4, 8, 16, 64):
        noise = Image.fromarray(rng.random((size // cell, size // cell)).astype(np.float32))
        layers.append(np.asarray(noise.resize((size, size), Image.Resampling.BICUBIC), dtype=np.float64))
    texture = np.sum(layers, axis=0)
    return np.asarray(255 * (texture - texture.min()) / np.ptp(texture))


def _photograph(
    textures: list[npt.NDArray[np.float64]], center: npt.NDArray[np.float64], target: npt.NDArray[np.float64]
) -> npt.NDArray[np.uint8]:
    u, v = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    rays_in_cam = np.stack([(u - WIDTH / 2) / FOCAL_LENGTH, (v - HEIGHT / 2) / FOCAL_LENGTH, np.ones_like(u)], axis=-1)
    z = (target - center) / np.linalg.norm(target - center)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    rays = rays_in_cam @ np.stack([x, np.cross(z, x), z])
    depth = np.where(rays < 0, -center / np.where(rays < 0, rays, -1.0), np.inf)
    plane = depth.argmin(axis=-1)
    points = center + rays * depth.min(axis=-1)[..., None]
    photo = np.zeros((HEIGHT, WIDTH))
    for index, texture in enumerate(textures):
        cell = np.mod((np.delete(points, index, axis=-1) * 120).astype(int), len(texture))
        photo = np.where(plane == index, texture[cell[..., 1], cell[..., 0]], photo)
    return photo.astype(np.uint8)

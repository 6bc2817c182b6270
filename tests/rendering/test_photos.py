"""A simulated photo shows what COLMAP's camera model would see of the scene."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pycolmap
import pytest
from tests.rendering.photos import PhotoCamera, develop, render
from tests.rendering.scene import Rectangle, Scene, Sky, Surface, Texture
from tests.simulated.path import look_at

FloatArray = npt.NDArray[np.float64]

CAMERA = PhotoCamera(320, 240, 250.0, -0.06)
NO_CLOUDS = Sky(np.zeros((4, 4), dtype=np.float32))


def _wall(radiance: float | FloatArray, y_m: float, half_size_m: float = 2.0) -> Surface:
    """An upright square at ``y_m``, facing south, its middle 1 m up."""
    corner = np.array([-half_size_m, y_m, 1 + half_size_m])
    rectangle = Rectangle(corner, np.array([2 * half_size_m, 0, 0]), np.array([0, 0, -2 * half_size_m]))
    picture = np.broadcast_to(np.asarray(radiance, dtype=np.float32), (3, 256, 256)).copy()
    return Surface(rectangle, Texture(picture))


def _pose(center: tuple[float, float, float], target: tuple[float, float, float], roll_deg: float = 0.0) -> FloatArray:
    centers = np.array([center])
    rotation = look_at(centers, np.array([target]), roll_deg)[0].T
    return np.column_stack([rotation, -rotation @ centers[0]])


def _marked_wall(u: float, v: float) -> Surface:
    """A dark wall with a round bright spot, 0.1 of the side wide, around (u, v)."""
    across = (np.arange(256) + 0.5) / 256
    distance = np.hypot(across[None, :] - u, across[:, None] - v)
    return _wall(0.02 + 0.9 * np.clip(256 * (0.05 - distance), 0, 1), 3.0)


@pytest.mark.parametrize("distortion", [0.0, -0.06, 0.05])
def test_camera_projects_as_colmap_does(distortion: float) -> None:
    camera = PhotoCamera(320, 240, 250.0, distortion)
    colmap_camera = pycolmap.Camera(model=camera.model, width=320, height=240, params=camera.params)
    points = np.random.default_rng(0).uniform([-1, -1, 2], [1, 1, 5], (50, 3))
    expected = np.asarray(colmap_camera.img_from_cam(points), dtype=np.float64)
    np.testing.assert_allclose(camera.project(points), expected, atol=1e-9)


@pytest.mark.parametrize("distortion", [0.0, -0.06, 0.05])
def test_rays_undo_the_projection(distortion: float) -> None:
    camera = PhotoCamera(320, 240, 250.0, distortion)
    x, y = camera.rays
    pixels = camera.project(np.column_stack([x.ravel(), y.ravel(), np.ones(x.size)]).astype(np.float64))
    rows, columns = np.indices(x.shape)
    np.testing.assert_allclose(pixels[:, 0], (columns.ravel() + 0.5) / 2, atol=1e-3)
    np.testing.assert_allclose(pixels[:, 1], (rows.ravel() + 0.5) / 2, atol=1e-3)


@pytest.mark.parametrize(("u", "v"), [(0.5, 0.5), (0.2, 0.3), (0.8, 0.35), (0.3, 0.8)])
@pytest.mark.parametrize("center", [(0.0, -2.0, 1.0), (2.5, -1.0, 1.8), (-2.0, 0.0, 0.3)])
def test_spot_on_a_wall_appears_where_the_camera_projects_it(
    u: float, v: float, center: tuple[float, float, float]
) -> None:
    wall = _marked_wall(u, v)
    pose = _pose(center, (0.0, 3.0, 1.0), roll_deg=4.0)
    photo = render(Scene([wall], NO_CLOUDS), CAMERA, pose)
    # Project the spot's outline: in perspective, the middle of its image is not the image of its middle.
    angle = np.linspace(0, 2 * np.pi, 400, endpoint=False)
    outline = np.array([wall.rectangle.point(u + 0.05 * np.cos(a), v + 0.05 * np.sin(a)) for a in angle])
    pixels = CAMERA.project(outline @ pose[:, :3].T + pose[:, 3])
    following = np.roll(pixels, -1, axis=0)
    cross = pixels[:, 0] * following[:, 1] - following[:, 0] * pixels[:, 1]
    expected = ((pixels + following) * cross[:, None]).sum(axis=0) / (3 * cross.sum())
    weight = np.where(_is_wall(photo), np.clip(photo[..., 0] - 0.03, 0, None), 0)
    rows, columns = np.indices(weight.shape)
    found = np.array([(weight * (columns + 0.5)).sum(), (weight * (rows + 0.5)).sum()]) / weight.sum()
    np.testing.assert_allclose(found, expected, atol=0.08)


def test_nearer_surface_hides_the_farther_one_in_either_order() -> None:
    far, near = _wall(0.2, 4.0), _wall(0.8, 3.0, half_size_m=0.5)
    pose = _pose((0.0, -1.0, 1.0), (0.0, 3.0, 1.0))
    photos = [render(Scene(surfaces, NO_CLOUDS), CAMERA, pose) for surfaces in ([far, near], [near, far])]
    np.testing.assert_array_equal(photos[0], photos[1])
    assert photos[0][120, 160] == pytest.approx(0.8, abs=0.01)
    assert photos[0][120, 160 - 50] == pytest.approx(0.2, abs=0.01)


def test_surface_seen_from_its_back_or_behind_the_camera_is_not_in_the_picture() -> None:
    sky_only = render(Scene([], NO_CLOUDS), CAMERA, _pose((0.0, 6.0, 1.0), (0.0, 3.0, 1.0)))
    from_behind = render(Scene([_wall(0.5, 3.0)], NO_CLOUDS), CAMERA, _pose((0.0, 6.0, 1.0), (0.0, 3.0, 1.0)))
    np.testing.assert_array_equal(from_behind, sky_only)
    turned_away = render(Scene([_wall(0.5, 3.0)], NO_CLOUDS), CAMERA, _pose((0.0, 0.0, 1.0), (0.0, -3.0, 1.0)))
    np.testing.assert_array_equal(turned_away, render(Scene([], NO_CLOUDS), CAMERA, _pose((0, 0, 1), (0, -3, 1))))


def test_ground_that_runs_under_the_camera_fills_the_lower_half() -> None:
    ground = Rectangle(np.array([-50.0, 50.0, 0.0]), np.array([100.0, 0, 0]), np.array([0, -100.0, 0]))
    surface = Surface(ground, Texture(np.full((3, 64, 64), 0.3, dtype=np.float32)))
    photo = render(Scene([surface], NO_CLOUDS), CAMERA, _pose((0.0, 0.0, 1.5), (0.0, 10.0, 1.5)))
    np.testing.assert_allclose(photo[140:], 0.3, atol=0.01)
    assert photo[:110, :, 2].min() > 0.5


def test_fine_pattern_far_away_is_averaged_not_aliased() -> None:
    checks = np.indices((256, 256)).sum(axis=0) % 2
    photo = render(
        Scene([_wall(np.multiply(0.8, checks, dtype=np.float64), 30.0)], NO_CLOUDS),
        CAMERA,
        _pose((0.0, 0.0, 1.0), (0.0, 30.0, 1.0)),
    )
    np.testing.assert_allclose(photo[112:128, 152:168], 0.4, atol=0.03)


def test_development_is_repeatable_brightens_with_exposure_and_darkens_the_corners() -> None:
    light = np.full((60, 80, 3), 0.3, dtype=np.float32)
    photo = develop(light, 1.0, np.random.default_rng(1))
    np.testing.assert_array_equal(photo, develop(light, 1.0, np.random.default_rng(1)))
    assert develop(light, 1.3, np.random.default_rng(1)).mean() > photo.mean() + 5
    assert photo[25:35, 35:45].mean() > photo[:5, :5].mean() + 5
    assert 0.3 < photo[25:35, 35:45].std() < 8


def _is_wall(photo: npt.NDArray[np.float32]) -> npt.NDArray[np.bool_]:
    """Return which pixels show the wall: it is grey, and the sky is not."""
    return np.asarray(np.ptp(photo, axis=2) < 0.02)

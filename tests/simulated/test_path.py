"""A simulated path is smooth, and its poses follow COLMAP's conventions."""

from __future__ import annotations

import numpy as np
import pytest
from tests.simulated.path import lap_path, look_at, loop_path, orbit_path, sequence_path

from rangesfm.demo.simulated_radio import CameraPath

PATHS = {
    "loop": loop_path(40.0, start_s=1e9, seed=3),
    "orbit": orbit_path(30.0),
    "sequence": sequence_path(100.0, seed=2),
}


def _times(path: CameraPath, step_s: float) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    return np.arange(path.start_s, path.end_s, step_s)


@pytest.mark.parametrize("name", PATHS)
def test_rotations_are_proper(name: str) -> None:
    path = PATHS[name]
    rotations = path.world_from_cam(_times(path, 0.7))
    np.testing.assert_allclose(
        rotations @ rotations.transpose(0, 2, 1), np.tile(np.eye(3), (len(rotations), 1, 1)), atol=1e-12
    )
    np.testing.assert_allclose(np.linalg.det(rotations), 1.0)


@pytest.mark.parametrize("name", PATHS)
def test_walks_smoothly_at_walking_pace(name: str) -> None:
    path = PATHS[name]
    centers = path.centers(_times(path, 0.1))
    velocity = np.diff(centers, axis=0) / 0.1
    assert np.linalg.norm(velocity, axis=1).max() < 2.0
    assert np.linalg.norm(np.diff(velocity, axis=0) / 0.1, axis=1).max() < 1.5
    turned = path.world_from_cam(_times(path, 1.0))
    cosine = (np.einsum("nij,nij->n", turned[1:], turned[:-1]) - 1) / 2
    assert np.degrees(np.arccos(cosine)).max() < 25


def test_camera_looks_at_its_target_with_the_ground_below() -> None:
    rotation = look_at(np.array([[1.0, 2.0, 1.5]]), np.array([[4.0, 6.0, 1.5]]))[0]
    np.testing.assert_allclose(rotation[:, 2], [0.6, 0.8, 0.0], atol=1e-12)
    np.testing.assert_allclose(rotation[:, 1], [0.0, 0.0, -1.0], atol=1e-12)
    np.testing.assert_allclose(rotation[:, 0], [0.8, -0.6, 0.0], atol=1e-12)


def test_loop_comes_back_to_what_it_saw_and_is_not_flat() -> None:
    path = loop_path(40.0, num_turns=1.2, seed=1)
    centers = path.centers(np.linspace(0.0, 40.0, 200))
    revisited = np.linalg.norm(centers[170:] - centers[None, 0], axis=1).min()
    assert revisited < 0.8
    assert np.ptp(centers[:, 2]) > 0.4


def test_sequence_never_returns() -> None:
    centers = sequence_path(200.0, seed=5).centers(np.linspace(0.0, 200.0, 400))
    assert np.all(np.diff(centers[:, 0]) > 0)


def test_same_seed_same_path_and_another_seed_another() -> None:
    times = np.linspace(0.0, 20.0, 9)
    np.testing.assert_array_equal(loop_path(20.0, seed=4).centers(times), loop_path(20.0, seed=4).centers(times))
    assert np.abs(loop_path(20.0, seed=4).centers(times) - loop_path(20.0, seed=5).centers(times)).max() > 0.01


def test_a_lap_goes_round_the_field_and_looks_ahead() -> None:
    path = lap_path(300.0)
    times = _times(path, 0.5)
    centers = path.centers(times)
    np.testing.assert_allclose(centers[:, :2].min(axis=0), [-52.5, -34.0], atol=0.2)
    np.testing.assert_allclose(centers[:, :2].max(axis=0), [52.5, 34.0], atol=0.2)
    assert np.linalg.norm(centers[-1] - centers[0]) < 8.0
    ahead = np.diff(centers, axis=0) / np.linalg.norm(np.diff(centers, axis=0), axis=1, keepdims=True)
    gaze = path.world_from_cam(times)[:-1, :, 2]
    assert np.sum(ahead * gaze, axis=1).min() > 0.99

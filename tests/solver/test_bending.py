"""What bends a map, and what only moves it as a whole."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation

from rangesfm.measurements.ranges.errors.range_bins import by_poses
from rangesfm.measurements.ranges.range_gradient import RangeGradient
from rangesfm.solver.bending import WalkBending, without_similarity
from rangesfm.util.geometry.similarity import Similarity, align_points
from rangesfm.util.geometry.trajectory import OnPath, Trajectory

Array = npt.NDArray[np.float64]

NUM_POSES, NUM_RANGES = 20, 60
RNG = np.random.default_rng(3)
ANCHORS_M = RNG.normal(size=(3, 3)) * 5
ARM_IN_CAM_M = np.array([0.3, -0.2, 0.4])
METRIC_FROM_MODEL = Similarity(2.3, Rotation.from_rotvec([0.3, -0.4, 0.8]).as_matrix(), np.array([1.0, 2.0, -1.0]))
ANCHOR_INDEX = np.arange(NUM_RANGES) % 3
BEFORE = np.sort(RNG.integers(0, NUM_POSES - 1, NUM_RANGES))
ON_PATH = OnPath(BEFORE, BEFORE + 1, RNG.uniform(size=NUM_RANGES))


@pytest.fixture(scope="module")
def path() -> Trajectory:
    """A path that starts at the origin, as in the first camera's frame."""
    along = np.linspace(0, 4, NUM_POSES)
    centers = np.column_stack([np.sin(along), 1 - np.cos(along), 0.3 * np.sin(3 * along)])
    turns = Rotation.from_rotvec(np.column_stack([0.2 * along, np.sin(along), 0.5 * along])).as_matrix()
    names = tuple(f"{k:02d}.jpg" for k in range(NUM_POSES))
    return Trajectory(np.arange(NUM_POSES), names, along, centers - centers[0], turns[0].T @ turns)


def placed(path: Trajectory) -> tuple[Array, Array, Array]:
    """Linearly interpolated centres and rotations at the ranges, and lever arms in the model's axes."""
    weight = ON_PATH.fraction[:, None]
    centers = (1 - weight) * path.centers[ON_PATH.before] + weight * path.centers[ON_PATH.after]
    arms = (1 - weight) * (path.world_from_cam[ON_PATH.before] @ ARM_IN_CAM_M)
    arms = arms + weight * (path.world_from_cam[ON_PATH.after] @ ARM_IN_CAM_M)
    return centers, path.world_from_cam[ON_PATH.before], arms


def from_anchors_m(path: Trajectory) -> Array:
    centers, _, arms = placed(path)
    tags_m = METRIC_FROM_MODEL.apply(centers) + arms @ METRIC_FROM_MODEL.rotation.T
    return np.asarray(tags_m - ANCHORS_M[ANCHOR_INDEX])


def slopes(path: Trajectory) -> Array:
    """(n, 6 k) derivatives of the ranges; the lever arm turns with the pose before the range."""
    _, rotations, arms = placed(path)
    into = METRIC_FROM_MODEL.rotation
    gradient = RangeGradient.of(from_anchors_m(path))
    found = by_poses(gradient, METRIC_FROM_MODEL, into @ rotations, arms @ into.T, ON_PATH)
    return np.asarray(found.toarray())


@pytest.mark.parametrize("frame_is_free", [True, False])
@pytest.mark.parametrize("loose", [[], [NUM_POSES - 1], [3, 4]])
def test_a_map_that_grows_turns_and_moves_as_a_whole_is_not_bent(
    path: Trajectory, frame_is_free: bool, loose: list[int]
) -> None:
    is_firm = ~np.isin(np.arange(NUM_POSES), loose)
    functions = without_similarity(slopes(path), path, is_firm, frame_is_free=frame_is_free)
    turn, shift, growth = np.array([0.3, -0.2, 0.5]), np.array([0.1, 0.4, -0.3]), 0.2
    moves = np.zeros((NUM_POSES, 6))
    moves[:, :3] = np.swapaxes(path.world_from_cam, 1, 2) @ turn
    moves[:, 3:] = growth * path.centers + np.cross(turn, path.centers) + shift
    assert np.abs(functions @ moves.ravel()).max() < 1e-9 * np.abs(slopes(path)).max()


@pytest.mark.parametrize("frame_is_free", [True, False])
def test_a_path_that_is_bent_back_is_as_large_as_it_came(path: Trajectory, frame_is_free: bool) -> None:
    steps = 0.3 * np.random.default_rng(5).standard_normal((NUM_POSES - 1, 7))
    bent = WalkBending(path, steps, frame_is_free).path
    assert np.linalg.norm(bent.centers - path.centers) > 0.1
    assert align_points(path.centers, bent.centers).scale == pytest.approx(1.0, rel=1e-9)
    if not frame_is_free:
        np.testing.assert_allclose(bent.centers[0], path.centers[0], atol=1e-12)
        np.testing.assert_allclose(bent.world_from_cam[0], path.world_from_cam[0], atol=1e-12)

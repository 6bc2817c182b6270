"""A point that wrong matches put into a camera, or next to it, is distinguished from one that is only near."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation

from rangesfm.estimation.vision_information import Rays, photo_gradient, vision_information
from rangesfm.util.geometry.poses import Poses

Array = npt.NDArray[np.float64]


class Scene:
    """Points in front of four keyframes of a rig with two cameras; the photos do not fit exactly.

    Attributes:
        seen: by which keyframes each point is seen.
    """

    def __init__(self, stddev: float) -> None:
        rng = np.random.default_rng(7)
        turns = Rotation.from_rotvec(rng.normal(0, 0.1, (4, 3))).as_matrix()
        self.poses = Poses(turns, rng.normal(0, 0.5, (4, 3)) + [[0.5 * k, 0.0, 0.0] for k in range(4)])
        self.seen = [(0, 1, 2, 3), (0, 1), (1, 2, 3), (0, 2), (0, 0, 1), (2, 3), (0, 1, 3), (3,), (0, 1, 2)]
        point = np.repeat(np.arange(len(self.seen)), [len(frames) for frames in self.seen])
        frame, num = np.concatenate([np.array(frames) for frames in self.seen]), len(point)
        cameras = Rotation.from_rotvec([[0.0, 0.05, 0.0], [0.1, -0.1, 0.0]]).as_matrix()
        shifts, camera = np.array([[0.0, 0.0, 0.0], [0.3, 0.1, 0.0]]), np.arange(num) % 2
        points = rng.uniform([-1.0, -1.0, 4.0], [1.0, 1.0, 8.0], (len(self.seen), 3))
        focal = rng.uniform(80.0, 120.0, num)
        exact = Rays(
            frame, point, np.zeros((num, 2)), focal, cameras[camera], shifts[camera], points, np.arange(len(points))
        )
        rays = np.array([self.ray(exact, row, self.poses, points[point[row]]) for row in range(num)])
        self.observations = replace(exact, ray=rays - stddev * rng.normal(size=rays.shape) / focal[:, None])

    @staticmethod
    def ray(observations: Rays, row: int, poses: Poses, place: Array) -> Array:
        """Return the ray (2,) at which one observation would see a place in the world."""
        frame = observations.frame[row]
        in_rig = poses.world_from_rig[frame].T @ (place - poses.centers[frame])
        in_cam = observations.cam_from_rig_rotation[row] @ in_rig + observations.cam_from_rig_translation[row]
        return np.asarray(in_cam[:2] / in_cam[2])

    def residuals(self, poses: Poses, points: Array) -> Array:
        """Return the (n, 2) residuals in standard deviations."""
        seen = self.observations
        rays = np.array([self.ray(seen, row, poses, points[seen.point[row]]) for row in range(len(seen.frame))])
        return np.asarray((rays - seen.ray) * seen.root_information[:, None])

    def moved(self, frame: int, step: Array) -> Poses:
        """Return the poses after a turn of one keyframe in its own frame and a shift."""
        turns, centers = self.poses.world_from_rig.copy(), self.poses.centers.copy()
        turns[frame] = turns[frame] @ Rotation.from_rotvec(step[:3]).as_matrix()
        centers[frame] += step[3:]
        return Poses(turns, centers)

    def by_points(self) -> Array:
        """Return the (2 n, 3 p) derivatives of the residuals by the points, from differences."""
        columns = []
        for unit in 1e-6 * np.eye(self.observations.points.size):
            ends = [
                self.residuals(self.poses, self.observations.points + sign * unit.reshape(-1, 3)) for sign in (1, -1)
            ]
            columns.append((ends[0] - ends[1]).ravel() / 2e-6)
        return np.stack(columns, axis=1)

    def by_poses(self) -> Array:
        """Return the (2 n, 6 m) derivatives by turns in the keyframes' own frames and shifts."""
        columns = []
        for frame in range(len(self.poses)):
            for unit in 1e-6 * np.eye(6):
                ends = [self.residuals(self.moved(frame, sign * unit), self.observations.points) for sign in (1, -1)]
                columns.append((ends[0] - ends[1]).ravel() / 2e-6)
        return np.stack(columns, axis=1)


@pytest.mark.parametrize("stddev", [0.0, 3.0])
def test_information_on_relative_poses_is_that_of_the_photos_with_the_points_eliminated(stddev: float) -> None:
    scene = Scene(stddev)
    vision = vision_information(scene.observations, scene.poses)
    size = np.sum(scene.residuals(scene.poses, scene.observations.points) ** 2, axis=1)
    root = np.repeat(np.sqrt(1 / (1 + size / 3.0**2)), 2)[:, None]  # Cauchy's weights of width 3
    of_points, of_poses = root * scene.by_points(), root * scene.by_poses()
    pairs = list(zip(vision.reference.tolist(), vision.frame.tolist(), strict=True))
    expected = np.zeros((6 * len(pairs), 6 * len(pairs)))
    for k, frames in enumerate(scene.seen):
        others = sorted({frame for frame in frames if frame != frames[0]})
        if not others:
            continue
        assert all((frames[0], frame) in pairs for frame in others)
        own = np.repeat(scene.observations.point == k, 2)
        by_point = of_points[own, 3 * k : 3 * k + 3]
        by_pose = of_poses[own].reshape(-1, 4, 6)[:, others]
        # The shift is measured in the frame of the first keyframe.
        by_pose[:, :, 3:] = by_pose[:, :, 3:] @ scene.poses.world_from_rig[frames[0]]
        by_pose = by_pose.reshape(len(by_point), -1)
        kept = np.eye(len(by_point)) - by_point @ np.linalg.pinv(by_point)
        columns = np.concatenate([6 * pairs.index((frames[0], frame)) + np.arange(6) for frame in others])
        expected[np.ix_(columns, columns)] += by_pose.T @ kept @ by_pose
    assert pairs == sorted({(frames[0], frame) for frames in scene.seen for frame in frames if frame != frames[0]})
    found = vision.matrix.toarray()
    np.testing.assert_allclose(found, expected, atol=1e-6 * np.abs(expected).max())
    np.testing.assert_array_equal(vision.from_optimum, np.zeros(len(found)))
    assert vision.origin is scene.poses


def gradient_by_differences(scene: Scene, is_in: npt.NDArray[np.bool_]) -> Array:
    """Return the gradient of half the sum of squares of some observations, whose points follow the poses linearly."""
    rows = np.repeat(is_in, 2)
    of_points = scene.by_points()[rows]

    def cost(poses: Poses) -> float:
        off = scene.residuals(poses, scene.observations.points).ravel()[rows]
        left = off - of_points @ np.linalg.lstsq(of_points, off, rcond=1e-12)[0]
        return float(0.5 * left @ left)

    steps = [(frame, 1e-6 * unit) for frame in range(4) for unit in np.eye(6)]
    return np.array(
        [(cost(scene.moved(frame, step)) - cost(scene.moved(frame, -step))) / 2e-6 for frame, step in steps]
    )


def test_the_gradient_of_the_photos_is_that_of_their_cost() -> None:
    scene = Scene(stddev=1.0)
    everything = np.ones(len(scene.observations.frame), dtype=bool)
    expected = gradient_by_differences(scene, everything)
    found = photo_gradient(scene.observations, scene.poses)
    np.testing.assert_allclose(found, expected, atol=1e-4 * np.abs(expected).max())


@pytest.mark.parametrize(("off", "counts"), [(9.5, True), (10.5, False)])
def test_a_feature_far_off_says_nothing_of_the_gradient(off: float, counts: bool) -> None:
    scene = Scene(stddev=0.3)
    rays = scene.observations.ray.copy()
    size = scene.residuals(scene.poses, scene.observations.points)[2]
    rays[2] += (size - off * np.array([0.6, 0.8])) / scene.observations.root_information[2]
    scene.observations = replace(scene.observations, ray=rays)
    is_in = np.arange(len(rays)) != (-1 if counts else 2)
    expected = gradient_by_differences(scene, is_in)
    found = photo_gradient(scene.observations, scene.poses)
    np.testing.assert_allclose(found, expected, atol=1e-4 * np.abs(expected).max())


def test_a_point_behind_a_camera_says_nothing_of_the_gradient() -> None:
    scene = Scene(stddev=0.3)
    turns = scene.observations.cam_from_rig_rotation.copy()
    turns[2] = np.diag([-1.0, 1.0, -1.0]) @ turns[2]
    scene.observations = replace(scene.observations, cam_from_rig_rotation=turns)
    expected = gradient_by_differences(scene, np.arange(len(turns)) != 2)
    found = photo_gradient(scene.observations, scene.poses)
    np.testing.assert_allclose(found, expected, atol=1e-4 * np.abs(expected).max())

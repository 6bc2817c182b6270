"""Every model of a range is that of the compiled cost, on one random scene: what it predicts, and its derivatives."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pyceres
import pytest
from scipy.spatial.transform import Rotation
from tests.known_errors import known_errors
from tests.simulated.model import SyntheticModel

from rangesfm.measurements.kind import LEAST_SQUARES, MapState
from rangesfm.measurements.ranges.anchors.anchor import AnchorEstimate
from rangesfm.measurements.ranges.association import associate
from rangesfm.measurements.ranges.errors.range_bins import by_poses
from rangesfm.measurements.ranges.radio import ranges_of_map
from rangesfm.measurements.ranges.range_log import RangeLog
from rangesfm.measurements.ranges.scale.range_equation import (
    RangeProblem,
    RangeState,
    columns_of,
    predicted_ranges,
    range_gradient,
)
from rangesfm.measurements.ranges.scale.range_equation import range_jacobian as jacobian_of_map
from rangesfm.options import RefineOptions
from rangesfm.solver import interpolated_range_cost
from rangesfm.util.geometry.poses import Poses
from rangesfm.util.geometry.similarity import Similarity
from rangesfm.util.geometry.trajectory import trajectory_from_reconstruction

Array = npt.NDArray[np.float64]
STEP = 1e-5


@pytest.fixture
def scene(chain: SyntheticModel) -> Scene:
    return Scene(chain)


class Scene:
    """Ranges between the keyframes of a curved path, with a lever arm and biases, to anchors at random places."""

    def __init__(self, chain: SyntheticModel) -> None:
        rng = np.random.default_rng(3)
        metric = trajectory_from_reconstruction(chain.reconstruction, chain.timestamps_s)
        self.metric_from_sfm = Similarity(2.3, Rotation.random(random_state=3).as_matrix(), rng.normal(size=3))
        back = self.metric_from_sfm.inverse()
        sfm = metric.transformed(back.scale, back.rotation, back.translation)
        self.tag_in_cam_m, num = rng.normal(0, 0.3, 3), 24
        self.anchors_m, self.biases_m = metric.centers[:3] + rng.normal(0, 6, (3, 3)), rng.normal(0, 0.2, 3)
        self.anchors = tuple(
            AnchorEstimate(f"A{k}", self.anchors_m[k], 0.1, self.anchors_m[k], 0.1, self.biases_m[k], 0.0, 0.1)
            for k in range(3)
        )
        times = rng.uniform(0.6, 29.4, num)
        self.log = RangeLog.from_arrays([f"A{k % 3}" for k in range(num)], rng.uniform(3, 9, num), timestamp_s=times)
        placed, bow = associate(self.log, sfm, self.tag_in_cam_m), rng.normal(0, 0.1, (num, 3))
        self.observations = replace(
            placed, centers=placed.centers + bow, center_offsets=placed.center_offsets + bow
        )  # the path is hardly curved between its keyframes
        errors = replace(known_errors(self.observations, 1.0), loss=LEAST_SQUARES)
        self.ranges = ranges_of_map(
            sfm, self.observations, self.metric_from_sfm, self.tag_in_cam_m, self.anchors, errors, RefineOptions()
        )
        self.places, self.sfm = self.ranges.places, sfm
        self.poses = Poses(metric.world_from_cam, metric.centers)
        self.in_map = MapState(self.poses, self.ranges.blocks)
        self.tags_m, _ = self.ranges.antennas_m(self.in_map)

    def compiled(self, poses: Poses, anchors_m: Array, biases_m: Array) -> Array:
        """Return the (n,) residuals of the compiled cost, metres."""
        quaternions = Rotation.from_matrix(np.swapaxes(poses.world_from_rig, 1, 2)).as_quat()
        shifts = -np.einsum("nji,nj->ni", poses.world_from_rig, poses.centers)
        problem, blocks = pyceres.Problem(), np.hstack([quaternions, shifts])
        anchors, biases = list(anchors_m.copy()), list(biases_m[:, None].copy())
        for row, k in enumerate(self.log.anchor_index.tolist()):
            cost = interpolated_range_cost(
                range_m=self.log.range_m[[row]],
                stddev_m=[1.0],
                tag_in_cam_m=self.tag_in_cam_m,
                weight=self.places.fraction[[row]],
                offset_in_world_m=self.places.offset_m[[row]],
            )
            ends = [blocks[self.places.before[row]], blocks[self.places.after[row]]]
            problem.add_residual_block(cost, None, [*ends, anchors[k], biases[k]])
        return np.asarray(problem.evaluate_residuals())

    def moved(self, frame: int, step: Array) -> Array:
        """Return the compiled residuals after a turn of a keyframe in its own frame and a shift."""
        turns, centers = self.poses.world_from_rig.copy(), self.poses.centers.copy()
        turns[frame] = turns[frame] @ Rotation.from_rotvec(step[:3]).as_matrix()
        centers[frame] += step[3:]
        return self.compiled(Poses(turns, centers), self.anchors_m, self.biases_m)

    @property
    def by_pose(self) -> Array:
        """The compiled cost's derivatives (n, 6 k) by all keyframes, from differences."""
        num = len(self.poses)
        columns = [
            (self.moved(k, STEP * unit) - self.moved(k, -STEP * unit)) / (2 * STEP)
            for k in np.unique([self.places.before, self.places.after]).tolist()
            for unit in np.eye(6)
        ]
        found = np.zeros((len(self.log), num, 6))
        seen = np.unique([self.places.before, self.places.after])
        found[:, seen] = np.stack(columns, axis=1).reshape(len(self.log), -1, 6)
        return found.reshape(len(self.log), -1)

    @property
    def problem(self) -> RangeProblem:
        """The same ranges in the scale stage."""
        known = np.full(3, 0.1)
        return RangeProblem(
            self.observations.centers, self.observations.tag_from_center, self.log.anchor_index, self.log.range_m,
            np.ones(len(self.log)), self.anchors_m, known, np.zeros(3), known, 0.1, frame_is_free=True,
            share=np.ones(len(self.log)),
        )  # fmt: skip

    @property
    def state(self) -> RangeState:
        return RangeState(self.metric_from_sfm, self.anchors_m, self.biases_m)


def test_all_models_predict_the_same_ranges(scene: Scene) -> None:
    expected, problem = scene.compiled(scene.poses, scene.anchors_m, scene.biases_m), scene.problem
    np.testing.assert_allclose(predicted_ranges(problem, scene.state) - problem.range_m, expected, atol=1e-9)
    in_map = scene.ranges.linearize(scene.in_map).residual[:, 0]
    np.testing.assert_allclose(in_map, expected[scene.ranges.rows], atol=1e-9)


def test_all_models_change_alike_with_the_keyframes(scene: Scene) -> None:
    expected, linear = scene.by_pose, scene.ranges.linearize(scene.in_map)
    by_pose = np.zeros((len(scene.log), len(scene.poses), 6))
    for k in range(2):
        by_pose[np.arange(len(scene.log)), linear.pose[:, k]] += linear.by_pose[:, 0, k]
    np.testing.assert_allclose(by_pose.reshape(expected.shape), expected[scene.ranges.rows], atol=1e-8)
    on_path, arms_m = scene.observations.on_path(np.arange(len(scene.log))), scene.observations.tag_from_center
    placed, turns = scene.metric_from_sfm, scene.sfm.world_from_cam[on_path.before]
    found = by_poses(range_gradient(scene.problem, scene.state), placed, turns, arms_m, on_path).toarray()
    seen, of_cost = (values.reshape(len(values), -1, 6) for values in (found, expected))
    of_cost = of_cost[:, : seen.shape[1]]
    np.testing.assert_allclose(seen[:, :, 3:], of_cost[:, :, 3:] @ (placed.scale * placed.rotation), atol=1e-8)
    # The scale stage turns the lever arm at the time of the range, the cost one at each of the two keyframes.
    np.testing.assert_allclose(seen[:, :, :3], of_cost[:, :, :3], atol=0.02 * np.abs(of_cost[:, :, :3]).max())


def test_all_models_change_alike_with_anchors_and_biases(scene: Scene) -> None:
    columns = columns_of([scene.problem])[0]
    of_map = jacobian_of_map(scene.problem, columns, scene.state, scene.state)
    in_map = of_map[:, min(columns.anchor) :]
    differences = []
    for unit in np.eye(12):
        anchors_m, biases_m = STEP * unit[:9].reshape(3, 3), STEP * unit[9:]
        ends = (
            scene.compiled(scene.poses, scene.anchors_m + sign * anchors_m, scene.biases_m + sign * biases_m)
            for sign in (1, -1)
        )
        differences.append((next(ends) - next(ends)) / (2 * STEP))
    np.testing.assert_allclose(in_map, np.stack(differences, axis=1), atol=1e-8)

"""The scale stage's model of ranges is that of the refined map: what it predicts, and its derivatives by keyframes.

That of the refined map is held against the compiled cost in ``tests/measurements/test_kinds.py``.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
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
    predicted_ranges,
    range_gradient,
)
from rangesfm.options import RefineOptions
from rangesfm.util.geometry.poses import Poses
from rangesfm.util.geometry.similarity import Similarity
from rangesfm.util.geometry.trajectory import trajectory_from_reconstruction

Array = npt.NDArray[np.float64]


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
        sfm = metric.transformed(back)
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
        self.sfm, self.in_map = sfm, MapState(Poses(metric.world_from_cam, metric.centers), self.ranges.blocks)
        self.linear = self.ranges.linearize(self.in_map)

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


def test_both_predict_the_same_ranges(scene: Scene) -> None:
    in_scale = predicted_ranges(scene.problem, scene.state) - scene.log.range_m
    np.testing.assert_allclose(in_scale[scene.ranges.rows], scene.linear.residual[:, 0], atol=1e-9)


def test_both_change_alike_with_the_keyframes(scene: Scene) -> None:
    rows = np.arange(len(scene.log))
    by_pose = np.zeros((len(rows), len(scene.in_map.poses), 6))
    for k in range(2):
        by_pose[scene.ranges.rows, scene.linear.pose[:, k]] += scene.linear.by_pose[:, 0, k]
    on_path, placed = scene.observations.subset(rows), scene.metric_from_sfm
    turns = placed.rotation @ scene.sfm.world_from_cam[on_path.before]
    arms_m = scene.observations.tag_from_center @ placed.rotation.T
    found = by_poses(range_gradient(scene.problem, scene.state), placed, turns, arms_m, on_path).toarray()
    seen = found.reshape(len(rows), -1, 6)
    by_pose = by_pose[:, : seen.shape[1]]
    np.testing.assert_allclose(seen[:, :, 3:], by_pose[:, :, 3:] @ (placed.scale * placed.rotation), atol=1e-8)
    # The scale stage turns the lever arm at the time of the range, the map one at each of the two keyframes.
    np.testing.assert_allclose(seen[:, :, :3], by_pose[:, :, :3], atol=0.02 * np.abs(by_pose[:, :, :3]).max())

"""A model that is moved with its keyframes still fits its photos."""

from __future__ import annotations

import numpy as np
from tests.estimation.conftest import bent, poses_and_rays
from tests.simulated.model import SyntheticModel

from rangesfm.estimation.drift import carry_model
from rangesfm.estimation.vision_information import project, ray_residuals
from rangesfm.util.geometry.poses import model_poses
from rangesfm.util.geometry.trajectory import trajectory_from_reconstruction


def test_points_follow_a_bend_and_a_growth_of_the_map(chain: SyntheticModel) -> None:
    metric = chain.reconstruction
    frame_ids = trajectory_from_reconstruction(metric, chain.timestamps_s).frame_ids
    before, rays = poses_and_rays(chain)
    after, local_scale = bent(before, 3.0, 1.1)
    left_behind = ray_residuals(rays, project(rays, after, rays.points)[1])
    carry_model(metric, frame_ids, rays, before, after, local_scale)
    moved = model_poses(metric, frame_ids)
    np.testing.assert_allclose(moved.centers, after.centers, atol=1e-9)
    np.testing.assert_allclose(moved.world_from_rig, after.world_from_rig, atol=1e-9)
    points = np.array([metric.point3D(int(point_id)).xyz for point_id in rays.point_ids])
    residuals = ray_residuals(rays, project(rays, after, points)[1])
    assert np.median(np.linalg.norm(left_behind[np.isfinite(left_behind).all(axis=1)], axis=1)) > 20
    # A bend between keyframes cannot fit exactly: 3 degrees are two thirds of a pixel from one keyframe to the next.
    assert np.median(np.linalg.norm(residuals, axis=1)) < 1.0
    assert np.isfinite(residuals).all()


def test_a_frame_that_stays_is_not_touched(chain: SyntheticModel) -> None:
    metric = chain.reconstruction
    frame_ids = trajectory_from_reconstruction(metric, chain.timestamps_s).frame_ids
    before, rays = poses_and_rays(chain)
    params = metric.frame(int(frame_ids[0])).rig_from_world
    assert params is not None
    at_start = params.params.copy()
    after, local_scale = bent(before, 20.0, 1.0)
    carry_model(metric, frame_ids, rays, before, after, local_scale)
    np.testing.assert_array_equal(params.params, at_start)

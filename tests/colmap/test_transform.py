"""A model is transformed to the metric world, and the original stays as it is."""

from __future__ import annotations

import numpy as np
import pytest
from tests.simulated.model import SyntheticModel, synthetic_model
from tests.simulated.path import along, orbit_path

from rangesfm.colmap.transform import rescale
from rangesfm.util.geometry.trajectory import trajectory_from_reconstruction


@pytest.fixture(scope="module")
def model() -> SyntheticModel:
    path, times = orbit_path(10.0), np.linspace(0.0, 10.0, 8)
    return synthetic_model(*along(path, times), num_observations=30)


def test_poses_and_points_arrive_at_their_true_places(model: SyntheticModel) -> None:
    metric = rescale(model.reconstruction, model.metric_from_sfm)
    path = trajectory_from_reconstruction(metric, model.timestamps_s)
    np.testing.assert_allclose(path.centers, model.centers_m, atol=1e-9)
    np.testing.assert_allclose(path.world_from_cam, model.world_from_cam, atol=1e-12)
    for point_id, point in model.reconstruction.points3D.items():
        np.testing.assert_allclose(
            metric.point3D(point_id).xyz, model.metric_from_sfm.apply(np.array(point.xyz)), atol=1e-9
        )


def test_points_are_seen_where_they_were(model: SyntheticModel) -> None:
    metric = rescale(model.reconstruction, model.metric_from_sfm)
    image = metric.image(1)
    for observed in image.get_observation_points2D():
        np.testing.assert_allclose(
            np.array(image.project_point(metric.point3D(observed.point3D_id).xyz)), observed.xy, atol=1e-7
        )


def test_the_original_stays_as_it_was(model: SyntheticModel) -> None:
    before = trajectory_from_reconstruction(model.reconstruction, model.timestamps_s)
    points = {point_id: np.array(point.xyz) for point_id, point in model.reconstruction.points3D.items()}
    rescale(model.reconstruction, model.metric_from_sfm)
    after = trajectory_from_reconstruction(model.reconstruction, model.timestamps_s)
    np.testing.assert_array_equal(after.centers, before.centers)
    for point_id, xyz in points.items():
        np.testing.assert_array_equal(model.reconstruction.point3D(point_id).xyz, xyz)

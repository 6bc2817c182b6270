"""A synthetic model is one of COLMAP's, and the known similarity takes it to the known truth."""

from __future__ import annotations

import numpy as np
import pytest
from tests.simulated.model import SyntheticModel, synthetic_model
from tests.simulated.path import orbit_path, sequence_path

from rangesfm.demo.simulated_radio import CameraPath
from rangesfm.geometry.trajectory import trajectory_from_reconstruction


def _model(path: CameraPath, num_frames: int, **options: object) -> SyntheticModel:
    times = np.linspace(path.start_s, path.end_s, num_frames)
    return synthetic_model(times, path.centers(times), path.world_from_cam(times), **options)  # type: ignore[arg-type]


def _reprojection_errors(model: SyntheticModel) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    errors = []
    for image in model.reconstruction.images.values():
        for point in image.get_observation_points2D():
            projected = image.project_point(model.reconstruction.point3D(point.point3D_id).xyz)
            assert projected is not None
            errors.append(projected - point.xy)
    return np.array(errors)


def test_reprojection_is_exact_without_noise() -> None:
    assert np.abs(_reprojection_errors(_model(orbit_path(20.0), 20, num_observations=60))).max() < 1e-9


def test_reprojection_errors_have_the_given_stddev() -> None:
    errors = _reprojection_errors(_model(orbit_path(20.0), 30, num_observations=100, pixel_stddev=0.7))
    assert errors.std() == pytest.approx(0.7, rel=0.05)
    assert np.abs(errors.mean(axis=0)).max() < 0.06


def test_similarity_takes_the_model_to_the_true_path() -> None:
    model = _model(sequence_path(30.0, seed=1), 30, num_observations=40, seed=5)
    similarity = model.metric_from_sfm
    assert abs(np.log(similarity.scale)) > 0.05
    path = trajectory_from_reconstruction(model.reconstruction, model.timestamps_s)
    moved = path.transformed(similarity.scale, similarity.rotation, similarity.translation)
    np.testing.assert_allclose(moved.centers, model.centers_m, atol=1e-9)
    np.testing.assert_allclose(moved.world_from_cam, model.world_from_cam, atol=1e-12)
    np.testing.assert_allclose(np.asarray(path.timestamps_s), np.linspace(0.0, 30.0, 30))


def test_every_photo_has_its_observations_and_every_point_is_seen_twice() -> None:
    reconstruction = _model(orbit_path(20.0), 20, num_observations=80).reconstruction
    assert reconstruction.is_valid()
    assert reconstruction.num_reg_images() == 20
    assert min(image.num_points3D for image in reconstruction.images.values()) > 60
    assert max(image.num_points3D for image in reconstruction.images.values()) <= 80
    assert min(point.track.length() for point in reconstruction.points3D.values()) >= 2


def test_tracks_end_at_the_given_length() -> None:
    reconstruction = _model(orbit_path(20.0), 40, num_observations=60, max_track_length=5).reconstruction
    spans = []
    for point in reconstruction.points3D.values():
        images = [element.image_id for element in point.track.elements]
        spans.append(max(images) - min(images) + 1)
    assert max(spans) == 5


def test_same_seed_same_model_and_another_seed_another() -> None:
    first, second, other = (_model(orbit_path(10.0), 5, num_observations=20, seed=seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(_points(first), _points(second))
    assert first.metric_from_sfm.scale == second.metric_from_sfm.scale != other.metric_from_sfm.scale


def _points(model: SyntheticModel) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    return np.array([point.xyz for point in model.reconstruction.points3D.values()])

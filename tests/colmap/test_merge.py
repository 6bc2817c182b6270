"""Merging separate models keeps every photo, point, camera and rig once, and in its place."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
import pycolmap
import pytest

from rangesfm.colmap.transform import joined_model, rescale, without_photos
from rangesfm.util.geometry.similarity import Similarity

TWICE_AS_LARGE = Similarity(2.0, np.eye(3), np.array([1.0, 2.0, 3.0]))


def rigs_of_cameras(num_rigs: int, num_cameras: int) -> pycolmap.Reconstruction:
    pycolmap.set_random_seed(1)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig = num_rigs, num_cameras
    options.num_frames_per_rig, options.num_points3D = 4, 40
    return pycolmap.synthesize_dataset(options)


def centers_of(model: pycolmap.Reconstruction) -> npt.NDArray[np.float64]:
    return np.array([image.projection_center() for image in model.images.values()])


@pytest.mark.parametrize("num_cameras", [1, 3])
def test_models_with_the_same_ids_keep_all_photos_points_and_cameras(num_cameras: int, tmp_path: Path) -> None:
    model = rigs_of_cameras(2, num_cameras)
    for image in model.images.values():
        assert image.num_points3D > 0
    # A model of another scale has other rigs, if these have more than one camera.
    larger = rescale(model, TWICE_AS_LARGE)
    joined = joined_model([model, larger])
    assert joined.is_valid()
    assert joined.num_rigs() == (2 if num_cameras == 1 else 4)
    assert joined.num_cameras() == joined.num_rigs() * num_cameras
    assert joined.num_reg_images() == 2 * model.num_reg_images()
    assert joined.num_points3D() == 2 * model.num_points3D()
    assert joined.compute_num_observations() == 2 * model.compute_num_observations()
    joined.write(tmp_path)
    read = pycolmap.Reconstruction(tmp_path)
    assert read.compute_mean_reprojection_error() == pytest.approx(model.compute_mean_reprojection_error(), abs=1e-9)
    apart = np.concatenate([centers_of(model), centers_of(larger)])
    np.testing.assert_allclose(np.sort(centers_of(read), axis=0), np.sort(apart, axis=0), atol=1e-9)


def test_parts_of_one_model_keep_their_ids_and_their_camera() -> None:
    model = rigs_of_cameras(1, 1)
    names = sorted(image.name for image in model.images.values())
    parts = [without_photos(model, names[2:]), without_photos(model, names[:2])]
    assert [part.num_reg_images() for part in parts] == [2, 2]
    assert model.num_reg_images() == 4
    joined = joined_model(parts)
    assert {image.image_id: image.name for image in joined.images.values()} == {
        image.image_id: image.name for image in model.images.values()
    }
    assert joined.num_cameras() == joined.num_rigs() == 1


def test_a_camera_with_other_parameters_is_another_one() -> None:
    model, other = rigs_of_cameras(1, 1), rigs_of_cameras(1, 1)
    other.camera(1).params = (1.01 * other.camera(1).params).tolist()
    joined = joined_model([model, other])
    assert joined.num_cameras() == 2
    assert joined.is_valid()
    assert joined.compute_mean_reprojection_error() > model.compute_mean_reprojection_error()


def test_a_model_without_any_of_the_photos_is_itself() -> None:
    model = rigs_of_cameras(1, 1)
    assert without_photos(model, {"another.jpg"}) is model

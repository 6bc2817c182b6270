"""A copy of the database has the map's positions as pose priors, with their covariance."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pycolmap
import pytest
from tests.simulated.model import synthetic_model
from tests.simulated.path import along, loop_path

from rangesfm.errors import InputError
from rangesfm.export.colmap import write_pose_priors
from rangesfm.export.metric_map import MetricMap
from rangesfm.measurements.positions.pose_priors import read_pose_priors


@pytest.fixture
def model() -> pycolmap.Reconstruction:
    path, times = loop_path(8.0), np.arange(4.0)
    return synthetic_model(*along(path, times), num_observations=20).reconstruction


def test_pose_priors_are_the_maps_positions_and_replace_others(tmp_path: Path, model: pycolmap.Reconstruction) -> None:
    images = sorted(model.images.values(), key=lambda image: image.name)
    with pycolmap.Database.open(tmp_path / "database.db") as database:
        camera_id = database.write_camera(next(iter(model.cameras.values())))
        for image in reversed(images):
            written = pycolmap.Image(name=image.name, camera_id=camera_id)
            written.image_id = database.write_image(written)
            database.write_pose_prior(pycolmap.PosePrior(corr_data_id=written.data_id, position=[1, 2, 3]))
    first = images[0]
    map_ = MetricMap(model, database_path=tmp_path / "database.db", center_covariance_m2={first.name: 0.04 * np.eye(3)})
    log = read_pose_priors(write_pose_priors(map_, tmp_path / "pose_priors.db"))
    at = dict(zip(log.moments.image_name, log.position_m, strict=True))
    assert sorted(at) == [image.name for image in images]
    for image in images:
        np.testing.assert_array_equal(at[image.name], image.projection_center())
    covariance = log.covariance_m2[log.moments.image_name.index(first.name)]
    np.testing.assert_array_equal(covariance, 0.04 * np.eye(3))
    assert np.isnan(log.covariance_m2[log.moments.image_name.index(images[1].name)]).all()


def test_without_the_database_of_the_photos_one_line_says_so(tmp_path: Path, model: pycolmap.Reconstruction) -> None:
    with pytest.raises(InputError, match=r"needs the photos' database \(database.db\), which is not there"):
        write_pose_priors(MetricMap(model), tmp_path / "pose_priors.db")
    with pycolmap.Database.open(tmp_path / "other.db"):
        pass
    with pytest.raises(InputError, match="it has none of the map's photos, expected their database"):
        write_pose_priors(MetricMap(model, database_path=tmp_path / "other.db"), tmp_path / "pose_priors.db")
    assert not (tmp_path / "pose_priors.db").exists()

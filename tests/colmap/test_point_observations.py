"""The points that the photos of a model see, and their pixels."""

from __future__ import annotations

import numpy as np
import pycolmap
import pytest
from tests.simulated.model import synthetic_model
from tests.simulated.path import sequence_path

from rangesfm.colmap.point_observations import overlaps_in, seen_in


@pytest.fixture
def model() -> pycolmap.Reconstruction:
    times = np.arange(20.0)
    path = sequence_path(20.0, seed=1)
    walk = synthetic_model(
        times, path.centers(times), path.world_from_cam(times), num_observations=60, max_track_length=3
    )
    return walk.reconstruction


def test_photos_overlap_by_the_points_they_have_in_common(model: pycolmap.Reconstruction) -> None:
    points = [{point.point3D_id for point in model.image(i).get_observation_points2D()} for i in model.reg_image_ids()]
    common = [[len(a & b) for b in points] for a in points]
    np.testing.assert_array_equal(overlaps_in(model).toarray(), common)
    assert np.count_nonzero(common) < 20**2


def test_each_photo_sees_its_observations_where_they_are(model: pycolmap.Reconstruction) -> None:
    for image in model.images.values():
        ids, xy = seen_in(image)
        points = image.get_observation_points2D()
        np.testing.assert_array_equal(ids, [point.point3D_id for point in points])
        np.testing.assert_array_equal(xy, [point.xy for point in points])


def test_a_photo_that_sees_nothing_overlaps_with_none(model: pycolmap.Reconstruction) -> None:
    blind = min(model.reg_image_ids())
    for index in model.image(blind).get_observation_point2D_idxs():
        model.delete_observation(blind, index)
    ids, xy = seen_in(model.image(blind))
    assert ids.shape == (0,)
    assert xy.shape == (0, 2)
    assert not overlaps_in(model)[[list(model.reg_image_ids()).index(blind)]].count_nonzero()

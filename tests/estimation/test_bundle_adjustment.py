"""Points of the photos that take no part in the bundle adjustment."""

from __future__ import annotations

from functools import cache

import numpy as np
import pycolmap
import pytest
from tests.simulated.model import synthetic_model
from tests.simulated.path import along, orbit_path

from rangesfm.errors import SolverError
from rangesfm.options import CameraOptions, RefineOptions
from rangesfm.solver.bundle_adjustment import (
    bundle_adjustment,
)


def orbit() -> pycolmap.Reconstruction:
    return pycolmap.Reconstruction(_orbit())


@cache
def _orbit() -> pycolmap.Reconstruction:
    photos = along(orbit_path(8.0), np.arange(6.0))
    return synthetic_model(*photos, num_observations=20, pixel_stddev=1.0).reconstruction


def test_points_that_are_left_out_take_no_part_and_stay_in_the_model() -> None:
    model = orbit()
    before = {point_id: (point.xyz.copy(), point.track.length()) for point_id, point in model.points3D.items()}
    num_seen = {image_id: image.num_points3D for image_id, image in model.images.items()}
    left_out = sorted(before)[2:5]
    bundle = bundle_adjustment(model, CameraOptions(), RefineOptions(), num_threads=1, left_out_ids=left_out)
    problem = bundle.adjuster.problem
    takes_part = {point_id for point_id, point in model.points3D.items() if problem.has_parameter_block(point.xyz)}
    assert takes_part == before.keys() - set(left_out)
    assert problem.num_residuals() == 2 * sum(num for point_id, (_, num) in before.items() if point_id in takes_part)
    assert {image_id: image.num_points3D for image_id, image in model.images.items()} == num_seen
    for point_id, (xyz, length) in before.items():
        point = model.point3D(point_id)
        np.testing.assert_array_equal(point.xyz, xyz)
        assert point.track.length() == length
        for element in point.track.elements:
            assert model.image(element.image_id).point2D(element.point2D_idx).point3D_id == point_id


def test_a_model_without_points_that_take_part_is_refused() -> None:
    model = orbit()
    with pytest.raises(SolverError, match="no point of the model takes part in the bundle adjustment"):
        bundle_adjustment(model, CameraOptions(), RefineOptions(), num_threads=1, left_out_ids=list(model.points3D))

"""Points that photos see, and parts of a model that share hardly any points."""

from __future__ import annotations

import numpy as np
import pycolmap
import pytest
from tests.simulated.model import synthetic_model
from tests.simulated.path import along, sequence_path
from tests.simulated.pieces import leave_across, points_across

from rangesfm.colmap.pieces import MIN_NUM_SHARED, frames_of_parts, loose_pieces, overlaps_in, seen_in

NUM_PHOTOS = 30
SECOND = tuple(f"frame_{k:05d}.jpg" for k in range(19, NUM_PHOTOS + 1))


@pytest.fixture
def model() -> pycolmap.Reconstruction:
    """A chain of photos, each of which shares points with the next three only."""
    times = np.arange(float(NUM_PHOTOS))
    path = sequence_path(float(NUM_PHOTOS), seed=1)
    walk = synthetic_model(*along(path, times), num_observations=80, max_track_length=4)
    return walk.reconstruction


def with_neck(model: pycolmap.Reconstruction, num_points: int) -> pycolmap.Reconstruction:
    """Return the model with only so many points seen on both sides of the gap."""
    cut = pycolmap.Reconstruction(model)
    leave_across(cut, SECOND, num_points)
    return cut


def test_a_chain_of_photos_that_share_points_is_one_piece(model: pycolmap.Reconstruction) -> None:
    assert len(points_across(model, SECOND)) > 2 * MIN_NUM_SHARED
    assert loose_pieces(model) == ()


@pytest.mark.parametrize("num_points", [0, 4, MIN_NUM_SHARED - 1])
def test_a_neck_of_few_points_leaves_two_pieces(model: pycolmap.Reconstruction, num_points: int) -> None:
    (piece,) = loose_pieces(with_neck(model, num_points))
    assert piece.num_shared == num_points
    assert piece.image_names == SECOND


def test_enough_points_in_a_neck_hold_the_model_together(model: pycolmap.Reconstruction) -> None:
    assert loose_pieces(with_neck(model, MIN_NUM_SHARED)) == ()


def test_a_model_without_points_and_a_photo_that_sees_nothing_are_no_pieces(model: pycolmap.Reconstruction) -> None:
    assert loose_pieces(pycolmap.Reconstruction()) == ()
    for point_id in [point_id for point_id, p in model.points3D.items() if p.track.elements[0].image_id == 1]:
        model.delete_point3D(point_id)
    assert loose_pieces(model) == ()


@pytest.mark.parametrize("num_points", [0, 1, MIN_NUM_SHARED - 1, MIN_NUM_SHARED])
def test_a_photo_that_shares_few_points_is_no_piece_and_hangs_loose(
    model: pycolmap.Reconstruction, num_points: int
) -> None:
    leave_across(model, SECOND[-1:], num_points)
    assert loose_pieces(model) == ()
    is_held = num_points == MIN_NUM_SHARED
    largest, *others = frames_of_parts(model)
    np.testing.assert_array_equal(largest, np.arange(1, NUM_PHOTOS + is_held))
    assert [each.tolist() for each in others] == ([] if is_held else [[NUM_PHOTOS]])


def test_parts_come_in_the_order_of_their_sizes(model: pycolmap.Reconstruction) -> None:
    first, second = frames_of_parts(with_neck(model, 4))
    assert (len(first), len(second)) == (NUM_PHOTOS - len(SECOND), len(SECOND))


def test_photos_alone_belong_to_the_largest_part_of_a_map_of_few_points(model: pycolmap.Reconstruction) -> None:
    for point_id in [i for i, p in model.points3D.items() if p.track.elements[0].image_id > NUM_PHOTOS / 3]:
        model.delete_point3D(point_id)
    (whole,) = frames_of_parts(model)
    np.testing.assert_array_equal(whole, np.arange(1, NUM_PHOTOS + 1))
    for point_id in list(model.points3D):
        model.delete_point3D(point_id)
    (whole,) = frames_of_parts(model)
    np.testing.assert_array_equal(whole, np.arange(1, NUM_PHOTOS + 1))
    assert frames_of_parts(pycolmap.Reconstruction()) == ()


def test_photos_overlap_by_the_points_they_have_in_common(model: pycolmap.Reconstruction) -> None:
    points = [{point.point3D_id for point in model.image(i).get_observation_points2D()} for i in model.reg_image_ids()]
    common = [[len(a & b) for b in points] for a in points]
    np.testing.assert_array_equal(overlaps_in(model).toarray(), common)
    assert np.count_nonzero(common) < len(points) ** 2


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

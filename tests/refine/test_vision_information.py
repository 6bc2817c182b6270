"""A point that wrong matches put into a camera, or next to it, is distinguished from one that is only near."""

from __future__ import annotations

import numpy as np
import pycolmap
import pytest
from tests.simulated.model import SyntheticModel

from rangesfm.colmap.transform import rescale
from rangesfm.geometry.similarity import Similarity
from rangesfm.refine.vision_information import _pieces, misplaced_points, model_observations, model_poses


def misplaced_ids(model: pycolmap.Reconstruction) -> list[int]:
    frame_ids = np.array(sorted(model.reg_frame_ids()))
    rays = model_observations(model, frame_ids)
    found: list[int] = rays.point_ids[misplaced_points(rays, model_poses(model, frame_ids))].tolist()
    return found


def put_to_depth(model: pycolmap.Reconstruction, depth: float) -> int:
    """Move a point on the ray of one of the photos that see it, and return its id."""
    point_id = min(model.points3D)
    point = model.point3D(point_id)
    image = model.image(point.track.elements[0].image_id)
    in_cam = image.cam_from_world() * point.xyz
    point.xyz = image.cam_from_world().inverse() * (in_cam * depth / in_cam[2])
    return int(point_id)


@pytest.mark.parametrize(
    ("depth_m", "is_misplaced"),
    [(-1.0, True), (0.0, True), (1e-10, True), (1e-4, True), (0.05, True), (1.5, False), (1e8, False)],
)
@pytest.mark.parametrize("scale", [1.0, 1e-3])
def test_it_is_found_by_its_depth_whatever_the_unit(
    chain: SyntheticModel, depth_m: float, is_misplaced: bool, scale: float
) -> None:
    model = chain.reconstruction
    assert misplaced_ids(model) == []
    point_id = put_to_depth(model, depth_m)
    elsewhere = rescale(model, Similarity(scale, np.eye(3), np.array([3.0, -2.0, 5.0])))
    assert misplaced_ids(elsewhere) == ([point_id] if is_misplaced else [])


def test_a_track_is_one_piece_a_long_one_overlapping_pieces_of_eight() -> None:
    lengths = np.arange(1, 21)
    point = np.repeat(np.arange(len(lengths)), lengths)
    of_track: dict[int, list[list[int]]] = {int(length): [] for length in lengths}
    for size, rows in _pieces(point).items():
        for piece in rows.tolist():
            assert len(piece) == size
            first = int(np.searchsorted(point, point[piece[0]]))
            of_track[int(lengths[point[piece[0]]])].append([row - first for row in piece])
    assert of_track[1] == []
    assert all(of_track[length] == [list(range(length))] for length in range(2, 9))
    assert of_track[9] == [list(range(8)), list(range(1, 9))]
    assert of_track[16] == [list(range(start, start + 8)) for start in (0, 4, 8)]
    assert of_track[18] == [list(range(start, start + 8)) for start in (0, 4, 8, 10)]

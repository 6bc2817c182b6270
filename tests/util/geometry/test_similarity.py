"""Similarities, and the shape of paths."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rangesfm.util.geometry.similarity import (
    IDENTITY,
    Similarity,
    align_points,
    are_apart,
    oriented,
    path_kind,
    path_shape,
    round_middle,
    similarity_between,
)
from rangesfm.util.geometry.trajectory import Trajectory


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)


def random_similarity(rng: np.random.Generator, scale: float) -> Similarity:
    return Similarity(scale, Rotation.from_quat(rng.normal(size=4)).as_matrix(), 10 * rng.normal(size=3))


def assert_equal(first: Similarity, second: Similarity) -> None:
    assert first.scale == pytest.approx(second.scale, rel=1e-12)
    np.testing.assert_allclose(first.rotation, second.rotation, atol=1e-12)
    np.testing.assert_allclose(first.translation, second.translation, rtol=1e-9, atol=1e-9)


def test_applying_a_product_is_applying_its_factors_from_the_right(rng: np.random.Generator) -> None:
    a_from_b, b_from_c = random_similarity(rng, 3.0), random_similarity(rng, 0.2)
    in_c = rng.normal(size=(5, 3))
    np.testing.assert_allclose((a_from_b @ b_from_c).apply(in_c), a_from_b.apply(b_from_c.apply(in_c)), atol=1e-12)


def test_the_inverse_undoes(rng: np.random.Generator) -> None:
    similarity = random_similarity(rng, 7.0)
    assert_equal(similarity @ similarity.inverse(), IDENTITY)
    assert_equal(similarity.inverse() @ similarity, IDENTITY)


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
def test_alignment_recovers_a_similarity(rng: np.random.Generator, scale: float) -> None:
    truth = random_similarity(rng, scale)
    source = rng.normal(size=(6, 3))
    assert_equal(align_points(source, truth.apply(source)), truth)


def test_alignment_of_points_in_a_plane_is_unique(rng: np.random.Generator) -> None:
    truth = random_similarity(rng, 2.0)
    source = rng.normal(size=(6, 3)) * [1.0, 1.0, 0.0]
    assert_equal(align_points(source, truth.apply(source)), truth)


def test_alignment_never_mirrors(rng: np.random.Generator) -> None:
    source = rng.normal(size=(6, 3))
    found = align_points(source, source * [1.0, 1.0, -1.0])
    assert np.linalg.det(found.rotation) == pytest.approx(1.0)


def test_rigid_alignment_keeps_the_scale_at_one(rng: np.random.Generator) -> None:
    truth = random_similarity(rng, 1.0)
    source = rng.normal(size=(6, 3))
    grown = 1.1 * (source - source.mean(axis=0)) + source.mean(axis=0)
    assert_equal(align_points(grown, truth.apply(source), with_scale=False), truth)


def test_path_shape_tells_how_long_wide_and_high_a_path_is(rng: np.random.Generator) -> None:
    # For the corners of a box, the stddevs are half its edges.
    corners = np.array([(x, y, z) for x in (-3.0, 3.0) for y in (-2.0, 2.0) for z in (-1.0, 1.0)])
    rotation = random_similarity(rng, 1.0).rotation
    shape = path_shape(corners @ rotation.T + 5.0)
    np.testing.assert_allclose(shape.centroid, 5.0, atol=1e-12)
    np.testing.assert_allclose(shape.stddevs, [3.0, 2.0, 1.0], atol=1e-12)
    np.testing.assert_allclose(np.abs(shape.axes.T @ rotation), np.eye(3), atol=1e-12)


def test_a_moved_trajectory_sees_the_same_points(rng: np.random.Generator) -> None:
    truth = random_similarity(rng, 3.0)
    world_from_cam = Rotation.from_quat(rng.normal(size=(4, 4))).as_matrix()
    path = Trajectory(np.arange(4), ("a", "b", "c", "d"), None, rng.normal(size=(4, 3)), world_from_cam)
    moved = path.transformed(truth)
    point = rng.normal(size=3)
    in_cam = np.einsum("nji,nj->ni", path.world_from_cam, point - path.centers)
    still_in_cam = np.einsum("nji,nj->ni", moved.world_from_cam, truth.apply(point) - moved.centers)
    np.testing.assert_allclose(still_in_cam, truth.scale * in_cam, atol=1e-9)


ANGLES = np.linspace(0.0, 2 * np.pi, 50)
CIRCLE = np.stack([np.cos(ANGLES), np.sin(ANGLES), 0 * ANGLES], axis=1)
UP_AND_DOWN = np.stack([np.cos(ANGLES), np.sin(ANGLES), 0.6 * np.sin(2 * ANGLES)], axis=1)
KINDS = {
    "straight": np.stack([ANGLES, 0.02 * np.sin(ANGLES), 0 * ANGLES], axis=1),
    "circular": CIRCLE,
    "flat": CIRCLE * [2.0, 1.0, 1.0],
    "spherical": UP_AND_DOWN / np.linalg.norm(UP_AND_DOWN, axis=1, keepdims=True),
    "general": UP_AND_DOWN * [2.0, 1.0, 1.0],
}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("scale", [1e-3, 1e3])
def test_the_kind_of_a_path_is_told_in_any_place_and_unit(rng: np.random.Generator, kind: str, scale: float) -> None:
    assert path_kind(random_similarity(rng, scale).apply(KINDS[kind])) == kind


def test_the_middle_of_a_circle_and_of_a_sphere_is_found(rng: np.random.Generator) -> None:
    moved = random_similarity(rng, 3.0)
    for kind in ("circular", "spherical"):
        middle, radius = round_middle(moved.apply(KINDS[kind]))
        np.testing.assert_allclose(middle, moved.translation, atol=1e-6)
        assert radius == pytest.approx(3.0)


ONE_PLACE = np.tile([0.1, -7.3, 1.6], (7, 1))
"""Seven times the same point; rounding makes their mean differ from it."""


def test_points_that_only_rounding_parts_are_one_place(rng: np.random.Generator) -> None:
    shaken = ONE_PLACE + rng.choice(np.array([-1e-15, 0.0, 1e-15]), (7, 3))
    for one_place in (ONE_PLACE, shaken, 1e7 * shaken):
        assert not are_apart(one_place)
        assert align_points(one_place, rng.normal(size=(7, 3))).scale == 1.0
        assert similarity_between(one_place, rng.normal(size=(7, 3))) is None
        assert similarity_between(rng.normal(size=(7, 3)), one_place) is None
    assert are_apart(ONE_PLACE + 1e-9 * rng.normal(size=(7, 3)))


def test_points_without_anything_alike_have_no_scale_between_them() -> None:
    there_and_back, left_and_right = np.zeros((8, 3)), np.zeros((8, 3))
    there_and_back[:, 0], left_and_right[:, 0] = 0.1 * np.tile([-1, 1], 4), 0.1 * np.repeat([-1, 1], 4)
    assert similarity_between(there_and_back, left_and_right + 0.3) is None


def test_an_axis_points_to_the_same_side_whatever_a_decomposition_says(rng: np.random.Generator) -> None:
    for _ in range(20):
        axes = random_similarity(rng, 1.0).rotation
        np.testing.assert_array_equal(oriented(axes), oriented(-axes))
        np.testing.assert_array_equal(np.abs(oriented(axes)), np.abs(axes))
    flat = rng.normal(size=(20, 3)) * [3.0, 1.0, 0.0]
    for turned in (flat, -flat, flat[::-1] + 1e-14):
        np.testing.assert_allclose(path_shape(turned).axes[:, 2], [0.0, 0.0, 1.0], atol=1e-9)

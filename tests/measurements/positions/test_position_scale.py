"""The similarity by known positions: its robust fit, the errors to expect, and control points that contradict it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation
from tests.simulated.positions_at_origin import known_positions

from rangesfm.errors import GeometryError
from rangesfm.measurements.positions.known_positions import KnownPositions
from rangesfm.measurements.positions.position_fit import design_of_positions, determine
from rangesfm.measurements.positions.position_scale import (
    PositionScale,
    _doubts_of_axes,
    refuse_open_turn,
    scale_by_positions,
)
from rangesfm.solver.bending import WalkBending
from rangesfm.util.geometry.similarity import Similarity
from rangesfm.util.geometry.trajectory import Trajectory, moved_similarity

Array = npt.NDArray[np.float64]

TURN = Rotation.from_rotvec([0.3, -0.5, 1.1]).as_matrix()
SITE_FROM_MODEL = Similarity(2.0, TURN, np.array([10.0, -4.0, 1.0]))


def path() -> Trajectory:
    """Three poses; the first is not at the origin of the model and not along its axes."""
    rotations = Rotation.from_rotvec([[0.2, 0.1, -0.4], [0.0, 0.0, 0.3], [0.5, 0.0, 0.0]]).as_matrix()
    centers = np.array([[1.0, 0.5, -0.3], [2.0, 0.0, 0.0], [3.0, 1.0, 0.5]])
    return Trajectory(np.arange(3), ("a", "b", "c"), np.arange(3.0), centers, rotations)


def survey(is_mark: list[bool], noise_m: float = 0.0, stddev_m: float = 0.1, seed: int = 0) -> KnownPositions:
    """Positions in a model of some metres, the antenna's with lever arms."""
    rng, positions = np.random.default_rng(seed), known_positions(is_mark, 3, stddev_m)
    arms_m = np.where(positions.is_mark[:, None], 0.0, 0.5 * rng.standard_normal((len(is_mark), 3)))
    placed = replace(positions, places=3.0 * rng.standard_normal((len(is_mark), 3)), arms_m=arms_m)
    return replace(
        placed, position_m=placed.predicted_m(SITE_FROM_MODEL) + noise_m * rng.standard_normal((len(is_mark), 3))
    )


def finite_differences(positions: KnownPositions) -> Array:
    """(3 k, 7) changes of the positions by a step from the true similarity, per unit of each number."""
    steps = 1e-6 * np.eye(7)

    def at(step: Array) -> Array:
        return positions.predicted_m(moved_similarity(SITE_FROM_MODEL, step, path())).ravel()

    return np.stack([(at(each) - at(-each)) / 2e-6 for each in steps], axis=1)


def assert_same(found: Similarity, expected: Similarity, atol: float = 1e-8) -> None:
    assert found.scale == pytest.approx(expected.scale, rel=atol)
    np.testing.assert_allclose(found.rotation, expected.rotation, atol=atol)
    np.testing.assert_allclose(found.translation, expected.translation, atol=atol)


def test_the_design_is_the_finite_difference_and_lever_arms_do_not_scale() -> None:
    positions = survey([True, False, True, False])
    np.testing.assert_allclose(
        design_of_positions(positions, SITE_FROM_MODEL, path()), finite_differences(positions), atol=1e-7
    )


def test_without_errors_the_similarity_is_exact_and_all_count() -> None:
    positions = survey([True, True, False, False, True])
    used = np.arange(5) != 4
    wrong = replace(positions, position_m=positions.position_m + np.where(used, 0.0, 100.0)[:, None])
    fit = scale_by_positions(PositionScale.begun(replace(wrong, is_check=~used), WalkBending(path())))
    assert_same(fit.similarity, SITE_FROM_MODEL)
    np.testing.assert_allclose(fit.weights, [1.0, 1.0, 1.0, 1.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(fit.stddev_m, 0.1)


def test_three_positions_off_a_line_determine_a_similarity() -> None:
    places = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [2.0, 0.0, 0.0], [1.0, 1.0, 0.0]])
    positions = replace(known_positions([True] * 4), places=places)
    assert determine(positions, np.array([True, False, True, True]))
    assert not determine(positions, np.array([True, False, False, True]))
    assert not determine(positions, np.array([True, True, True, False]))
    # The extents across and along are 1 / sqrt(3) and sqrt(2 / 3) of the lengths in a lean triangle.
    for across, is_enough in ((1.8e-7, True), (1.6e-7, False)):
        lean = replace(positions, places=places + across * np.array([[0.0], [1.0], [0.0], [0.0]]) * [0.0, 1.0, 0.0])
        assert determine(lean, np.array([True, True, True, False])) is is_enough


def test_too_few_positions_are_refused_with_their_number() -> None:
    positions = replace(survey([True] * 4), is_check=np.array([False, True, True, False]))
    with pytest.raises(GeometryError, match=r"^2 known positions are in the map, expected 3 or more that are not on"):
        scale_by_positions(PositionScale.begun(positions, WalkBending(path())))
    scale_by_positions(PositionScale.begun(replace(positions, is_check=np.arange(4) == 1), WalkBending(path())))


@pytest.mark.parametrize("row", [1, 2, 3])
def test_a_turn_that_stays_open_is_refused_in_degrees(row: int) -> None:
    covariance = np.diag([9.0, 0.01, 0.01, 0.01, 9.0, 9.0, 9.0])
    covariance[row, row] = 0.295**2
    refuse_open_turn(covariance)
    covariance[row, row] = 0.305**2
    with pytest.raises(GeometryError, match=r"\(17 degrees, 1 stddev\): survey a point off that line"):
        refuse_open_turn(covariance)


@pytest.mark.parametrize("is_mark", [[True] * 8, [False] * 30])
def test_exchanged_axes_are_named(is_mark: list[bool]) -> None:
    positions = survey(is_mark, noise_m=0.02)
    assert not [*_doubts_of_axes(positions)]
    exchanged = replace(positions, position_m=positions.position_m[:, [1, 0, 2]])
    (doubt,) = _doubts_of_axes(exchanged)
    assert doubt.reason.endswith("two axes are exchanged, or heights count downwards")


def test_the_mirror_image_of_positions_in_a_plane_is_not_named() -> None:
    positions = survey([True] * 8)
    flat = replace(positions, places=positions.places * [1, 1, 0])
    moved = flat.predicted_m(SITE_FROM_MODEL) + 0.02 * np.random.default_rng(1).standard_normal((8, 3))
    assert not [*_doubts_of_axes(replace(flat, position_m=moved))]

"""Groups of known positions, the sizes of their errors, and the mistakes in them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from scipy.sparse import csr_array

from rangesfm.arrays import Mask
from rangesfm.positions.known_positions import KnownPositions
from rangesfm.ranging.errors.bending import ErrorPart
from rangesfm.scale.linear_map import LinearMap
from rangesfm.scale.position_equations import (
    PositionEquations,
    at_point,
    covariance_of_groups,
    errors_of_sizes,
    grouped_by_time,
    learnt_sizes,
    times_of_groups,
)
from rangesfm.scale.range_equation import Columns

Array = npt.NDArray[np.float64]

NOTHING = np.zeros(0, dtype=np.int64)


def known_positions(is_mark: list[bool], num_poses: int = 1, stddev_m: float = 0.1) -> KnownPositions:
    """Positions at the origin of the site and of the model, without arms; the antenna's are a second apart."""
    k, marks = len(is_mark), np.array(is_mark)
    return KnownPositions(
        names=tuple(f"P{row}" for row in range(k)),
        is_mark=marks,
        is_check=np.zeros(k, dtype=bool),
        position_m=np.zeros((k, 3)),
        covariance_m2=np.tile(stddev_m**2 * np.eye(3), (k, 1, 1)),
        is_stated=np.ones(k, dtype=bool),
        is_geodetic=np.zeros(k, dtype=bool),
        places=np.zeros((k, 3)),
        arms_m=np.zeros((k, 3)),
        own_covariance=np.zeros((k, 3, 3)),
        arm_stddev_m=np.zeros(k),
        time_s=np.where(marks, np.nan, np.arange(k)),
        clock_stddev_s=np.zeros(k),
        velocity=np.zeros((k, 3)),
        world_from_cam=np.zeros((k, 3, 3)),
        by_pose=csr_array((3 * k, 6 * num_poses)),
        arms_by_pose=csr_array((3 * k, 6 * num_poses)),
        on_path=np.full((k, 2), -1, dtype=np.int64),
        fraction=np.zeros(k),
        from_line=np.zeros((k, 3)),
    )


def linear_map(residual_m: Array, design: Array, prior_design: Array | None = None) -> LinearMap:
    priors = np.zeros((0, design.shape[1])) if prior_design is None else prior_design
    return LinearMap(residual_m, design, np.zeros(len(priors)), priors, Columns(0, 1, NOTHING, NOTHING, 7))


def of_positions(grouping: csr_array) -> Array:
    """The weights of whole positions, which are the same in each of the three coordinates and mix none of them."""
    dense: Array = grouping.toarray()
    for axis in range(3):
        np.testing.assert_array_equal(dense[axis::3, axis::3], dense[::3, ::3])
        np.testing.assert_array_equal(dense[axis::3, (axis + 1) % 3 :: 3], 0.0)
        np.testing.assert_array_equal(dense[axis::3, (axis + 2) % 3 :: 3], 0.0)
    return dense[::3, ::3]


def test_each_mark_is_a_group_of_its_own_before_the_positions_in_the_order_of_their_times() -> None:
    positions = replace(
        known_positions([False, True, False, True, False]), time_s=np.array([9.0, np.nan, 5.0, np.nan, 7.0])
    )
    # The weight of a mark has no say: it stays even if it is 0.
    found = of_positions(grouped_by_time(positions, np.array([1.0, 0.5, 0.3, 0.0, 0.7])))
    np.testing.assert_array_equal(np.argmax(found, axis=1), [1, 3, 2, 4, 0])
    np.testing.assert_allclose(found.sum(axis=1), 1.0)
    assert np.count_nonzero(found) == 5


def test_positions_of_which_one_has_no_time_stay_in_their_order() -> None:
    positions = replace(known_positions([False, False, False]), time_s=np.array([9.0, np.nan, 5.0]))
    np.testing.assert_array_equal(of_positions(grouped_by_time(positions, np.ones(3))), np.eye(3))


def test_outlying_positions_are_in_no_group_and_marks_alone_have_no_others() -> None:
    positions = known_positions([False, False, False, True])
    found = of_positions(grouped_by_time(positions, np.array([0.0999, 0.1, 1.0, 1.0])))
    np.testing.assert_array_equal(np.argmax(found, axis=1), [3, 1, 2])
    none = of_positions(grouped_by_time(positions, np.array([0.0, 0.0, 0.0, 1.0])))
    np.testing.assert_array_equal(none, [[0.0, 0.0, 0.0, 1.0]])


def test_more_than_150_positions_are_averaged_by_their_weights() -> None:
    at_most = of_positions(grouped_by_time(known_positions([False] * 150), np.ones(150)))
    np.testing.assert_array_equal(at_most, np.eye(150))
    weights = np.where(np.arange(152) == 0, 0.25, 0.75)
    found = of_positions(grouped_by_time(known_positions([False] * 152), weights))
    assert found.shape == (150, 152)
    np.testing.assert_allclose(found.sum(axis=1), 1.0)
    np.testing.assert_allclose(found[0, :3], [0.25, 0.75, 0.0])
    np.testing.assert_allclose(found[1, :5], [0.0, 0.0, 0.5, 0.5, 0.0])
    np.testing.assert_array_equal(found[2:], np.eye(150, 152, 2)[2:])


def test_the_times_of_a_group_go_from_its_first_to_its_last_and_marks_have_none() -> None:
    positions = replace(known_positions([True, False, False, False]), time_s=np.array([np.nan, 20.0, 27.0, 3.0]))
    shares = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 0.25, 0.75, 0.0], [0.0, 0.0, 0.0, 1.0]])
    grouping = csr_array(np.kron(shares, np.eye(3)))
    sizes, times = times_of_groups(grouping, positions, np.array([9.0, 0.2, 0.4, 0.5]), np.array([1, 2, 3]))
    np.testing.assert_allclose(sizes, [0.0, 0.35, 0.5])
    np.testing.assert_allclose(times, [np.zeros(8), np.arange(20.0, 28.0), np.full(8, 3.0)])


def test_groups_average_independent_errors_of_the_chosen_rows_only() -> None:
    rng = np.random.default_rng(2)
    roots = rng.standard_normal((3, 3, 3))
    covariances = roots @ roots.transpose(0, 2, 1)
    grouping = csr_array(np.kron([[1.0, 0.0, 0.0], [0.0, 0.25, 0.75]], np.eye(3)))
    found = covariance_of_groups(grouping, covariances, np.array([True, True, True]))
    np.testing.assert_allclose(found[:3, :3], covariances[0])
    np.testing.assert_allclose(found[3:, 3:], covariances[1] / 16 + 9 * covariances[2] / 16)
    np.testing.assert_array_equal(found[:3, 3:], 0.0)
    some = covariance_of_groups(grouping, covariances, np.array([False, True, False]))
    np.testing.assert_array_equal(some[:3, :3], 0.0)
    np.testing.assert_allclose(some[3:, 3:], covariances[1] / 16)


NUM = 120


def test_sizes_that_are_known_are_not_learnt() -> None:
    parts = [ErrorPart("marks", np.eye(4)), ErrorPart("points", 2 * np.eye(4), median_m=0.3)]
    found = learnt_sizes(parts, linear_map(np.full(4, 50.0), np.ones((4, 1))), np.ones(4, dtype=bool))
    assert found == {"marks": 1.0, "points": 1.0}


@pytest.mark.parametrize("known_m", [0.0, 0.3])
@pytest.mark.parametrize("is_held", [False, True])
def test_the_size_of_noise_is_its_standard_deviation_beside_what_is_known(known_m: float, is_held: bool) -> None:
    """A wide prior leaves it to the residuals that take part, about their mean or about 0 if a prior holds it."""
    rng = np.random.default_rng(5)
    noise = rng.standard_normal(NUM) + 0.2
    rows = np.arange(NUM) % 3 > 0
    residual_m = np.where(rows, noise, 100.0)
    prior_design = np.array([[1e6]]) if is_held else None
    parts = [ErrorPart("points", known_m**2 * np.eye(NUM)), ErrorPart("noise", np.eye(NUM), 0.5, spread=50.0)]
    found = learnt_sizes(parts, linear_map(residual_m, np.ones((NUM, 1)), prior_design), rows)
    assert [*found] == ["points", "noise"]
    assert found["points"] == 1.0
    free = rows.sum() - (0 if is_held else 1)
    variance = np.sum((noise[rows] - (0.0 if is_held else noise[rows].mean())) ** 2) / free
    own = variance - known_m**2
    # The most likely logarithm of a size has the variance 1 / (2 free) if nothing else errs, which the mean adds.
    of_log = variance**2 / (2 * free * own**2)
    assert found["noise"] == pytest.approx(np.sqrt(own) * np.exp(of_log), rel=1e-3)


def test_a_size_that_is_nearly_known_stays_at_its_median() -> None:
    residual_m = np.random.default_rng(5).standard_normal(NUM)
    parts = [ErrorPart("noise", np.eye(NUM), 0.5, spread=1e-4)]
    found = learnt_sizes(parts, linear_map(residual_m, np.ones((NUM, 1))), np.ones(NUM, dtype=bool))
    assert found["noise"] == pytest.approx(0.5, rel=1e-4)


def test_errors_of_sizes_grow_with_the_square_of_the_size() -> None:
    alike = np.diag([1.0, 2.0, 6.0])
    errors = errors_of_sizes([ErrorPart("points", alike), ErrorPart("noise", np.eye(3))], {"noise": 0.5, "points": 2.0})
    assert errors.names == ("points", "noise")
    np.testing.assert_allclose(errors.covariances_m2, [4 * alike, 0.25 * np.eye(3)])
    np.testing.assert_allclose(errors.stddevs, [2 * np.sqrt(3.0), 0.5])


def of_three_points(residual_m: Array, is_used: Mask) -> PositionEquations:
    """Equations of three points with noise of a metre, for a shift of all along x."""
    parts, design = (ErrorPart("noise", np.eye(9)),), np.tile([[1.0], [0.0], [0.0]], (3, 1))
    errors = errors_of_sizes(parts, {"noise": 1.0})
    return PositionEquations(linear_map(residual_m, design), parts, errors, is_used, csr_array(np.eye(9)))


def test_a_mistake_of_a_point_is_what_the_others_that_take_part_say_it_is_too_large() -> None:
    """The residual is predicted minus known, so that a point that is known too high leaves a negative one."""
    residual_m = np.array([0.2, 0.0, 0.0, -0.3, 0.4, -0.7, 50.0, 60.0, 70.0])
    columns = at_point(known_positions([True] * 3), 1)
    np.testing.assert_array_equal(columns, np.vstack([np.zeros((3, 3)), np.eye(3), np.zeros((3, 3))]))
    for num_used in (6, 3):  # whether the point itself takes part does not matter
        found = of_three_points(residual_m, np.arange(9) < num_used).of_mistake(columns)
        np.testing.assert_allclose(found.sizes, [0.5, -0.4, 0.7], atol=1e-9)
        # The shift is known by the first point alone, as well as that one.
        np.testing.assert_allclose(found.stddevs, [np.sqrt(2), 1.0, 1.0], rtol=1e-6)
        assert found.statistic == pytest.approx(0.5**2 / 2 + 0.4**2 + 0.7**2)


def test_errors_are_learnt_again_as_if_the_mistake_was_made() -> None:
    """A mistake of one of many positions is not taken for noise, if that position may be wrong."""
    rng = np.random.default_rng(1)
    num = 40
    residual_m = rng.standard_normal(3 * num)
    residual_m[3:6] += 30.0
    parts = (ErrorPart("noise", np.eye(3 * num), spread=50.0),)
    design = np.tile(np.eye(3), (num, 1))
    every = np.ones(3 * num, dtype=bool)
    linear = linear_map(residual_m, design, np.zeros((1, 3)))
    sizes = learnt_sizes(parts, linear, every)
    whole = PositionEquations(linear, parts, errors_of_sizes(parts, sizes), every, csr_array(np.eye(3 * num)))
    again = whole.with_mistake_learnt(at_point(known_positions([True] * num), 1))
    others = np.delete(residual_m.reshape(-1, 3), 1, axis=0)
    expected = np.sqrt(np.sum((others - others.mean(axis=0)) ** 2) / (3 * (num - 2)))
    assert whole.errors.stddev_of_component["noise"] > 3.0
    assert again.errors.stddev_of_component["noise"] == pytest.approx(expected, rel=0.01)
    assert again.linear is whole.linear

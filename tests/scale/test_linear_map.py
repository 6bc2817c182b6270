"""Least squares with correlated errors, and how well a mistake is seen in what they leave."""

from __future__ import annotations

import warnings

import numpy as np
import numpy.typing as npt
import pytest
from scipy import stats

from rangesfm.scale.linear_map import LinearMap, Solved, noncentrality, regular
from rangesfm.scale.range_equation import Columns

Array = npt.NDArray[np.float64]

NOTHING = np.zeros(0, dtype=np.int64)
# Baarda's noncentrality of one number: the test of a risk of 0.001 finds it with a probability of 0.8.
ONE = float(stats.norm.isf(0.0005) + stats.norm.ppf(0.8)) ** 2


def correlated(num: int, rng: np.random.Generator) -> Array:
    root = rng.standard_normal((num, num))
    covariance: Array = root @ root.T + 0.5 * np.eye(num)
    return covariance


def test_the_estimate_is_that_of_generalised_least_squares_with_priors() -> None:
    rng = np.random.default_rng(0)
    covariance, design, residual = correlated(8, rng), rng.standard_normal((8, 3)), rng.standard_normal(8)
    prior_design, prior_residual = rng.standard_normal((2, 3)), rng.standard_normal(2)
    # The units of the unknowns may be as different as they like.
    units = np.array([1.0, 1e9, 1e-9])
    solved = Solved(covariance, design * units, residual, prior_design * units, prior_residual)
    information = design.T @ np.linalg.solve(covariance, design) + prior_design.T @ prior_design
    right = design.T @ np.linalg.solve(covariance, residual) + prior_design.T @ prior_residual
    step = -np.linalg.solve(information, right)
    np.testing.assert_allclose(solved.covariance * np.outer(units, units), np.linalg.inv(information), rtol=1e-8)
    np.testing.assert_allclose(solved.step * units, step, rtol=1e-8)
    left, prior_left = residual + design @ step, prior_residual + prior_design @ step
    squares = left @ np.linalg.solve(covariance, left) + prior_left @ prior_left
    assert solved.residual @ solved.residual == pytest.approx(squares, rel=1e-8)
    assert (len(solved.residual), solved.num_priors) == (10, 2)
    np.testing.assert_allclose(solved.residual[8:], prior_left, rtol=1e-7)


def test_priors_are_none_and_as_they_should_be_unless_given() -> None:
    rng = np.random.default_rng(1)
    design, residual = rng.standard_normal((6, 2)), rng.standard_normal(6)
    without = Solved(np.eye(6), design, residual)
    assert without.num_priors == 0
    np.testing.assert_allclose(without.step, -np.linalg.lstsq(design, residual, rcond=None)[0], rtol=1e-8)
    prior_design = rng.standard_normal((2, 2))
    silent, zero = (Solved(np.eye(6), design, residual, prior_design, each) for each in (None, np.zeros(2)))
    assert silent.num_priors == 2
    np.testing.assert_array_equal(silent.step, zero.step)


def test_gains_are_the_change_of_the_estimate_by_what_was_measured() -> None:
    rng = np.random.default_rng(2)
    covariance, design, residual = correlated(5, rng), rng.standard_normal((5, 2)), rng.standard_normal(5)
    prior_design, prior_residual = rng.standard_normal((3, 2)), rng.standard_normal(3)
    by_measured, by_prior = Solved(covariance, design, residual, prior_design, prior_residual).gains
    np.testing.assert_allclose(by_measured.shape + by_prior.shape, (2, 5, 2, 3))
    step = Solved(covariance, design, residual, prior_design, prior_residual).step
    for row in range(5):
        longer = Solved(covariance, design, residual - np.eye(5)[row], prior_design, prior_residual).step
        np.testing.assert_allclose(longer - step, by_measured[:, row], atol=1e-9)
    for row in range(3):
        more = Solved(covariance, design, residual, prior_design, prior_residual - np.eye(3)[row]).step
        np.testing.assert_allclose(more - step, by_prior[:, row], atol=1e-9)


def test_an_estimate_with_other_weights_has_the_variance_of_its_weighted_mean() -> None:
    """The first of two measurements of one number has a quarter of the assumed variance, and a prior half of it."""
    linear = LinearMap(
        np.zeros(2), np.ones((2, 1)), np.zeros(1), np.array([[1.0]]), Columns(0, -1, NOTHING, NOTHING, 1)
    )
    truly = np.array([[4.0, 1.0], [1.0, 9.0]])
    covariance, gains = linear.with_weights(np.diag([0.25, 1.0]), truly)
    np.testing.assert_allclose(gains, [[4 / 6, 1 / 6]], rtol=1e-9)
    expected = (16 * 4.0 + 2 * 4 * 1.0 + 9.0 + 1.0) / 36
    np.testing.assert_allclose(covariance, [[expected]], rtol=1e-9)
    np.testing.assert_allclose(linear.solved(np.diag([0.25, 1.0])).covariance, [[1 / 6]], rtol=1e-9)


def test_a_direction_that_nothing_determines_has_a_huge_variance_and_stays_where_it_is() -> None:
    rng = np.random.default_rng(3)
    design, residual = rng.standard_normal((6, 3)), rng.standard_normal(6)
    design[:, 2] = 2 * design[:, 1]
    solved = Solved(np.eye(6), design, residual)
    first, second = np.linalg.lstsq(design[:, :2], -residual, rcond=None)[0]
    assert solved.step[0] == pytest.approx(first)
    assert solved.step[1] + 2 * solved.step[2] == pytest.approx(second)
    # Both change by as many of their own units, up to rounding, to which such a direction is as open as to anything.
    assert solved.step[1] == pytest.approx(2 * solved.step[2], abs=0.05)
    sums = np.array([0.0, 1.0, 2.0])
    alone = np.linalg.inv(design[:, :2].T @ design[:, :2])
    assert sums @ solved.covariance @ sums == pytest.approx(alone[1, 1], rel=0.1)
    assert solved.covariance[1, 1] > 1e11
    assert solved.residual @ solved.residual == pytest.approx(np.sum((residual + design[:, :2] @ [first, second]) ** 2))
    design[:, 2] = 0.0
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        without_effect = Solved(np.eye(6), design, residual)
    np.testing.assert_allclose(without_effect.step, [first, second, 0.0], atol=1e-9)
    assert without_effect.covariance[2, 2] > 1e11


@pytest.mark.parametrize(("smallest", "is_explained"), [(0.95e-7, False), (1.05e-7, True)])
def test_unknowns_with_effects_too_alike_to_tell_apart_do_not_explain_their_difference(
    smallest: float, is_explained: bool
) -> None:
    """Two unit effects at a small angle have the angle over the root of two as their smaller singular value."""
    angle = np.sqrt(2) * smallest
    design = np.array([[1.0, np.cos(angle)], [0.0, np.sin(angle)], [0.0, 0.0]])
    solved = Solved(np.eye(3), design, np.array([5.0, 3.0, 2.0]))
    left = solved.residual
    assert left[2] == pytest.approx(2.0)
    assert abs(left[0]) < 1e-5
    assert left[1] == pytest.approx(0.0 if is_explained else 3.0, abs=1e-5)
    # An undetermined direction has the variance that it would have at the limit.
    apart = np.array([1.0, -1.0]) / np.sqrt(2)
    variance = apart @ solved.covariance @ apart
    assert variance == pytest.approx(max(smallest, 1e-7) ** -2, rel=1e-2)


def test_rounding_leaves_a_covariance_positive_definite() -> None:
    np.testing.assert_allclose(regular(np.diag([1.0, 3.0])) - np.diag([1.0, 3.0]), 4e-12 * np.eye(2), rtol=1e-3)
    np.linalg.cholesky(regular(np.ones((3, 3))))
    np.testing.assert_allclose(Solved(np.ones((3, 3)), np.ones((3, 1)), np.zeros(3)).covariance, [[1.0]], rtol=1e-3)


def test_the_noncentrality_is_found_with_a_probability_of_four_in_five() -> None:
    assert noncentrality(1) == pytest.approx(ONE, rel=1e-4)
    for num in (1, 2, 6):
        limit = stats.chi2.isf(0.001, num)
        assert stats.ncx2.cdf(limit, num, noncentrality(num)) == pytest.approx(0.2, rel=1e-6)


def of_mean(residual: Array) -> Solved:
    """The mean of four measurements with a standard deviation of 2."""
    return Solved(4 * np.eye(4), np.ones((4, 1)), residual)


@pytest.mark.parametrize("unit", [1.0, 1e7, -1e-7])
def test_one_wrong_measurement_is_compared_with_the_mean_of_the_others(unit: float) -> None:
    residual = np.array([3.0, 1.0, -1.0, 0.0])
    found = of_mean(residual).mistake(unit * np.array([[1.0], [0.0], [0.0], [0.0]]))
    stddev = 2 * np.sqrt(4 / 3)
    np.testing.assert_allclose(found.sizes, [3.0 / unit], rtol=1e-8)
    np.testing.assert_allclose(found.stddevs, [stddev / abs(unit)], rtol=1e-8)
    assert (found.num, found.is_seen) == (1, True)
    assert found.statistic == pytest.approx((3.0 / stddev) ** 2)
    np.testing.assert_allclose(found.by_unknowns, [[-0.25 * unit]], rtol=1e-8)
    assert found.smallest_detectable == pytest.approx(np.sqrt(ONE) * stddev / abs(unit), rel=1e-4)
    assert found.effect_on_log_scale == pytest.approx(np.sqrt(ONE) * stddev / 4, rel=1e-4)
    np.testing.assert_allclose(np.abs(found.basis[:, 0]), np.array([3.0, 1.0, 1.0, 1.0]) / np.sqrt(12), rtol=1e-8)


def test_the_worst_of_several_numbers_gives_the_smallest_detectable_mistake() -> None:
    """Two numbers with effects of different sizes on measurements of their own."""
    solved = Solved(np.eye(5), np.array([[1.0], [1.0], [0.0], [0.0], [0.0]]), np.array([0.0, 0.0, 4.0, 3.0, 9.0]))
    columns = np.zeros((5, 2))
    columns[2, 0], columns[3, 1] = 2.0, 0.5
    found = solved.mistake(columns)
    np.testing.assert_allclose(found.sizes, [2.0, 6.0])
    np.testing.assert_allclose(found.stddevs, [0.5, 2.0])
    np.testing.assert_allclose(found.root @ found.root.T, np.diag([0.25, 4.0]), atol=1e-12)
    assert found.statistic == pytest.approx(25.0)
    assert found.num == 2
    assert found.smallest_detectable == pytest.approx(2.0 * np.sqrt(noncentrality(2)))
    assert found.effect_on_log_scale == pytest.approx(0.0, abs=1e-9)
    # The first also moves the first unknown, by the difference of its measurements from their mean.
    columns[0, 0] = 2.0
    moved = solved.mistake(columns)
    np.testing.assert_allclose(moved.by_unknowns, [[-1.0, 0.0]], atol=1e-12)
    left = 1.0 + 1.0 + 4.0
    assert moved.effect_on_log_scale == pytest.approx(np.sqrt(noncentrality(2) / left))


def test_the_effect_is_that_on_the_first_unknown_alone() -> None:
    """The mistake moves only the second unknown, not the scale."""
    design = np.array([[1.0, 0.0], [1.0, 0.0], [0.0, 1.0], [0.0, 1.0]])
    found = Solved(np.eye(4), design, np.zeros(4)).mistake(np.array([[0.0], [0.0], [1.0], [0.0]]))
    np.testing.assert_allclose(found.by_unknowns, [[0.0], [-0.5]], atol=1e-12)
    assert found.effect_on_log_scale == pytest.approx(0.0, abs=1e-9)
    assert found.smallest_detectable == pytest.approx(np.sqrt(2 * ONE), rel=1e-4)


def test_a_mistake_that_the_unknowns_take_up_is_not_seen() -> None:
    residual = np.array([3.0, 1.0, -1.0, 0.0])
    for column in (np.ones((4, 1)), np.zeros((4, 1))):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            hidden = of_mean(residual).mistake(column)
        assert (hidden.num, hidden.is_seen, hidden.statistic) == (0, False, 0.0)
        np.testing.assert_array_equal(hidden.sizes, [0.0])
        np.testing.assert_array_equal(hidden.stddevs, [np.inf])
        assert hidden.smallest_detectable == hidden.effect_on_log_scale == np.inf
    both = of_mean(residual).mistake(np.array([[1.0, 1.0], [1.0, 0.0], [1.0, 0.0], [1.0, 0.0]]))
    assert (both.num, both.is_seen) == (1, False)
    np.testing.assert_allclose(both.sizes, [0.0, 3.0], atol=1e-6)
    assert both.statistic == pytest.approx(9.0 / (16 / 3))
    np.testing.assert_array_equal(both.stddevs, [np.inf, np.inf])
    assert both.smallest_detectable == both.effect_on_log_scale == np.inf


@pytest.mark.parametrize(("squared_share", "is_seen"), [(0.95e-7, False), (1.05e-7, True)])
def test_what_is_left_of_a_mistake_may_be_only_rounding(squared_share: float, is_seen: bool) -> None:
    solved = Solved(np.eye(2), np.array([[1.0], [0.0]]), np.array([0.0, 1.0]))
    column = np.array([[np.sqrt(1 - squared_share)], [np.sqrt(squared_share)]])
    assert solved.mistake(column).is_seen is is_seen


def test_a_mistake_may_be_in_a_prior() -> None:
    """A prior of 0 +- 1 and a measurement of 1 +- 2: the prior's mistake is as large as they differ."""
    solved = Solved(np.array([[4.0]]), np.array([[1.0]]), np.array([-1.0]), np.array([[1.0]]), np.array([0.0]))
    found = solved.mistake(np.zeros((1, 1)), np.array([[1.0]]))
    np.testing.assert_allclose(found.sizes, [1.0])
    np.testing.assert_allclose(found.stddevs, [np.sqrt(5.0)])
    np.testing.assert_allclose(found.by_unknowns, [[-0.8]])
    assert solved.mistake(np.ones((1, 1))).sizes[0] == pytest.approx(-1.0)  # of the measurement, with the prior right


def test_several_numbers_are_estimated_with_their_covariance() -> None:
    """They are (H'H)^-1 H'e with the covariance (H'H)^-1, for effects H on what is left of the residuals e."""
    rng = np.random.default_rng(6)
    covariance, design, residual = correlated(8, rng), rng.standard_normal((8, 2)), rng.standard_normal(8)
    columns = rng.standard_normal((8, 3)) * [1.0, 20.0, 0.1]
    found = Solved(covariance, design, residual).mistake(columns)
    both = np.hstack([design, columns])
    information = both.T @ np.linalg.solve(covariance, both)
    joint = np.linalg.inv(information)
    np.testing.assert_allclose(found.sizes, (joint @ both.T @ np.linalg.solve(covariance, residual))[2:], rtol=1e-7)
    np.testing.assert_allclose(found.stddevs, np.sqrt(np.diag(joint)[2:]), rtol=1e-7)
    np.testing.assert_allclose(found.root @ found.root.T, joint[2:, 2:], rtol=1e-7)
    assert found.statistic == pytest.approx(found.sizes @ np.linalg.solve(joint[2:, 2:], found.sizes), rel=1e-7)

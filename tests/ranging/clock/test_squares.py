"""The linear fit of squared ranges to a path finds scale, slopes and weights without any start."""

from __future__ import annotations

import numpy as np
import pytest

from rangesfm.arrays import Array, Indices
from rangesfm.ranging.clock.squares import SquaresFit, _LinearColumns, fit_squares, residual_stddev
from rangesfm.ranging.errors.robust_loss import CAUCHY

ANCHORS_M = np.array([[4.0, -3.0, 2.0], [-5.0, 1.0, 1.0]])
SCALE = 0.7


def a_path(num: int = 40, seed: int = 0) -> tuple[Array, Indices]:
    """Return scattered places far from the origin, model units, and the anchor of the range at each."""
    rng = np.random.default_rng(seed)
    return np.array([30.0, -20.0, 5.0]) + 3 * rng.normal(size=(num, 3)), np.arange(num) % 2


def distances_m(points: Array, anchor: Indices) -> Array:
    """Return the ranges to the anchors, which stand around the place (30, -20, 5) of the path."""
    return np.asarray(np.linalg.norm(SCALE * (points - [30, -20, 5]) - ANCHORS_M[anchor], axis=1))


def slopes_of(points: Array, anchor: Indices) -> Array:
    """Return the derivatives of the ranges by the points: the scale times the direction from the anchor."""
    away = SCALE * (points - [30, -20, 5]) - ANCHORS_M[anchor]
    return np.asarray(SCALE * away / np.linalg.norm(away, axis=1)[:, None])


def plain_columns(points: Array, range_m: Array, anchor: Indices) -> Array:
    """Return the columns of all unknowns, in metres of range: |p|^2, and p and 1 for each anchor."""
    places = np.column_stack([points - points.mean(axis=0), np.ones(len(points))])
    of_anchors = [np.where((anchor == one)[:, None], places, 0.0) for one in np.unique(anchor)]
    columns = np.column_stack([np.sum(places[:, :3] ** 2, axis=1), *of_anchors])
    return np.asarray(columns / (2 * np.maximum(range_m, 0.3))[:, None])


def refitted(points: Array, range_m: Array, anchor: Indices, width: float) -> tuple[Array, Array, float]:
    """Return residuals, weights and scale of Cauchy's loss, by many rounds of a plain weighted least-squares fit."""
    columns, values = plain_columns(points, range_m, anchor), range_m**2 / (2 * np.maximum(range_m, 0.3))
    weights = np.ones(len(points))
    for _ in range(100):
        roots = np.sqrt(weights)
        unknowns = np.linalg.lstsq(roots[:, None] * columns, roots * values, rcond=None)[0]
        residuals = values - columns @ unknowns
        size = 1.4826022 * np.median(np.abs(residuals))
        weights = 1 / (1 + (residuals / (width * size)) ** 2)
    return residuals, weights, float(np.sqrt(unknowns[0]))


def noisy_fit(size_m: float, seed: int = 1, width: float = CAUCHY.width) -> tuple[Array, Array, Indices, SquaresFit]:
    points, anchor = a_path(200)
    range_m = distances_m(points, anchor) + size_m * np.random.default_rng(seed).normal(size=len(points))
    return points, range_m, anchor, fit_squares(points, range_m, anchor, width)


def test_exact_ranges_give_the_scale_and_the_slopes_and_leave_nothing() -> None:
    points, anchor = a_path()
    fit = fit_squares(points, distances_m(points, anchor), anchor)
    assert fit.scale == pytest.approx(SCALE, rel=1e-9)
    np.testing.assert_allclose(fit.residuals_m, 0.0, atol=1e-10)
    np.testing.assert_allclose(fit.weights, 1.0)
    np.testing.assert_allclose(fit.gradient, slopes_of(points, anchor), atol=1e-9)
    assert fit.num_unknowns == 9


def test_a_range_of_a_metre_too_much_gets_hardly_any_weight_and_spoils_nothing() -> None:
    points, anchor = a_path()
    range_m = distances_m(points, anchor)
    true_m = range_m[7]
    range_m[7] += 1.0
    fit = fit_squares(points, range_m, anchor)
    assert fit.weights[7] < 1e-4
    assert fit.scale == pytest.approx(SCALE, rel=1e-4)
    # The residual is that of the square, over twice the range.
    assert fit.residuals_m[7] == pytest.approx((range_m[7] ** 2 - true_m**2) / (2 * range_m[7]), rel=1e-3)
    np.testing.assert_allclose(np.delete(fit.residuals_m, 7), 0.0, atol=1e-3)
    assert fit.weighted_residuals[7] == pytest.approx(np.sqrt(fit.weights[7]) * fit.residuals_m[7])


@pytest.mark.parametrize("width", [CAUCHY.width, 5.0])
def test_noisy_ranges_are_fitted_as_by_many_rounds_of_a_plain_robust_fit(width: float) -> None:
    points, range_m, anchor, fit = noisy_fit(0.1, width=width)
    residuals, weights, scale = refitted(points, range_m, anchor, width)
    np.testing.assert_allclose(fit.residuals_m, residuals, atol=1e-3)
    np.testing.assert_allclose(fit.weights, weights, atol=5e-3)
    assert fit.scale == pytest.approx(scale, rel=1e-3)


def test_the_loss_is_that_of_cauchy_unless_another_width_is_given() -> None:
    points, range_m, anchor, fit = noisy_fit(0.1)
    np.testing.assert_array_equal(fit_squares(points, range_m, anchor).weights, fit.weights)


def test_a_fit_is_the_same_in_any_unit_and_place_of_the_path() -> None:
    points, range_m, anchor, fit = noisy_fit(0.1)
    moved = fit_squares(1e4 * points + [1.0, -2e4, 3e4], range_m, anchor)
    assert moved.scale == pytest.approx(fit.scale / 1e4, rel=1e-9)
    np.testing.assert_allclose(moved.gradient, fit.gradient / 1e4, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(moved.residuals_m, fit.residuals_m, atol=1e-9)


@pytest.mark.parametrize(("distance_m", "divisor_m"), [(0.15, 0.3), (0.29, 0.3), (0.31, 0.31), (2.0, 2.0)])
def test_a_range_shorter_than_three_decimetres_counts_as_one_of_that_length(
    distance_m: float, divisor_m: float
) -> None:
    points, anchor = a_path()
    away_m = np.array([0.6, 0.0, 0.8]) * distance_m
    points[0] = np.array([30.0, -20.0, 5.0]) + (ANCHORS_M[0] + away_m) / SCALE
    fit = fit_squares(points, distances_m(points, anchor), anchor)
    np.testing.assert_allclose(fit.gradient[0], SCALE * away_m / divisor_m, atol=1e-9)


def test_the_basis_is_orthonormal_and_spans_the_weighted_columns_of_all_unknowns() -> None:
    points, range_m, anchor, fit = noisy_fit(0.3)
    np.testing.assert_allclose(fit.basis.T @ fit.basis, np.eye(9), atol=1e-9)
    wanted, _ = np.linalg.qr(np.sqrt(fit.weights)[:, None] * plain_columns(points, range_m, anchor))
    np.testing.assert_allclose(fit.basis @ (fit.basis.T @ wanted), wanted, atol=1e-9)


def test_what_is_left_of_changes_of_the_ranges_is_what_no_unknown_explains() -> None:
    points, range_m, anchor, fit = noisy_fit(0.3)
    roots = np.sqrt(fit.weights)[:, None]
    columns = roots * plain_columns(points, range_m, anchor)
    values = np.random.default_rng(3).normal(size=(len(points), 2))
    left = roots * values - columns @ np.linalg.lstsq(columns, roots * values, rcond=None)[0]
    np.testing.assert_allclose(fit.unexplained(values), left, atol=1e-9)


def test_curvature_is_left_out_of_changes_however_short_its_column_is() -> None:
    points, _ = a_path(12)
    fit = fit_squares(points, distances_m(points, np.zeros(12, dtype=np.int64)), np.zeros(12, dtype=np.int64))
    assert np.linalg.norm(fit._columns.curvature) < 0.8
    np.testing.assert_allclose(fit.basis.T @ fit.unexplained(np.eye(12)), 0.0, atol=1e-9)


def test_a_scale_is_given_if_the_curvature_is_five_standard_deviations_and_not_if_it_is_less() -> None:
    points, anchor = a_path(60)
    points = points.mean(axis=0) + (points - points.mean(axis=0)) / 20
    noise = np.random.default_rng(5).normal(size=len(points))
    significances = []
    for size_m in np.linspace(0.0049, 0.0054, 12):
        range_m = distances_m(points, anchor) + size_m * noise
        fit = fit_squares(points, range_m, anchor)
        roots = np.sqrt(fit.weights)
        columns = roots[:, None] * plain_columns(points, range_m, anchor)
        values = roots * range_m**2 / (2 * range_m)
        unknowns = np.linalg.lstsq(columns, values, rcond=None)[0]
        own = columns[:, 0] - columns[:, 1:] @ np.linalg.lstsq(columns[:, 1:], columns[:, 0], rcond=None)[0]
        significance = unknowns[0] * np.linalg.norm(own) / np.std(values - columns @ unknowns)
        if abs(significance - 5) > 0.02:
            assert np.isfinite(fit.scale) == (significance > 5)
            significances.append(abs(significance - 5) * (1 if np.isfinite(fit.scale) else -1))
    assert min(value for value in significances if value > 0) < 0.3
    assert max(value for value in significances if value < 0) > -0.3


def test_ranges_that_curve_the_wrong_way_are_fitted_without_curvature() -> None:
    rng = np.random.default_rng(2)
    points, anchor = rng.normal(size=(30, 3)), np.zeros(30, dtype=np.int64)
    fit = fit_squares(points, np.sqrt(100 - np.sum(points**2, axis=1)), anchor)
    assert fit.scale == np.inf
    design = np.column_stack([points, np.ones(30)])
    columns = _LinearColumns(design, np.ones(30), [np.arange(30)])
    squared = 100 - np.sum(points**2, axis=1) + 2 * points[:, 1]
    alpha_squared, slopes, residuals = columns.solve(squared)
    unknowns = np.linalg.lstsq(design, squared, rcond=None)[0]
    assert alpha_squared == 0.0
    np.testing.assert_allclose(slopes, np.tile(unknowns[:3], (30, 1)), atol=1e-9)
    np.testing.assert_allclose(residuals, squared - design @ unknowns, atol=1e-9)


def test_the_slopes_belong_to_the_range_s_own_anchor_and_the_curvature_to_all() -> None:
    rng = np.random.default_rng(4)
    points, anchor = rng.normal(size=(40, 3)), rng.permutation(np.arange(40) % 2)
    design, row_weights = np.column_stack([points, np.ones(40)]), rng.uniform(0.5, 2, 40)
    columns = _LinearColumns(design, row_weights, [np.flatnonzero(anchor == one) for one in (0, 1)])
    slopes, constants = np.array([[1.0, -2.0, 3.0], [0.5, 0.0, -1.0]]), np.array([50.0, 70.0])
    squared = 0.25 * np.sum(points**2, axis=1) + np.sum(slopes[anchor] * points, axis=1) + constants[anchor]
    alpha_squared, found, residuals = columns.solve(squared)
    assert columns.num_anchors == 2
    assert alpha_squared == pytest.approx(0.25)
    np.testing.assert_allclose(found, slopes[anchor], atol=1e-9)
    np.testing.assert_allclose(residuals, 0.0, atol=1e-9)


@pytest.mark.parametrize(("height", "counts"), [(0.0, False), (3e-6, False), (1e-4, True)])
def test_a_direction_in_which_the_path_moves_only_by_rounding_has_no_slope(height: float, counts: bool) -> None:
    """The squared lengths of the columns, 1e-11 and 1e-8 of the longest, are below and above 1e-10."""
    rng = np.random.default_rng(6)
    points = np.column_stack([rng.normal(size=(50, 2)), height * rng.normal(size=50)])
    anchor = np.zeros(50, dtype=np.int64)
    away = points - np.array([4.0, -2.0, 3.0])
    range_m = np.linalg.norm(away, axis=1)
    fit = fit_squares(points, range_m, anchor)
    wanted = away / range_m[:, None]
    np.testing.assert_allclose(fit.gradient[:, :2], wanted[:, :2], atol=1e-4)
    np.testing.assert_allclose(fit.gradient[:, 2], wanted[:, 2] if counts else 0.0, atol=1e-3)
    assert fit.basis.shape == (50, 5 if counts else 4)


def test_a_path_on_a_line_has_a_slope_along_it_only() -> None:
    along = np.array([0.6, 0.0, 0.8])
    points = np.linspace(-2.0, 3.0, 30)[:, None] * along
    away = points - np.array([4.0, -2.0, 3.0])
    range_m = np.linalg.norm(away, axis=1)
    fit = fit_squares(points, range_m, np.zeros(30, dtype=np.int64))
    assert fit.basis.shape == (30, 3)
    assert fit.scale == pytest.approx(1.0)
    np.testing.assert_allclose(fit.gradient, (away @ along / range_m)[:, None] * along, atol=1e-6)


def test_a_camera_in_one_place_has_neither_scale_nor_slopes_and_residuals_from_the_mean() -> None:
    range_m = np.array([5.01, 4.99, 5.02, 4.98, 5.0, 5.0])
    fit = fit_squares(np.ones((6, 3)), range_m, np.zeros(6, dtype=np.int64))
    assert fit.scale == np.inf
    np.testing.assert_array_equal(fit.gradient, 0.0)
    np.testing.assert_allclose(fit.residuals_m, range_m - 5.0, atol=1e-3)
    assert np.all(np.isfinite(fit.basis))
    np.testing.assert_allclose(fit.unexplained(np.ones((6, 1))).T @ np.sqrt(fit.weights), 0.0, atol=1e-3)


def test_residuals_below_a_millimetre_count_as_a_millimetre() -> None:
    assert residual_stddev(np.array([1e-5, -1e-5])) == pytest.approx(1e-3)
    assert residual_stddev(np.array([0.1, -0.1])) == pytest.approx(0.14826022)

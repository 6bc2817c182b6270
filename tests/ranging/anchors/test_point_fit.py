"""A point is fitted to ranges at known positions: the linear start, the cost, the noise, and the errors of the fit."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from scipy.stats import norm

from rangesfm.ranging.anchors import point_fit
from rangesfm.ranging.anchors.point_fit import (
    FitErrors,
    PointFit,
    PointProblem,
    _best_start,
    _directions,
    _distinct,
    _noise_of,
    _starts,
    errors_of_fits,
    fit_with_own_noise,
    improve,
    multilaterate,
)
from rangesfm.ranging.errors.robust_loss import CAUCHY, GEMAN_MCCLURE

Array = npt.NDArray[np.float64]

POINT = np.array([3.0, -2.0, 1.5])


def scattered(num: int, seed: int = 0) -> Array:
    positions: Array = np.random.default_rng(seed).uniform(-4.0, 4.0, (num, 3))
    return np.asarray(positions + np.array([0.0, 0.0, 1.0]))


def distances(positions: Array, point: Array = POINT) -> Array:
    return np.asarray(np.linalg.norm(positions - point, axis=-1))


def problem_of(positions: Array, off_m: Array | float = 0.0, *, bias_stddev_m: float = 0.1) -> PointProblem:
    num = len(positions)
    return PointProblem(
        positions_m=positions,
        range_m=distances(positions) + off_m,
        stddev_m=np.full(num, 0.05),
        shared_stddev_m=np.zeros(num),
        prior_mean=np.zeros(4),
        prior=np.array([[0.0, 0.0, 0.0, 1 / bias_stddev_m]]),
    )


def even_noise(num: int, stddev_m: float) -> Array:
    """Noise with the quantiles of a normal distribution, in some order."""
    quantiles = norm.ppf((np.arange(num) + 0.5) / num)
    return np.asarray(stddev_m * np.random.default_rng(1).permutation(quantiles))


class TestLinearSolution:
    def test_is_the_point_with_no_residuals(self) -> None:
        point, residuals = multilaterate(scattered(12), distances(scattered(12)))
        np.testing.assert_allclose(point, POINT, atol=1e-9)
        np.testing.assert_allclose(residuals, 0.0, atol=1e-9)

    def test_is_not_moved_by_some_wrong_ranges_whose_residuals_show_it_in_metres(self) -> None:
        wrong = np.zeros(40)
        wrong[[3, 20, 31]] = [0.1, 5.0, -0.1]
        point, residuals = multilaterate(scattered(40), distances(scattered(40)) + wrong)
        np.testing.assert_allclose(point, POINT, atol=1e-6)
        np.testing.assert_allclose(residuals[[3, 31]], [-0.1, 0.1], rtol=0.05)

    def test_is_that_of_each_of_many_points(self) -> None:
        positions = np.stack([scattered(15, seed=2), scattered(15, seed=3) * 2])
        points = np.stack([POINT, POINT + 1.0])
        found, residuals = multilaterate(positions, distances(positions, points[:, None]))
        np.testing.assert_allclose(found, points, atol=1e-8)
        assert residuals.shape == (2, 15)

    @pytest.mark.parametrize("height", [3.5, -1.5])
    def test_is_above_a_plane_of_positions(self, height: float) -> None:
        flat = scattered(20) * [1.0, 1.0, 0.0] + [0.0, 0.0, 1.0]
        found, _ = multilaterate(flat, distances(flat, np.array([3.0, -2.0, height])))
        np.testing.assert_allclose(found, [3.0, -2.0, 3.5], atol=1e-8)

    def test_is_as_far_from_a_line_of_positions_as_the_point(self) -> None:
        line = np.outer(np.linspace(-3.0, 3.0, 10), [0.6, 0.8, 0.0])
        along = np.array([0.6, 0.8, 0.0])
        found, _ = multilaterate(line, distances(line))
        assert found @ along == pytest.approx(POINT @ along)
        assert np.linalg.norm(found - (found @ along) * along) == pytest.approx(
            np.linalg.norm(POINT - (POINT @ along) * along)
        )

    def test_of_a_point_in_the_plane_of_the_positions_is_there(self) -> None:
        flat = scattered(20) * [1.0, 1.0, 0.0]
        found, _ = multilaterate(flat, distances(flat, POINT * [1.0, 1.0, 0.0]) * (1 - 1e-9))
        np.testing.assert_allclose(found, POINT * [1.0, 1.0, 0.0], atol=1e-3)

    @pytest.mark.parametrize(("share", "height"), [(0.021, -3.0), (0.019, 3.0)])
    def test_has_a_side_where_the_positions_rise_and_fall_by_a_fiftieth_of_their_length(
        self, share: float, height: float
    ) -> None:
        """Heights, widths and lengths are independent, so that these are the principal axes."""
        grid = np.stack(np.meshgrid([-1.0, 1.0], [-1.0, 1.0], [-1.0, 1.0]), axis=-1).reshape(-1, 3)
        positions = grid * [5.0, 3.0, 5.0 * share]
        found, _ = multilaterate(positions, distances(positions, np.array([1.0, 2.0, -3.0])))
        assert found[2] == pytest.approx(height, abs=0.05)


class TestProblem:
    def test_residuals_are_predicted_minus_measured_and_slopes_their_derivatives(self) -> None:
        problem = problem_of(scattered(6), 0.3)
        x = np.append(POINT + np.array([0.1, -0.2, 0.3]), 0.2)
        np.testing.assert_allclose(
            problem.residuals_m(x), distances(scattered(6), x[:3]) + 0.2 - distances(scattered(6)) - 0.3
        )
        step = 1e-6 * np.eye(4)
        differences = [(problem.residuals_m(x + h) - problem.residuals_m(x - h)) / 2e-6 for h in step]
        np.testing.assert_allclose(problem.slopes(x), np.transpose(differences), atol=1e-7)
        halved = replace(problem, stddev_m=np.linspace(0.1, 0.6, 6))
        np.testing.assert_allclose(halved.jacobian(x), problem.slopes(x) / np.linspace(0.1, 0.6, 6)[:, None])

    def test_the_cost_is_half_the_robust_sum_and_half_that_of_the_prior_without_loss(self) -> None:
        problem = replace(problem_of(scattered(3), 0.3), prior_mean=np.array([0.0, 0.0, 0.0, 4.0]))
        x = np.append(POINT, 0.0)
        prior = (4.0 / 0.1) ** 2
        for loss, rho in ((CAUCHY, 2.385**2 * np.log1p(36 / 2.385**2)), (GEMAN_MCCLURE, 36 / (1 + 36 / 3.46**2))):
            assert problem.cost(x, loss) == pytest.approx((3 * rho + prior) / 2)
        assert problem.cost(x) == problem.cost(x, CAUCHY)

    def test_some_of_its_ranges_keep_the_prior(self) -> None:
        problem = replace(problem_of(scattered(5)), stddev_m=np.arange(5.0), shared_stddev_m=np.arange(5.0) + 9)
        part = problem.subset(np.array([4, 1]))
        np.testing.assert_array_equal(part.positions_m, scattered(5)[[4, 1]])
        np.testing.assert_array_equal(part.range_m, problem.range_m[[4, 1]])
        np.testing.assert_array_equal(part.stddev_m, [4.0, 1.0])
        np.testing.assert_array_equal(part.shared_stddev_m, [13.0, 10.0])
        assert part.prior is problem.prior

    def test_the_improved_point_is_at_the_minimum_of_the_cost(self) -> None:
        """Ranges have outliers, which the loss reduces; the prior is far off, and has its full effect."""
        off = even_noise(20, 0.05)
        off[:3] += 1.0
        problem = replace(problem_of(scattered(20), off), prior_mean=np.array([0.0, 0.0, 0.0, 2.0]))
        found = improve(problem, np.append(POINT + 0.2, 0.0))
        for step in 1e-3 * np.vstack([np.eye(4), -np.eye(4)]):
            assert problem.cost(found + step) > problem.cost(found)
        gradient = [(problem.cost(found + h) - problem.cost(found - h)) / 2e-5 for h in 1e-5 * np.eye(4)]
        np.testing.assert_allclose(gradient, 0.0, atol=1e-3)

    def test_a_looser_tolerance_stops_earlier(self) -> None:
        problem, start = problem_of(scattered(20), even_noise(20, 0.05)), np.append(POINT + 1.0, 0.3)
        best = improve(problem, start)
        early = improve(problem, start, 1e-2)
        assert 1e-6 < np.linalg.norm(early - best) < 0.1


class TestFit:
    def test_tells_its_noise_residuals_and_weights(self) -> None:
        off = np.array([0.0, 0.05 * 2.385, 0.0, 0.0, -0.3])
        problem = replace(problem_of(scattered(5), off), prior_mean=np.array([0.0, 0.0, 0.0, 0.1]))
        fit = PointFit(problem, np.append(POINT, 0.0), np.array([0.1, 0.2, 0.4, 0.1, 0.9]))
        assert fit.noise_m == 0.2
        np.testing.assert_allclose(fit.residuals_m, -off, atol=1e-12)
        np.testing.assert_allclose(fit.off_m, off - 0.1, atol=1e-12)
        np.testing.assert_allclose(fit.weights[:3], [1.0, 0.5, 1.0])

    def test_the_noise_of_few_residuals_is_drawn_to_the_usual_one(self) -> None:
        """Four unknowns take their share, and the usual noise counts as two ranges."""
        variance = 1.4826022**2
        for num, freedom in ((10, 6), (5, 1), (4, 0), (3, 0)):
            expected = np.sqrt((variance * num + 2) / (freedom + 2))
            assert _noise_of(np.resize([1.0, -1.0], num), 4) == pytest.approx(expected)

    def started(self, monkeypatch: pytest.MonkeyPatch, noise: float = 1.0) -> list[Array]:
        """Start at the point, as the search for a start takes most of the time; return the units it was asked with."""
        units: list[Array] = []

        def start(problem: PointProblem, unit_m: Array) -> tuple[Array, float]:
            units.append(unit_m)
            return np.append(POINT, 0.0), noise

        monkeypatch.setattr(point_fit, "_best_start", start)
        return units

    def test_has_the_noise_of_its_residuals(self, monkeypatch: pytest.MonkeyPatch) -> None:
        units = self.started(monkeypatch)
        fit = fit_with_own_noise(problem_of(scattered(200), even_noise(200, 0.03)), np.full(200, np.nan))
        np.testing.assert_array_equal(units[0], 0.1)
        assert fit.noise_m == pytest.approx(0.03, rel=0.1)
        np.testing.assert_array_equal(fit.problem.stddev_m, fit.own_stddev_m)
        np.testing.assert_allclose(fit.x, improve(fit.problem, fit.x), atol=1e-6)

    def test_given_noise_is_a_lower_bound(self, monkeypatch: pytest.MonkeyPatch) -> None:
        units = self.started(monkeypatch, noise=0.3)
        problem = problem_of(scattered(100), even_noise(100, 0.05))
        larger = fit_with_own_noise(problem, np.full(100, 0.2))
        np.testing.assert_array_equal(units[0], 0.2)
        np.testing.assert_allclose(larger.own_stddev_m, 0.2)
        assert fit_with_own_noise(problem, np.full(100, 0.01)).noise_m == pytest.approx(0.05, rel=0.15)

    def test_noise_that_some_ranges_state_is_their_ratio(self, monkeypatch: pytest.MonkeyPatch) -> None:
        units = self.started(monkeypatch)
        given = np.where(np.arange(120) % 3 == 0, 0.4, np.where(np.arange(120) % 3 == 1, 0.8, np.nan))
        given[0] = 0.8
        fit = fit_with_own_noise(problem_of(scattered(120), even_noise(120, 1.0) * 0.1), given)
        np.testing.assert_array_equal(np.unique(units[0]), [0.4, 0.8])
        assert units[0][2] == 0.8
        np.testing.assert_allclose(fit.own_stddev_m / units[0], fit.own_stddev_m[0] / 0.8)
        assert fit.noise_m < 0.3, "some are unknown, so that the noise is free"

    def test_shared_errors_widen_each_range_and_such_ranges_show_no_noise(
        self, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """The noise is that of all residuals if seven of ten or more have a larger common error than noise."""
        self.started(monkeypatch)
        for num_shared, expected in ((60, 0.055), (80, 0.12)):
            is_shared = np.arange(100) < num_shared
            off = even_noise(100, 1.0) * np.where(is_shared, 0.15, 0.05)
            problem = replace(problem_of(scattered(100), off), shared_stddev_m=np.where(is_shared, 0.3, 0.0))
            fit = fit_with_own_noise(problem, np.full(100, np.nan))
            assert fit.noise_m == pytest.approx(expected, rel=0.25)
            np.testing.assert_allclose(fit.problem.stddev_m, np.hypot(fit.own_stddev_m, problem.shared_stddev_m))


class TestStart:
    def test_directions_are_spread_over_the_sphere(self) -> None:
        found = _directions()
        np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1.0)
        np.testing.assert_allclose(found.mean(axis=0), 0.0, atol=0.02)
        np.testing.assert_allclose(np.diff(found[:, 2]), -0.1)
        np.testing.assert_allclose(found.T @ found / 20, np.eye(3) / 3, atol=0.02)
        assert np.sort(found @ found.T, axis=1)[:, -2].max() < np.cos(0.55), "none are close together"
        assert (scattered(500) @ found.T / np.linalg.norm(scattered(500), axis=1)[:, None]).max(axis=1).min() > 0.8

    def test_starts_are_around_the_tag_and_where_the_linear_solution_is_and_its_mirror_image(self) -> None:
        flat = scattered(30) * [1.0, 1.0, 0.0] + [0.0, 0.0, 1.0]
        problem = replace(problem_of(flat, 0.4), prior_mean=np.array([0.0, 0.0, 0.0, 0.4]))
        starts = np.array(_starts(problem))
        assert starts.shape == (22, 4)
        np.testing.assert_array_equal(starts[:, 3], 0.4)
        np.testing.assert_allclose(distances(starts[:20, :3], flat.mean(axis=0)), np.median(distances(flat)))
        np.testing.assert_allclose(starts[20:, :3], [[3.0, -2.0, 1.5], [3.0, -2.0, 0.5]], atol=1e-6)

    def test_of_points_within_the_noise_the_first_is_kept(self) -> None:
        points = [np.zeros(4), np.array([0.0, 0.009, 0.0, 0.0]), np.array([0.0, 0.011, 0.0, 0.0]), np.zeros(4)]
        kept = _distinct(points, 0.01)
        assert [id(x) for x in kept] == [id(points[0]), id(points[2])]

    def test_the_likeliest_of_all_minima_is_chosen_with_its_noise(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """The ranges fit one of the two sides of a nearly flat path; a third of them is wrong."""
        positions = scattered(60) * [1.0, 1.0, 0.3]
        off = even_noise(60, 0.04)
        off[::3] += 2.0
        problem = problem_of(positions, off)
        starts = [np.append(POINT * [1.0, 1.0, sign], 0.0) for sign in (-1.0, 1.0)]
        for order in (1, -1):
            monkeypatch.setattr(point_fit, "_starts", lambda part, order=order: starts[::order])
            found, noise = _best_start(problem, np.full(60, 0.1))
            np.testing.assert_allclose(found[:3], POINT, atol=0.06)
            assert noise == pytest.approx(0.4, rel=0.3)

    def test_it_is_searched_with_three_hundred_ranges(self, monkeypatch: pytest.MonkeyPatch) -> None:
        parts: list[PointProblem] = []

        def starts(part: PointProblem) -> list[Array]:
            parts.append(part)
            return [np.append(POINT, 0.0)]

        monkeypatch.setattr(point_fit, "_starts", starts)
        for num in (300, 1000):
            _best_start(problem_of(scattered(num)), np.full(num, 0.1))
        assert [len(part.range_m) for part in parts] == [300, 300]
        np.testing.assert_array_equal(parts[1].positions_m[[0, -1]], scattered(1000)[[0, -1]])


def fit_of(num: int, seed: int = 0) -> PointFit:
    problem = replace(problem_of(scattered(num, seed), even_noise(num, 0.05)), stddev_m=np.linspace(0.03, 0.08, num))
    return PointFit(problem, improve(problem, np.append(POINT, 0.0)), problem.stddev_m)


class TestErrors:
    def test_sums_have_the_covariance_of_their_bins(self) -> None:
        errors = FitErrors(np.array([0, 2, 2]), np.diag([1.0, 10.0, 100.0]) + 0.5)
        rows = np.array([[1.0, 0.0, 0.0], [0.0, 2.0, 1.0]])
        np.testing.assert_allclose(errors.of_sums(rows), [[1.5, 1.5], [1.5, 9 * 100.5]])

    def test_of_independent_ranges_inflate_nothing_and_common_ones_by_their_number(self) -> None:
        fit = fit_of(8)
        fit = replace(fit, problem=replace(fit.problem, stddev_m=np.full(8, 0.05), range_m=distances(scattered(8))))
        fit = replace(fit, x=np.append(POINT, 0.0))
        apart = FitErrors(np.arange(8), np.diag(np.full(8, 0.05**2)))
        assert apart.inflation(fit, np.ones(8)) == pytest.approx(1.0)
        assert replace(apart, covariance_m2=4 * apart.covariance_m2).inflation(fit, np.ones(8)) == pytest.approx(2.0)
        assert replace(apart, covariance_m2=apart.covariance_m2 / 4).inflation(fit, np.ones(8)) == 1.0
        alike = FitErrors(np.zeros(8, dtype=np.int64), np.array([[0.05**2]]))
        assert alike.inflation(fit, np.full(8, 3.0)) == pytest.approx(np.sqrt(8))
        assert alike.inflation(fit, np.resize([1.0, -1.0], 8)) == 1.0, "they cancel"
        assert alike.inflation(fit, np.zeros(8)) == 1.0

    def test_inflate_the_bias_by_the_ratio_of_its_standard_deviations(self) -> None:
        """The position is estimated with it: compare with the whole covariance, without the prior."""
        fit = fit_of(40)
        covariance = 0.05**2 * (0.2 * np.eye(10) + 0.8)
        errors = FitErrors(np.arange(40) % 10, covariance)
        slopes, weight = fit.problem.slopes(fit.x), fit.weights / fit.problem.stddev_m**2
        formal = np.linalg.inv(slopes.T @ (slopes * weight[:, None]))
        influence = formal @ (slopes * weight[:, None]).T
        expected = np.sqrt(errors.of_sums(influence)[3, 3] / formal[3, 3])
        assert expected > 1.5
        assert errors.inflation_of_bias(fit) == pytest.approx(expected)

    @pytest.mark.parametrize("is_calibrated", [True, False])
    def test_are_learnt_from_all_fits_together(self, monkeypatch: pytest.MonkeyPatch, is_calibrated: bool) -> None:
        fits = [fit_of(6), fit_of(5, seed=1)]
        fits[1] = replace(fits[1], problem=replace(fits[1].problem, shared_stddev_m=np.full(5, 0.7)))
        given: dict[str, Any] = {}

        def learn(bins: Any, **others: Any) -> Any:
            given.update(others, bins=bins)
            return SimpleNamespace(covariance_m2=np.eye(len(bins)), of_range=bins.of_range)

        monkeypatch.setattr(point_fit, "learn_errors", learn)
        times = [np.arange(6.0), 0.5 + np.arange(5.0)]
        tags = [np.zeros(6, dtype=np.int64), np.ones(5, dtype=np.int64)]
        first, second = errors_of_fits(fits, times, tags, is_calibrated=is_calibrated)
        bins = given["bins"]
        assert [len(first.of_bin), len(second.of_bin), len(first.covariance_m2)] == [6, 5, 11]
        np.testing.assert_array_equal(np.sort([*first.of_bin, *second.of_bin]), np.arange(11))
        np.testing.assert_array_equal(bins.anchor_index[second.of_bin], 1)
        np.testing.assert_array_equal(bins.tag_index[second.of_bin], 1)
        np.testing.assert_allclose(bins.time_s[first.of_bin], times[0])
        np.testing.assert_allclose(bins.distance_m[first.of_bin], distances(scattered(6), fits[0].x[:3]))
        np.testing.assert_allclose(
            bins.distance_m[second.of_bin, None] * bins.from_anchor[second.of_bin],
            scattered(5, seed=1) - fits[1].x[:3],
        )
        np.testing.assert_allclose(bins.in_cam, bins.from_anchor)
        # Ranges count by their information, relative to the mean of all.
        precision = np.concatenate([np.linspace(0.03, 0.08, 6) ** -2, np.linspace(0.03, 0.08, 5) ** -2])
        worth = np.concatenate([fit.weights for fit in fits]) * precision / precision.mean()
        np.testing.assert_allclose(bins.worth[[*first.of_bin, *second.of_bin]], worth)
        assert given["noise_m"] == pytest.approx(1 / np.sqrt(precision.mean()))
        np.testing.assert_allclose(given["off_m"], np.concatenate([fit.off_m for fit in fits]))
        np.testing.assert_allclose(given["design"][:6, :4], fits[0].problem.slopes(fits[0].x))
        np.testing.assert_allclose(given["design"][6:, 4:], fits[1].problem.slopes(fits[1].x))
        assert not given["design"][:6, 4:].any()
        np.testing.assert_allclose(given["prior_design"], [[0, 0, 0, 10, 0, 0, 0, 0], [0, 0, 0, 0, 0, 0, 0, 10]])
        assert set(given["ruled_out"]) == {"bias", "common_bias"}
        if is_calibrated:
            np.testing.assert_array_equal(given["curve_stddev_m"], [0.0] * 6 + [0.7] * 5)
        else:
            assert given["curve_stddev_m"] is None

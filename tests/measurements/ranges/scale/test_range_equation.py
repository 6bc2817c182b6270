"""The range equation, its derivatives and its solver."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation

from rangesfm.measurements.ranges.anchors.anchor_distances import AnchorDistances
from rangesfm.measurements.ranges.scale import range_equation
from rangesfm.measurements.ranges.scale.range_equation import (
    RangeFit,
    RangeProblem,
    RangeState,
    cost_at,
    predicted_ranges,
    solve,
)
from rangesfm.solver.posterior import ScaleByKind
from rangesfm.util.geometry.gravity import gravity_of
from rangesfm.util.geometry.robust_statistics import CAUCHY, GEMAN_MCCLURE, RobustLoss
from rangesfm.util.geometry.similarity import Similarity

Array = npt.NDArray[np.float64]

NUM_RANGES, NUM_ANCHORS = 40, 3


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)


def random_state(rng: np.random.Generator) -> RangeState:
    rotation = Rotation.from_quat(rng.normal(size=4)).as_matrix()
    return RangeState(
        Similarity(1.7, rotation, rng.normal(size=3)), 4 * rng.normal(size=(NUM_ANCHORS, 3)), rng.normal(size=3)
    )


def random_problem(rng: np.random.Generator, state: RangeState) -> RangeProblem:
    """A problem that estimates the frame, all anchors (one without a prior) and all biases; ranges fit ``state``."""
    problem = RangeProblem(
        centers=3 * rng.normal(size=(NUM_RANGES, 3)),
        tag_from_center=0.3 * rng.normal(size=(NUM_RANGES, 3)),
        anchor_index=rng.integers(NUM_ANCHORS, size=NUM_RANGES),
        range_m=np.zeros(NUM_RANGES),
        stddev_m=rng.uniform(0.05, 0.3, NUM_RANGES),
        anchor_mean_m=np.vstack([rng.normal(size=(2, 3)), np.full((1, 3), np.nan)]),
        anchor_stddev_m=np.array([0.1, 0.4, np.inf]),
        bias_mean_m=rng.normal(size=3),
        bias_stddev_m=np.array([0.02, 0.1, 0.3]),
        common_bias_stddev_m=0.2,
        frame_is_free=True,
        share=np.ones(NUM_RANGES),
    )
    return replace(problem, range_m=predicted_ranges(problem, state))


def finite_differences(function: Callable[[Array], Array], at: Array) -> Array:
    steps = 1e-6 * np.eye(len(at))
    return np.stack([(function(at + s) - function(at - s)) / 2e-6 for s in steps], axis=1)


def test_prediction_is_the_hand_computed_one() -> None:
    # Scaled by 2, rotated by 90 degrees about z and shifted, the centre (1, 0, 0) comes to (1, 2, 0). The lever arm (0,
    # 1, 0) is rotated to (-1, 0, 0) and not scaled. So the tag is at (0, 2, 0), 5 m from (0, 6, 3), and the bias is
    # 0.25 m.
    quarter_turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    problem = RangeProblem(
        centers=np.array([[1.0, 0.0, 0.0]]),
        tag_from_center=np.array([[0.0, 1.0, 0.0]]),
        anchor_index=np.zeros(1, dtype=np.int64),
        range_m=np.array([5.0]),
        stddev_m=np.array([0.1]),
        anchor_mean_m=np.array([[0.0, 6.0, 3.0]]),
        anchor_stddev_m=np.zeros(1),
        bias_mean_m=np.zeros(1),
        bias_stddev_m=np.zeros(1),
        common_bias_stddev_m=0.0,
        frame_is_free=False,
        share=np.ones(1),
    )
    state = RangeState(
        Similarity(2.0, quarter_turn, np.array([1.0, 0.0, 0.0])), problem.anchor_mean_m, np.array([0.25])
    )
    assert predicted_ranges(problem, state) == pytest.approx([5.25], abs=1e-12)


@pytest.mark.parametrize("turn_rad", [0.0, 1e-5, 0.5, 2.5])
def test_jacobians_are_finite_differences_in_every_column(rng: np.random.Generator, turn_rad: float) -> None:
    start = random_state(rng)
    taped = AnchorDistances(np.array([[0, 1], [2, 1]]), np.array([5.0, 4.0]), np.array([0.2, 0.5]))
    given, scales = random_problem(rng, random_state(rng)), (ScaleByKind(1.5, 0.1), ScaleByKind(2.5, 0.3))
    problem = replace(given, distances=taped, gravity=gravity_of((0.3, -1.0, 0.2)), scales=scales)
    (columns,) = range_equation.columns_of([problem])
    assert columns.num == 1 + 6 + 3 * NUM_ANCHORS + NUM_ANCHORS
    at = 0.2 * rng.normal(size=columns.num)
    at[1:4] *= turn_rad / np.linalg.norm(at[1:4])

    def residuals(x: Array) -> Array:
        state = range_equation.state_after([columns], start, x)
        return (predicted_ranges(problem, state) - problem.range_m) / problem.stddev_m

    def prior_residuals(x: Array) -> Array:
        return range_equation.prior_residuals(problem, columns, range_equation.state_after([columns], start, x))

    state = range_equation.state_after([columns], start, at)
    jacobian, prior_jacobian = range_equation._System((problem,), (columns,), start, CAUCHY).jacobian(state)
    np.testing.assert_allclose(jacobian, finite_differences(residuals, at), rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(prior_jacobian, finite_differences(prior_residuals, at), rtol=1e-6, atol=1e-6)


def test_with_the_tag_on_the_anchor_all_numbers_are_finite(rng: np.random.Generator) -> None:
    start = random_state(rng)
    problem = random_problem(rng, start)
    tag = range_equation.antenna_positions(problem, start.metric_from_model)[0]
    anchors = start.anchors_m.copy()
    anchors[problem.anchor_index[0]] = tag
    state = replace(start, anchors_m=anchors)
    (columns,) = range_equation.columns_of([problem])
    jacobian = range_equation.range_jacobian(problem, columns, state)
    assert np.all(np.isfinite(jacobian))
    assert np.isfinite(solve(problem, state).cost)


def test_a_share_of_two_is_the_same_range_twice(rng: np.random.Generator) -> None:
    truth = random_state(rng)
    problem = replace(random_problem(rng, truth), anchor_mean_m=truth.anchors_m, anchor_stddev_m=np.zeros(NUM_ANCHORS))
    problem = replace(problem, range_m=problem.range_m + problem.stddev_m * rng.standard_t(3, size=NUM_RANGES))
    rows = np.arange(NUM_RANGES)
    share = np.where(rows % 3 == 0, 2.0, 1.0)
    weighted = solve(replace(problem, share=share), truth)
    repeated = solve(problem.subset(np.repeat(rows, share.astype(np.int64))), truth)
    assert weighted.cost == pytest.approx(repeated.cost, rel=1e-9)
    assert weighted.state.metric_from_model.scale == pytest.approx(repeated.state.metric_from_model.scale, rel=1e-9)
    np.testing.assert_allclose(weighted.information, repeated.information, rtol=1e-6, atol=1e-6)


def test_some_ranges_stand_for_those_of_their_anchor_that_are_left_out(rng: np.random.Generator) -> None:
    truth = random_state(rng)
    problem = replace(random_problem(rng, truth), anchor_mean_m=truth.anchors_m, anchor_stddev_m=np.zeros(NUM_ANCHORS))
    problem = replace(problem, range_m=problem.range_m + problem.stddev_m * rng.standard_normal(NUM_RANGES))
    num_alike = np.array([1, 2, 5])[problem.anchor_index]
    all_of_them = problem.subset(np.repeat(np.arange(NUM_RANGES), num_alike))
    one_of_each = np.cumsum(num_alike) - 1
    by_all, by_some = solve(all_of_them, truth), solve(all_of_them.by_some(one_of_each), truth)
    assert len(by_some.weights) == NUM_RANGES
    assert by_some.cost == pytest.approx(by_all.cost, rel=1e-9)
    np.testing.assert_allclose(by_some.information, by_all.information, rtol=1e-6, atol=1e-6)


def fit_with(information: Array, problem: RangeProblem, state: RangeState) -> RangeFit:
    num = len(problem.range_m)
    columns = range_equation.columns_of([problem])
    return RangeFit(state, np.ones(num), 0.0, information, columns)


def test_the_covariance_is_the_inverse_of_the_information_in_any_units(rng: np.random.Generator) -> None:
    state = random_state(rng)
    problem = random_problem(rng, state)
    root = rng.normal(size=(4, 4))
    information = root @ root.T + np.eye(4)
    expected = np.linalg.inv(information)
    fit = fit_with(information, problem, state)
    np.testing.assert_allclose(fit.covariance, expected, rtol=1e-9, atol=1e-12)
    assert fit.log_scale_stddev == pytest.approx(np.sqrt(expected[0, 0]))
    units = np.array([1e-6, 1.0, 1e5, 1e2])
    in_units = fit_with(information * np.outer(units, units), problem, state)
    np.testing.assert_allclose(in_units.covariance * np.outer(units, units), expected, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("loss", [CAUCHY, GEMAN_MCCLURE])
def test_the_slope_of_the_cost_is_its_finite_difference_and_far_ranges_add_no_curvature(
    rng: np.random.Generator, loss: RobustLoss
) -> None:
    start = random_state(rng)
    problem = random_problem(rng, start)
    share = rng.uniform(0.3, 1.0, NUM_RANGES)
    off_m = problem.stddev_m * rng.standard_t(2, size=NUM_RANGES)
    problem = replace(problem, share=share, range_m=problem.range_m + off_m)
    columns = range_equation.columns_of([problem])
    system = range_equation._System((problem,), columns, start, loss)
    at = np.zeros(columns[0].num)
    gradient, curvature = system.slope(system.state_after(at))
    differences = finite_differences(lambda y: np.array([cost_at(problem, system.state_after(y), loss)]), at)
    np.testing.assert_allclose(gradient, differences[0], rtol=1e-5, atol=1e-4)
    far = replace(system, parts=(replace(problem, range_m=problem.range_m + 1e3),))
    of_priors = range_equation.prior_jacobian(problem, columns[0], start)
    np.testing.assert_allclose(far.slope(start)[1], of_priors.T @ of_priors, atol=1e-9)
    assert np.linalg.eigvalsh(curvature).min() > -1e-9


def test_a_height_alone_may_be_known(rng: np.random.Generator) -> None:
    start = random_state(rng)
    problem = random_problem(rng, start)
    height_m = float(start.anchors_m[0, 2]) + 0.5
    mean_m, stddevs_m = problem.anchor_mean_m.copy(), problem.anchor_stddev_m.copy()
    mean_m[0], stddevs_m[0] = (np.nan, np.nan, height_m), 1e-6
    problem = replace(problem, anchor_mean_m=mean_m, anchor_stddev_m=stddevs_m)
    assert solve(problem, start).state.anchors_m[0, 2] == pytest.approx(height_m, abs=1e-4)
    (columns,) = range_equation.columns_of([problem])
    differences = finite_differences(
        lambda x: range_equation.prior_residuals(problem, columns, range_equation.state_after([columns], start, x)),
        np.zeros(columns.num),
    )
    of_priors = range_equation.prior_jacobian(problem, columns, start)
    np.testing.assert_allclose(of_priors, differences, rtol=1e-5, atol=1e-4)

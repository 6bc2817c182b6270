"""The stated uncertainty of the scale is honest."""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import pytest

from rangesfm.demo.simulated_radio import Radio
from rangesfm.geometry.trajectory import Trajectory
from rangesfm.options import RangeModelOptions, ScaleOptions
from rangesfm.ranging.association import associate
from rangesfm.ranging.errors.bending import BendingOfBins
from rangesfm.ranging.errors.components import CLOCKS
from rangesfm.ranging.errors.learned import ErrorParts, LearnedErrors
from rangesfm.ranging.errors.range_bins import range_bins
from rangesfm.scale.initialize import initialize_scale
from rangesfm.scale.linear_map import LinearMap
from rangesfm.scale.range_equation import Columns
from rangesfm.scale.scale_estimate import ScaleEstimate, ScaleUncertainty
from rangesfm.scale.uncertainty import KnownMap, bias_covariance, known_map, linear_map, shared_errors_m

if TYPE_CHECKING:
    from tests.scale.conftest import MakeSurvey, Survey

Array = npt.NDArray[np.float64]

WITHOUT_BIASES = RangeModelOptions(range_bias_stddev_m=0.0, common_bias_stddev_m=0.0)
FAR_ANCHORS_M = {"A": (9.0, 2.0, 2.5), "B": (-9.0, 1.0, 0.4), "C": (0.5, 9.0, 3.0), "D": (1.0, -9.0, 0.2)}
IN_TIME = ("white", "time", "place", "view", "reweighting")


@dataclass(frozen=True)
class Rigid:
    """The bending of a map that is known not to be bent."""

    path: Trajectory

    def of_functions(self, by_pose: Array, *, frame_is_free: bool) -> BendingOfBins:
        return BendingOfBins((), np.zeros((len(by_pose), len(by_pose))), np.zeros(len(by_pose)))


def drifting_errors(survey: Survey, stddev: float, memory_s: float, seed: int) -> Array:
    """(n,) errors of each anchor that come and go over some seconds."""
    log = survey.simulated.log
    assert log.timestamp_s is not None
    rng = np.random.default_rng(seed)
    errors = np.zeros(len(log))
    for k in range(len(log.anchor_ids)):
        rows = np.flatnonzero(log.anchor_index == k)
        keep = np.exp(-np.diff(log.timestamp_s[rows]) / memory_s)
        errors[rows[0]] = rng.standard_normal()
        for before, after, kept in zip(rows[:-1], rows[1:], keep, strict=True):
            errors[after] = kept * errors[before] + np.sqrt(1 - kept**2) * rng.standard_normal()
    return stddev * errors


def in_time(uncertainty: ScaleUncertainty) -> float:
    """Return the uncertainty from all errors that change over time."""
    return float(np.linalg.norm([uncertainty.components.get(name, 0.0) for name in IN_TIME]))


def test_with_independent_errors_the_formal_stddev_is_the_scatter(make_survey: MakeSurvey) -> None:
    surveys = [make_survey(anchors_m=FAR_ANCHORS_M, radio=Radio(range_stddev_m=0.1), seed=seed) for seed in range(32)]
    estimates = [
        survey.scale("first_camera", "ABCD", range_model=WITHOUT_BIASES, bending=Rigid(survey.trajectory))
        for survey in surveys
    ]
    errors = [survey.relative_error(estimate) for survey, estimate in zip(surveys, estimates, strict=True)]
    formal = float(np.median([estimate.uncertainty.formal for estimate in estimates]))
    assert np.std(errors) / formal == pytest.approx(1.0, abs=0.25)
    seen = float(np.median([in_time(estimate.uncertainty) for estimate in estimates]))
    assert 1.0 < seen / formal < 1.5


def test_with_errors_that_last_the_stddev_grows_and_is_the_scatter(make_survey: MakeSurvey) -> None:
    errors, formals, seen = [], [], []
    for seed in range(20):
        survey = make_survey(anchors_m=FAR_ANCHORS_M, num_keyframes=100, seed=seed)
        log = survey.log_with(survey.simulated.distance_m + drifting_errors(survey, 0.1, 4.0, seed))
        estimate = survey.scale("first_camera", "ABCD", log, range_model=WITHOUT_BIASES)
        errors.append(survey.relative_error(estimate))
        formals.append(estimate.uncertainty.formal)
        seen.append(in_time(estimate.uncertainty))
    # About ten ranges in a row, at 2.5 a second, have correlated errors.
    assert np.median(seen) > 1.5 * np.median(formals)
    assert np.std(errors) > 1.5 * np.median(formals)
    assert np.std(errors) / np.median(seen) == pytest.approx(1.0, abs=0.4)


def test_the_components_add_as_variances_and_are_never_less_than_the_formal_stddev() -> None:
    assert ScaleUncertainty(0.001, {"a": 0.003, "b": 0.004}).empirical == pytest.approx(0.005)
    assert ScaleUncertainty(0.01, {"a": 0.003}).empirical == 0.01
    assert ScaleUncertainty(0.001, {"a": 0.003, "b": 0.004}).half_width_95 == pytest.approx(1.96 * 0.005)


def test_four_times_the_ranges_halve_what_is_noise(make_survey: MakeSurvey) -> None:
    few, many = (
        make_survey(anchors_m=FAR_ANCHORS_M, radio=Radio(range_stddev_m=0.1), num_epochs=num).scale(
            "first_camera", "ABCD", range_model=WITHOUT_BIASES
        )
        for num in (2, 8)
    )
    assert many.uncertainty.formal / few.uncertainty.formal == pytest.approx(0.5, rel=0.2)
    assert many.uncertainty.components["white"] < 0.8 * few.uncertainty.components["white"]


def test_an_error_curve_that_nobody_knows_widens_the_interval_and_a_known_one_hardly(make_survey: MakeSurvey) -> None:
    survey = make_survey(radio=Radio(range_stddev_m=0.03), num_epochs=5)
    log = survey.simulated.log
    calibrated = replace(log, shared_stddev_m=np.full(len(log), 0.005))
    unknown, known = (survey.scale("unknown", (), each).uncertainty for each in (log, calibrated))
    assert known.components["curve"] < 0.7 * unknown.components["curve"]
    assert known.components["learnt_curve"] < known.components["curve"]
    assert known.half_width_95 < unknown.half_width_95


def test_biases_that_are_ruled_out_are_no_part_of_it(make_survey: MakeSurvey) -> None:
    survey = make_survey(radio=Radio(range_stddev_m=0.05))
    assert "bias" in survey.scale("first_camera", "ABCDE").uncertainty.components
    without = survey.scale("first_camera", "ABCDE", range_model=WITHOUT_BIASES).uncertainty.components
    assert not {"bias", "common_bias"} & set(without)


def test_a_map_that_bends_is_not_known_as_well_as_one_that_does_not(make_survey: MakeSurvey) -> None:
    survey = make_survey(anchors_m=FAR_ANCHORS_M, radio=Radio(range_stddev_m=0.03), num_keyframes=100, num_epochs=3)
    along = np.linspace(0, 1, 100)
    bend_m = 0.4 * np.column_stack([np.sin(7 * along), np.cos(5 * along), 0.3 * np.sin(11 * along)])
    path = survey.trajectory
    bent = replace(survey, trajectory=replace(path, centers=path.centers + bend_m / survey.site_from_sfm.scale))
    options = ScaleOptions(max_relative_stddev=0.5)
    true, wrong = (each.scale("first_camera", "ABCD", options=options) for each in (survey, bent))
    assert true.errors.learned is not None
    assert wrong.errors.learned is not None
    stddevs = [dict(zip(e.errors.learned.names, e.errors.learned.stddevs, strict=True)) for e in (true, wrong)]  # type: ignore[union-attr]
    assert stddevs[1]["bending"] > 5 * stddevs[0]["bending"]
    assert wrong.uncertainty.half_width_95 > 1.5 * true.uncertainty.half_width_95
    assert abs(bent.relative_error(wrong)) < wrong.uncertainty.half_width_95


def test_best_weights_that_disagree_by_more_than_chance_are_followed_no_further(make_survey: MakeSurvey) -> None:
    found = make_survey(radio=Radio(range_stddev_m=0.05)).scale("first_camera", "ABCDE")
    assert found.errors.learned is not None
    assert found.problem is not None
    assert found.solution is not None
    learned = found.errors.learned
    for share in (1.0, 1e-6):
        told = replace(learned, covariances_m2=share * learned.covariances_m2)
        known = known_map(found.problem, found.solution, told)
        stated, weighted = known.uncertainty.components, found.solution
        linear = linear_map(found.problem, weighted, told.bins)
        by_range = weighted.errors.worth * weighted.fit.weights / weighted.errors.stddev_m**2
        assumed_m2 = np.diag(1 / told.bins.total(by_range)) + bias_covariance(told.bins, found.problem.ranges)
        by_robust, _ = linear.with_weights(assumed_m2, told.covariance_m2)
        best = np.array([stated[name] for name in stated if name != "reweighting"])
        chance = np.sqrt(by_robust[0, 0] - np.sum(best**2))
        assert stated["reweighting"] == abs(known.half_way[0]) <= 0.5 * chance * (1 + 1e-9)
    # With a covariance a millionth as large, the difference exceeds chance, and is limited to it.
    assert stated["reweighting"] == pytest.approx(0.5 * chance)


def test_what_the_clocks_leave_open_is_part_of_scale_and_place(make_survey: MakeSurvey) -> None:
    survey, stddev_s = make_survey(), 0.5
    anchors = survey.anchors("site", survey.anchors_m)

    def estimate(time_offset_s: float, stddev_s: float) -> ScaleEstimate:
        placed = associate(survey.simulated.log, survey.trajectory, survey.tag_in_cam_m, time_offset_s=time_offset_s)
        placed = replace(placed, time_offset_stddev_s=stddev_s)
        return initialize_scale(placed, survey.trajectory, anchors, anchor_frame="site")

    right, off, told = estimate(0.0, 0.0), estimate(stddev_s, 0.0), estimate(stddev_s, stddev_s)
    assert CLOCKS not in off.uncertainty.components
    assert told.uncertainty.components[CLOCKS] > 0
    # Half a second later, the whole map is turned along its loop.
    between = off.metric_from_sfm.rotation @ right.metric_from_sfm.rotation.T
    turn_rad = np.arccos((np.trace(between) - 1) / 2)
    assert turn_rad > 4 * heading_stddev_rad(off)
    assert turn_rad < 2 * heading_stddev_rad(told)


def heading_stddev_rad(estimate: ScaleEstimate) -> float:
    assert estimate.placement is not None
    return float(np.sqrt(estimate.placement[3, 3]))


def test_ranges_share_the_errors_that_are_larger_than_what_their_bins_scatter() -> None:
    """Four ranges in three bins, and one without a bin; the map's own errors and the noise are not shared."""
    bins = range_bins(
        np.array([0, 1, 2, 2]),
        np.zeros(4, dtype=np.int64),
        np.zeros(4),
        np.eye(3)[[0, 1, 2, 2]],
        np.tile(np.eye(3), (4, 1, 1)),
        np.ones(4),
        np.ones(3),
    )
    np.testing.assert_array_equal(bins.of_range, [0, 1, 2, 2])
    stddev_m, weights, worth = np.array([0.1, 0.2, 0.3, 0.3]), np.array([1.0, 0.5, 1.0, 1.0]), np.full(4, 0.5)
    scatter_m2 = np.array([0.01 / 0.5, 0.04 / 0.25, 0.09 / 1.0])
    first, second = np.array([0.3, 0.4, 0.0]), np.array([0.0, 0.0, 1.01 * np.sqrt(scatter_m2[2])])
    covariances = np.array([np.outer(first, first), np.outer(second, second), 9.0 * np.eye(3), 8.0 * np.eye(3)])
    learned = LearnedErrors(("time", "bias", "white", "bending"), np.ones(4), covariances, bins, bins.of_range)
    errors = SimpleNamespace(worth=worth, stddev_m=stddev_m)
    solution: Any = SimpleNamespace(errors=errors, fit=SimpleNamespace(weights=weights))
    of_range = np.array([0, 2, -1, 1, 2])
    found = shared_errors_m(solution, learned, of_range)
    assert found.shape == (5, 2)
    expected = (covariances[0] + covariances[1])[np.ix_(of_range, of_range)]
    expected[2], expected[:, 2] = 0.0, 0.0
    np.testing.assert_allclose(found @ found.T, expected, atol=1e-12)
    # An error that is a little smaller than the scatter is noise to the bin.
    smaller = replace(learned, covariances_m2=covariances * np.array([1.0, 0.97, 1.0, 1.0])[:, None, None])
    assert shared_errors_m(solution, smaller, of_range).shape == (5, 1)
    none: Any = SimpleNamespace(errors=errors, fit=SimpleNamespace(weights=0 * weights))
    assert shared_errors_m(none, learned, of_range).shape == (5, 0)


def test_the_best_weights_are_followed_half_way_but_not_farther_than_chance() -> None:
    """One number, measured twice: the other weights have half of each, the best ones of 1 and 4 parts."""
    errors = ErrorParts(("time", "bias"), np.ones(2), np.array([np.diag([3.0, 0.0]), np.diag([1.0, 1.0])]))
    nothing = np.zeros(0, dtype=np.int64)
    columns = Columns(0, -1, nothing, nothing, 1)
    by_others = np.array([[1.25]])  # of the mean of the two
    chance = np.sqrt(1.25 - 0.8)
    for residual_m, step in (([-1.0, -0.5], 0.6), ([-9.0, 1.0], 1.0)):
        linear = LinearMap(np.array(residual_m), np.ones((2, 1)), np.zeros(0), np.zeros((0, 1)), columns)
        found = KnownMap.between(linear, errors, 0.7, by_others)
        np.testing.assert_allclose(found.half_way, [0.5 * np.sign(step) * min(step, chance)])
        assert found.uncertainty.formal == 0.7
        assert found.uncertainty.components == pytest.approx(
            {"time": np.sqrt(0.04 * 3), "bias": np.sqrt(0.04 + 0.64), "reweighting": abs(found.half_way[0])}
        )
        np.testing.assert_allclose(found.covariance, [[0.8 + found.half_way[0] ** 2]])
        np.testing.assert_allclose(found.best_by_bins, [0.2, 0.8])
    back = KnownMap.between(linear, errors, 0.7, by_others, np.array([-0.2]))
    np.testing.assert_allclose(back.half_way, [-0.1])
    with_prior = LinearMap(np.zeros(2), np.ones((2, 1)), np.zeros(1), np.array([[1.0]]), columns)
    given = KnownMap.between(with_prior, errors, 0.7, by_others).uncertainty.components
    assert given["given"] == pytest.approx(1 / 2.25)

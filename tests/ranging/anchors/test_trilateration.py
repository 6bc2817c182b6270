"""An anchor is located from ranges at known positions, with its mirror image and error, or refused with a reason."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from scipy.stats import chi2
from tests.simulated.path import loop_path
from tests.studies import anchor_initialization

from rangesfm.errors import GeometryError
from rangesfm.geometry.similarity import PathShape
from rangesfm.ranging.anchors import trilateration
from rangesfm.ranging.anchors.point_fit import FitErrors, PointFit, PointProblem, improve
from rangesfm.ranging.anchors.trilateration import (
    AnchorPlacement,
    AnchorRanges,
    Trilateration,
    TrilaterationOptions,
    _conclude,
    _covariance,
    _Found,
    _gap,
    _inverse,
    _mirror,
    _refuse_uncertain,
    _unless_along_plane,
    trilaterate,
    trilaterate_anchors,
)
from rangesfm.ranging.errors.components import COMPONENTS
from rangesfm.ranging.errors.range_bins import range_bins
from rangesfm.ranging.range_log import RangeLog

Array = npt.NDArray[np.float64]

ANCHOR_M = np.array([6.0, -4.0, 3.5])
KNOWN_BIAS = TrilaterationOptions(range_bias_stddev_m=0.0)


def flight(num: int = 100) -> Array:
    """(n, 3) positions on a loop of 8 x 6 m that rises and falls."""
    return loop_path(60.0, height_amplitude_m=1.5, seed=1).centers(np.linspace(0.0, 60.0, num))


def flat(num: int = 100) -> Array:
    """(n, 3) positions on the same loop at a constant height of 1 m."""
    return flight(num) * [1.0, 1.0, 0.0] + [0.0, 0.0, 1.0]


def distances(positions: Array, anchor: Array = ANCHOR_M) -> Array:
    return np.asarray(np.linalg.norm(positions - anchor, axis=1))


def noise(num: int, stddev: float = 0.1, seed: int = 0) -> Array:
    return stddev * np.random.default_rng(seed).standard_normal(num)


def squared_error(found: Trilateration, anchor: Array = ANCHOR_M) -> float:
    """Return the squared error normalized by the covariance; its mean is 3 if the covariance is right."""
    off = found.position_m - anchor
    return float(off @ np.linalg.solve(found.covariance_m2, off))


class TestWithoutNoise:
    @pytest.mark.parametrize("num", [5, 20, 100, 1000])
    @pytest.mark.parametrize("anchor", [(6.0, -4.0, 3.5), (0.2, 0.1, 1.0), (60.0, 20.0, -5.0), (-1.0, 2.0, 9.0)])
    def test_the_anchor_is_exact(self, anchor: tuple[float, float, float], num: int) -> None:
        positions = flight(num)
        found = trilaterate(
            positions, distances(positions, np.array(anchor)), options=TrilaterationOptions(max_position_stddev_m=20.0)
        )
        np.testing.assert_allclose(found.position_m, anchor, atol=1e-6)
        assert found.range_bias_m == pytest.approx(0.0, abs=1e-6)
        assert found.mirror_position_m is None

    def test_it_moves_with_the_frame(self) -> None:
        far = np.array([4.1e5, 5.6e6, 300.0])
        found = trilaterate(flight() + far, distances(flight()), options=KNOWN_BIAS)
        np.testing.assert_allclose(found.position_m, ANCHOR_M + far, atol=1e-6)

    def test_a_known_bias_is_taken_off(self) -> None:
        options = TrilaterationOptions(range_bias_m=0.4, range_bias_stddev_m=0.0)
        found = trilaterate(flight(), distances(flight()) + 0.4, options=options)
        np.testing.assert_allclose(found.position_m, ANCHOR_M, atol=1e-6)
        assert found.range_bias_m == pytest.approx(0.4)
        assert found.range_bias_stddev_m == 0.0

    def test_an_unknown_bias_is_found_as_far_as_its_prior_lets_it(self) -> None:
        options = TrilaterationOptions(range_bias_stddev_m=10.0, range_stddev_m=0.01)
        found = trilaterate(flight(), distances(flight()) + 0.4, options=options)
        np.testing.assert_allclose(found.position_m, ANCHOR_M, atol=1e-3)
        assert found.range_bias_m == pytest.approx(0.4, abs=1e-3)


class TestOutliers:
    @pytest.mark.parametrize("share", [0.2, 0.4, 0.5])
    def test_of_metres_do_not_move_the_anchor(self, share: float) -> None:
        positions, rng = flight(), np.random.default_rng(3)
        is_outlier = np.arange(100) < 100 * share
        wrong = np.where(is_outlier, rng.uniform(1.0, 6.0, 100), noise(100, 0.05))
        order = rng.permutation(100)
        found = trilaterate(positions, distances(positions) + wrong[order], options=KNOWN_BIAS)
        assert np.linalg.norm(found.position_m - ANCHOR_M) < 0.1
        assert np.all(found.weights[is_outlier[order]] < 0.1)
        assert found.noise_stddev_m == pytest.approx(0.05, rel=0.4)

    def test_the_answer_is_the_same_every_time(self) -> None:
        ranges = distances(flight()) + noise(100)
        first, second = (trilaterate(flight(), ranges) for _ in range(2))
        np.testing.assert_array_equal(first.position_m, second.position_m)
        np.testing.assert_array_equal(first.covariance_m2, second.covariance_m2)


class TestPositionsInAPlane:
    def test_give_both_places(self) -> None:
        found = trilaterate(flat(), distances(flat()) + noise(100, 0.02))
        assert found.mirror_position_m is not None
        np.testing.assert_allclose(sorted([found.position_m[2], found.mirror_position_m[2]]), [-1.5, 3.5], atol=0.1)
        np.testing.assert_allclose(found.mirror_position_m[:2], ANCHOR_M[:2], atol=0.1)

    def test_put_no_anchor_into_a_file_that_may_be_at_either(self) -> None:
        either, one = (trilaterate(path, distances(path) + noise(100, 0.02)) for path in (flat(), flight()))
        assert AnchorPlacement("A", 100, either, None).anchor.position_m is None
        np.testing.assert_array_equal(AnchorPlacement("A", 100, one, None).anchor.position_m, one.position_m)

    @pytest.mark.parametrize(("toward", "height"), [((0, 0, 1), 3.5), ((0, 0, -1), -1.5)])
    def test_give_the_one_that_is_asked_for(self, toward: tuple[float, float, float], height: float) -> None:
        found = trilaterate(flat(), distances(flat()) + noise(100, 0.02), toward=toward)
        assert found.mirror_position_m is None
        assert found.position_m[2] == pytest.approx(height, abs=0.1)
        assert squared_error(found, np.array([6.0, -4.0, height])) < chi2.ppf(0.999, 3)

    def test_a_hint_does_not_turn_what_the_ranges_say(self) -> None:
        found = trilaterate(flight(), distances(flight()), toward=(0.0, 0.0, -1.0))
        np.testing.assert_allclose(found.position_m, ANCHOR_M, atol=1e-6)

    @pytest.mark.parametrize("seed", range(3))
    def test_an_anchor_in_the_plane_has_one_place_of_honest_width(self, seed: int) -> None:
        anchor, options = np.array([6.0, -4.0, 1.0]), TrilaterationOptions(max_position_stddev_m=5.0)
        found = trilaterate(flat(), distances(flat(), anchor) + noise(100, seed=seed), options=options)
        assert found.mirror_position_m is None
        height_stddev = np.sqrt(found.covariance_m2[2, 2])
        assert abs(found.position_m[2] - 1.0) < 3 * height_stddev
        assert 0.3 < height_stddev < 2.0


class TestRefusal:
    def refusal(self, positions: Array, **options: float) -> str:
        with pytest.raises(GeometryError) as caught:
            trilaterate(
                positions, distances(positions) + noise(len(positions), 0.02), options=TrilaterationOptions(**options)
            )
        return str(caught.value)

    def test_of_too_few_ranges(self) -> None:
        assert "3 ranges at known positions of the tag, 4 are needed" in self.refusal(flight(3))

    @pytest.mark.parametrize("direction", [(1.0, 0.0, 0.0), (1.0, -2.0, 0.5)])
    def test_of_positions_on_a_line(self, direction: tuple[float, float, float]) -> None:
        line = np.outer(np.linspace(-4.0, 4.0, 100), direction)
        assert "the tag's positions lie on a line, and the anchor may be anywhere on a circle" in self.refusal(line)

    def test_of_positions_that_are_all_alike(self) -> None:
        still = np.zeros((50, 3)) + noise(150, 0.01).reshape(50, 3)
        assert "the tag's positions lie within" in self.refusal(still)

    def test_of_an_anchor_whose_height_above_the_plane_is_not_seen(self) -> None:
        assert "the anchor is near the plane" in self.refusal(
            flat() + np.array([0.0, 0.0, 2.5]), max_position_stddev_m=0.2
        )

    def test_of_an_anchor_less_certain_than_wanted(self) -> None:
        assert "the position is not determined" in self.refusal(flight(), max_position_stddev_m=0.001)


def population_errors(
    from_anchor_m: Array, anchor_index: npt.NDArray[np.int64], times: Array, rng: np.random.Generator
) -> Array:
    """(n,) range errors of a radio drawn from the population, with stddevs of its own."""
    alike = np.tile(np.eye(3), (len(times), 1, 1))
    alone = range_bins(anchor_index, 0 * anchor_index, times, from_anchor_m, alike, np.ones(len(times)), np.ones(4))
    assert len(alone) == len(times)
    errors = np.zeros(len(times))
    for component in COMPONENTS:
        if component.name != "bending":
            stddev = component.median * np.exp(component.spread * rng.standard_normal())
            correlation = component.correlation(alone) + 1e-9 * np.eye(len(times))
            errors += stddev * np.linalg.cholesky(correlation) @ rng.standard_normal(len(times))
    return errors[alone.of_range]


class TestCovariance:
    def test_covers_errors_as_radios_of_the_population_have_them(self) -> None:
        anchors = np.array([(6.0, -4.0, 3.5), (-6.0, -3.0, 0.2), (5.0, 5.0, -0.5), (-4.0, 5.0, 4.0)])
        positions, index = np.repeat(flight(60), 4, axis=0), np.tile(np.arange(4), 60)
        times = np.repeat(np.linspace(0.0, 60.0, 60), 4) + 0.1 * index
        from_anchor = positions - anchors[index]
        pulls = []
        for seed in range(12):
            errors = population_errors(from_anchor, index, times, np.random.default_rng(seed))
            ranges = np.maximum(np.linalg.norm(from_anchor, axis=1) + errors, 0.05)
            log = RangeLog.from_arrays([f"A{k}" for k in index], ranges, timestamp_s=times)
            wide = TrilaterationOptions(max_position_stddev_m=20.0)
            for placement in trilaterate_anchors(log, positions, options=wide):
                assert placement.found is not None
                off = placement.found.position_m - anchors[int(placement.anchor_id[1])]
                pulls.append(off / np.sqrt(np.diag(placement.found.covariance_m2)))
        # The expected share is 95 %. The limit allows three standard errors of twelve radios, each with twelve
        # coordinates whose errors are correlated.
        assert np.mean(np.abs(pulls) < 1.96) > 0.86
        assert 0.7 < np.sqrt(np.mean(np.square(pulls))) < 1.3

    @pytest.mark.parametrize("draw", ["noise", "heteroscedastic", "bias"])
    def test_of_a_radio_better_than_others_is_not_too_small(self, draw: str) -> None:
        """The covariance covers even pure noise, as it allows for other errors that the position would absorb."""
        positions, squares, stddevs = flight(), [], []
        for seed in range(12):
            rng = np.random.default_rng(seed)
            stddev = np.full(100, 0.1)
            given = None
            if draw == "heteroscedastic":
                given = stddev = np.geomspace(0.02, 1.0, 100)[rng.permutation(100)]
            ranges = distances(positions) + stddev * rng.standard_normal(100)
            if draw == "bias":
                ranges += rng.normal(0.0, 0.2)
            options = TrilaterationOptions() if draw == "bias" else KNOWN_BIAS
            found = trilaterate(positions, ranges, range_stddev_m=given, options=options)
            squares.append(squared_error(found))
            stddevs.append(found.position_stddev_m)
        assert np.mean(squares) < chi2.ppf(1 - 5e-4, 36) / 12
        assert np.median(stddevs) < 0.2

    @pytest.mark.parametrize("timed", [True, False])
    def test_covers_errors_that_last(self, timed: bool) -> None:
        """Ten ranges in a row have the same error, for 15 s, and count for hardly more than one."""
        positions, times, squares = flight(200), np.linspace(0.0, 300.0, 200), []
        for seed in range(8):
            ranges = distances(positions) + np.repeat(noise(20, 0.1, seed), 10) + noise(200, 0.03, 99 + seed)
            found = trilaterate(positions, ranges, timestamp_s=times if timed else None, options=KNOWN_BIAS)
            squares.append(squared_error(found))
        assert np.mean(squares) < chi2.ppf(1 - 5e-4, 24) / 8

    def test_anchors_together_say_more_of_their_radio_than_each_alone(self) -> None:
        """An anchor with few ranges benefits from the radio's noise, which the ranges of the other anchors show."""
        positions = flight(200)
        few = np.arange(0, 200, 20)
        anchors = np.array([(-6.0, -3.0, 0.2), (5.0, 5.0, -0.5), (-4.0, 5.0, 4.0)])
        ids = np.concatenate([np.repeat(["B", "C", "D"], 200), np.repeat("A", len(few))])
        places = np.concatenate([np.tile(positions, (3, 1)), positions[few]])
        true = np.concatenate([*(distances(positions, anchor) for anchor in anchors), distances(positions[few])])
        ranges = true + noise(len(true), 0.005)
        log = RangeLog.from_arrays(ids.tolist(), ranges, timestamp_s=np.arange(float(len(true))))
        together = {p.anchor_id: p.found for p in trilaterate_anchors(log, places, options=KNOWN_BIAS)}["A"]
        alone = trilaterate(positions[few], ranges[-len(few) :], options=KNOWN_BIAS)
        assert together is not None
        assert together.position_stddev_m < 0.8 * alone.position_stddev_m


class TestKnownHeight:
    @pytest.mark.parametrize("height", [1.0, 1.1, 3.5])
    def test_positions_in_a_level_plane_do(self, height: float) -> None:
        anchor = np.array([6.0, -4.0, height])
        found = trilaterate(flat(), distances(flat(), anchor) + noise(100, 0.02), height_m=height)
        assert found.mirror_position_m is None
        np.testing.assert_allclose(found.position_m, anchor, atol=0.1)
        assert squared_error(found, anchor) < chi2.ppf(0.999, 3)

    def test_it_is_refused_without_where_the_anchor_stands_in_the_plane(self) -> None:
        site = flight() * [1.0, 1.0, 0.0]
        ranges = distances(site, np.array([6.0, -4.0, 0.0])) + noise(100, 0.1)
        with pytest.raises(GeometryError, match="is near the plane"):
            trilaterate(site, ranges, options=TrilaterationOptions(max_position_stddev_m=0.3))
        found = trilaterate(site, ranges, height_m=0.0, options=TrilaterationOptions(max_position_stddev_m=0.3))
        np.testing.assert_allclose(found.position_m, [6.0, -4.0, 0.0], atol=0.1)

    def test_positions_on_a_level_line_give_both_places_beside_it(self) -> None:
        line = np.outer(np.linspace(-4.0, 4.0, 100), [1.0, 0.0, 0.0])
        ranges = distances(line, np.array([1.0, 3.0, 2.0])) + noise(100, 0.02)
        found = trilaterate(line, ranges, height_m=2.0)
        assert found.mirror_position_m is not None
        np.testing.assert_allclose([found.position_m[1], found.mirror_position_m[1]], [3.0, -3.0], atol=0.1)
        other = trilaterate(line, ranges, height_m=2.0, toward=(0.0, -1.0, 0.0))
        assert other.mirror_position_m is None
        np.testing.assert_allclose(other.position_m, [1.0, -3.0, 2.0], atol=0.1)


def errors_over_seeds(stddevs: Array, *, given: bool) -> list[float]:
    """Return the position errors over seeds, each with ``stddevs`` assigned to the ranges in another order."""
    positions, errors = flight(), []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        stddev = rng.permutation(stddevs)
        ranges = distances(positions) + stddev * rng.standard_normal(100)
        found = trilaterate(positions, ranges, range_stddev_m=stddev if given else None, options=KNOWN_BIAS)
        errors.append(float(np.linalg.norm(found.position_m - ANCHOR_M)))
    return errors


def test_ranges_that_say_how_noisy_they_are_weigh_accordingly() -> None:
    stddevs = np.geomspace(0.02, 1.0, 100)
    assert np.median(errors_over_seeds(stddevs, given=True)) < 0.7 * np.median(errors_over_seeds(stddevs, given=False))


@pytest.mark.parametrize(("given", "limit_m"), [(True, 0.03), (False, 0.05)])
def test_three_good_ranges_in_ten_decide(given: bool, limit_m: float) -> None:
    assert np.median(errors_over_seeds(np.repeat([0.02, 0.5], [30, 70]), given=given)) < limit_m


@pytest.mark.parametrize("options", [TrilaterationOptions(), KNOWN_BIAS], ids=["defaults", "bias known"])
def test_study_in_small_finds_every_anchor_among_15_percent_outliers(options: TrilaterationOptions) -> None:
    summary = anchor_initialization.estimate(0.15, 12, options)
    assert summary.num_refused == 0
    assert np.median(summary.error_m) < 0.10
    assert np.max(summary.error_m) < 0.30
    assert np.mean(summary.squares) < chi2.ppf(1 - 5e-4, 3 * 12) / 12


class TestErrorCurve:
    def test_short_ranges_weigh_in_full_once_their_error_was_learnt(self) -> None:
        positions = 0.2 * flight()
        near = np.array([1.0, -0.8, 1.0])
        ranges = distances(positions, near) + noise(100, 0.05)
        unknown, learnt = (
            trilaterate(positions, ranges, shared_stddev_m=shared, options=KNOWN_BIAS)
            for shared in (None, np.full(100, 0.01))
        )
        assert learnt.position_stddev_m < 0.5 * unknown.position_stddev_m
        assert squared_error(learnt, near) < chi2.ppf(0.999, 3)

    def test_ranges_where_the_curve_was_not_learnt_count_for_less(self) -> None:
        wrong = np.arange(100) % 2 == 0
        ranges = distances(flight()) + noise(100, 0.05) + np.where(wrong, 0.3, 0.0)
        equal, doubted = (
            trilaterate(flight(), ranges, shared_stddev_m=np.where(wrong, stddev, 0.01), options=KNOWN_BIAS)
            for stddev in (0.01, 1.0)
        )
        assert np.linalg.norm(doubted.position_m - ANCHOR_M) < 0.5 * np.linalg.norm(equal.position_m - ANCHOR_M)

    def test_a_log_brings_what_its_curve_left_uncertain(self) -> None:
        ranges = distances(flight()) + noise(100, 0.05)
        shared = np.full(100, 0.2)
        log = RangeLog.from_arrays(["A"] * 100, ranges, timestamp_s=np.arange(100.0), shared_stddev_m=shared)
        (placement,) = trilaterate_anchors(log, flight())
        alone = trilaterate(flight(), ranges, shared_stddev_m=shared, timestamp_s=np.arange(100.0))
        assert placement.found is not None
        np.testing.assert_allclose(placement.found.position_m, alone.position_m, atol=1e-9)
        np.testing.assert_allclose(placement.found.covariance_m2, alone.covariance_m2, atol=1e-9)


class TestRounding:
    """Ambiguous cases are decided by rules that do not depend on rounding, and so the same on every machine."""

    @pytest.mark.parametrize("seed", range(6))
    def test_of_two_places_between_which_no_range_tells_the_upper_one_comes_first(self, seed: int) -> None:
        for height in (3.5, -1.5):
            ranges = distances(flat(), np.array([6.0, -4.0, height])) + noise(100, 0.02, seed)
            found = trilaterate(flat(), ranges)
            assert found.mirror_position_m is not None
            assert found.position_m[2] > 3.0 > found.mirror_position_m[2]

    @pytest.mark.parametrize("toward", [(1.0, 0.0, 0.0), (3.0, 4.0, 1e-15), (0.0, 0.0, 0.0)])
    def test_a_direction_along_the_plane_of_the_positions_leaves_both_places(
        self, toward: tuple[float, float, float]
    ) -> None:
        found = trilaterate(flat(), distances(flat()) + noise(100, 0.02), toward=toward)
        assert found.mirror_position_m is not None

    @pytest.mark.parametrize(("away_m", "seed"), [(20.0, 0), (60.0, 1), (200.0, 2)])
    def test_a_bias_that_is_known_does_not_make_a_place_about_a_line_certain(self, away_m: float, seed: int) -> None:
        """The information of a known bias is 1e12 in metres, which leaves only rounding in an open direction."""
        line = np.outer(np.linspace(-4.0, 4.0, 100), [1.0, 0.0, 0.0])
        ranges = distances(line, np.array([1.0, away_m, 3.0])) + noise(100, 0.02, seed)
        with pytest.raises(GeometryError, match="on a line, and the anchor may be anywhere on a circle"):
            trilaterate(line, ranges, options=KNOWN_BIAS)


INSIDE_M = np.array([0.5, 0.2, 0.3])


def found_in(
    positions: Array, anchor: Array = ANCHOR_M, *, off_m: Array | float = 0.0, stddev_m: float = 0.1, alike: float = 0.0
) -> _Found:
    """A fit to ranges with a prior of the bias of 0.2 m, in which all ranges share a part of their variance."""
    num = len(positions)
    problem = PointProblem(
        positions_m=positions,
        range_m=distances(positions, anchor) + off_m,
        stddev_m=np.full(num, stddev_m),
        shared_stddev_m=np.zeros(num),
        prior_mean=np.zeros(4),
        prior=np.array([[0.0, 0.0, 0.0, 5.0]]),
    )
    fit = PointFit(problem, improve(problem, np.append(anchor, 0.0)), problem.stddev_m)
    covariance = stddev_m**2 * ((1 - alike) * np.eye(num) + alike)
    return _Found.of(fit, FitErrors(np.arange(num), covariance))


def grid() -> Array:
    """Positions of which lengths, widths and heights are the principal axes, with the middle at the origin."""
    steps = np.linspace(-1.0, 1.0, 4)
    return np.stack(np.meshgrid(4 * steps, 3 * steps, 1.5 * steps), axis=-1).reshape(-1, 3)


class TestRangesOfAnAnchor:
    def test_are_timed_by_a_tag_of_a_metre_a_second_where_there_are_no_times(self) -> None:
        places = np.array([[0.0, 0.0, 0.0], [3.0, 4.0, 0.0], [3.0, 4.0, 2.0]])
        np.testing.assert_allclose(AnchorRanges(places, np.ones(3)).times_s, [0.0, 5.0, 7.0])
        timed = AnchorRanges(places, np.ones(3), timestamp_s=np.array([3.0, 9.0, 4.0]), tag_index=np.array([1, 0, 1]))
        np.testing.assert_array_equal(timed.times_s, [3.0, 9.0, 4.0])
        np.testing.assert_array_equal(timed.tags, [1, 0, 1])
        np.testing.assert_array_equal(AnchorRanges(places, np.ones(3)).tags, [0, 0, 0])

    def test_have_the_shape_of_the_path_or_of_its_plan_where_the_height_is_known(self) -> None:
        positions = grid()[:, [2, 1, 0]] + 7.0
        shape, plan = (AnchorRanges(positions, np.ones(64), height_m=height).shape for height in (None, 2.0))
        std = np.linspace(-1.0, 1.0, 4).std()
        np.testing.assert_allclose(shape.stddevs, std * np.array([4.0, 3.0, 1.5]))
        np.testing.assert_allclose(np.abs(shape.axes[:, 0]), [0.0, 0.0, 1.0], atol=1e-12)
        np.testing.assert_allclose(shape.centroid, 0.0, atol=1e-12)
        np.testing.assert_allclose(plan.stddevs, std * np.array([3.0, 1.5, 0.0]), atol=1e-12)

    def asked(
        self, monkeypatch: pytest.MonkeyPatch, anchor: AnchorRanges, **options: Any
    ) -> tuple[PointProblem, Array]:
        """Return the problem that a fit would solve, and the noise it is given."""
        found: list[tuple[PointProblem, Array]] = []
        monkeypatch.setattr(trilateration, "fit_with_own_noise", lambda problem, given: found.append((problem, given)))
        anchor.fit(TrilaterationOptions(**options))
        return found[0]

    def test_are_fitted_about_their_middle_with_a_prior_of_the_bias(self, monkeypatch: pytest.MonkeyPatch) -> None:
        positions = grid() + np.array([10.0, 20.0, 30.0])
        anchor = AnchorRanges(positions, np.full(64, 2.0))
        problem, given = self.asked(monkeypatch, anchor, range_bias_m=0.3, range_bias_stddev_m=0.5)
        np.testing.assert_allclose(problem.positions_m, grid(), atol=1e-12)
        np.testing.assert_array_equal(problem.prior_mean, [0.0, 0.0, 0.0, 0.3])
        np.testing.assert_array_equal(problem.prior, [[0.0, 0.0, 0.0, 2.0]])
        np.testing.assert_allclose(problem.shared_stddev_m, 2.0 * np.exp(-2.0))
        assert np.isnan(given).all()

    def test_hold_a_known_bias_and_a_known_height(self, monkeypatch: pytest.MonkeyPatch) -> None:
        anchor = AnchorRanges(
            grid() + np.array([0.0, 0.0, 5.0]), np.full(64, 2.0), height_m=3.0, shared_stddev_m=np.full(64, 0.07)
        )
        problem, given = self.asked(monkeypatch, anchor, range_bias_stddev_m=0.0, range_stddev_m=0.04)
        np.testing.assert_allclose(problem.prior_mean, [0.0, 0.0, -2.0, 0.0], atol=1e-12)
        np.testing.assert_allclose(problem.prior, [[0.0, 0.0, 0.0, 1e9], [0.0, 0.0, 100.0, 0.0]])
        np.testing.assert_array_equal(problem.shared_stddev_m, 0.07)
        np.testing.assert_array_equal(given, 0.04)

    def test_keep_the_noise_that_they_state(self, monkeypatch: pytest.MonkeyPatch) -> None:
        stated = np.where(np.arange(64) < 9, 0.5, np.nan)
        anchor = AnchorRanges(grid(), np.full(64, 2.0), range_stddev_m=stated)
        np.testing.assert_array_equal(self.asked(monkeypatch, anchor)[1], stated)
        given = self.asked(monkeypatch, anchor, range_stddev_m=0.2)[1]
        np.testing.assert_array_equal(given, np.where(np.arange(64) < 9, 0.5, 0.2))


class TestFound:
    def test_the_prior_gains_what_common_errors_take_from_the_ranges(self) -> None:
        found = found_in(grid(), INSIDE_M, off_m=0.3, alike=0.5)
        assert found.inflation > 1.5
        np.testing.assert_allclose(found.fit.problem.prior, [[0.0, 0.0, 0.0, 5.0 * found.inflation]])
        np.testing.assert_allclose(found.fit.x, improve(found.fit.problem, found.fit.x), atol=1e-7)
        judged = found.judged_by(3.0)
        np.testing.assert_allclose(judged.stddev_m, 0.3)
        np.testing.assert_allclose(judged.prior, [[0.0, 0.0, 0.0, 5.0]])

    def test_the_inverse_of_an_information_is_that_of_numpy(self) -> None:
        root = np.random.default_rng(0).standard_normal((4, 4)) * [[1.0], [2.0], [0.5], [30.0]]
        information = root @ root.T
        np.testing.assert_allclose(_inverse(information), np.linalg.inv(information), rtol=1e-6)

    def test_an_open_direction_is_uncertain_however_well_the_bias_is_known(self) -> None:
        found = _inverse(np.diag([4.0, 4.0, 0.0, 1e12]))
        np.testing.assert_allclose(np.diag(found)[[0, 1, 3]], [0.25, 0.25, 1e-12])
        assert found[2, 2] > 1e10

    def test_the_covariance_of_independent_errors_is_the_inverse_information(self) -> None:
        found = found_in(grid())
        slopes = found.fit.problem.slopes(found.fit.x)
        expected = np.linalg.inv(slopes.T @ slopes / 0.1**2 + np.diag([0.0, 0.0, 0.0, 25.0]))
        np.testing.assert_allclose(_covariance(found), expected, rtol=1e-6, atol=1e-9)

    def test_the_covariance_of_common_errors_is_that_of_the_estimate(self) -> None:
        """The estimate is linear in the errors of the ranges, and in the prior's, which are strengthened for it."""
        found = found_in(grid(), INSIDE_M, alike=0.3)
        slopes = found.fit.problem.slopes(found.fit.x)
        prior = np.diag([0.0, 0.0, 0.0, (5.0 * found.inflation) ** 2])
        inverse = np.linalg.inv(slopes.T @ slopes / 0.1**2 + prior)
        gain = inverse @ slopes.T / 0.1**2
        of_ranges = gain @ (0.1**2 * (0.7 * np.eye(64) + 0.3)) @ gain.T
        of_prior = np.outer(inverse[:, 3], inverse[:, 3]) * 25.0 * found.inflation**4
        np.testing.assert_allclose(_covariance(found), of_ranges + of_prior, rtol=1e-6, atol=1e-9)

    def test_the_height_above_a_plane_is_as_uncertain_as_the_cost_says(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """An anchor in the plane at a distance of 5 m: a height of h lengthens all ranges by about h^2 / 10."""
        monkeypatch.setattr(trilateration, "_PROFILE_STEPS_M", np.geomspace(0.2, 2.0, 11))
        flat = np.array([5.0, 0.0, 0.0]) + 0.5 * grid()[::4] * [1.0, 1.0, 0.0]
        found = found_in(flat, np.zeros(3), stddev_m=0.05)
        covariance = _covariance(found)
        # It is one of the heights at which the cost was computed, of which ten make a decade.
        height = float(np.sqrt(covariance[2, 2]))
        assert rise_at(found, 10**-0.1 * height) < 0.5 < rise_at(found, 1.001 * height)
        np.testing.assert_allclose(covariance[2, [0, 1, 3]], 0.0, atol=1e-3)
        # The horizontal coordinates keep the covariance of their curvature.
        level = found.fit.problem.slopes(found.fit.x)[:, [0, 1, 3]]
        expected = np.linalg.inv(level.T @ level / 0.05**2 + np.diag([0.0, 0.0, 25.0]))
        np.testing.assert_allclose(covariance[:2, :2], expected[:2, :2], rtol=0.02, atol=1e-9)


def rise_at(found: _Found, height: float) -> float:
    """Return by how much the cost rises if the point is held at a height, with the other unknowns free."""
    problem, at = found.fit.problem, np.array([0.0, 0.0, height, 0.0])
    held = replace(problem, prior=np.vstack([problem.prior, [0.0, 0.0, 1e5, 0.0]]), prior_mean=at)
    return problem.cost(improve(held, at)) - problem.cost(found.fit.x)


class TestRefusalByTheCovariance:
    AXES = np.eye(3)

    def said(self, stddevs_m: list[float], extents_m: list[float], turn: Array = AXES, limit_m: float = 1.0) -> str:
        covariance = np.zeros((4, 4))
        covariance[:3, :3] = turn @ np.diag(np.square(stddevs_m)) @ turn.T
        shape = PathShape(np.zeros(3), np.eye(3), np.array(extents_m))
        with pytest.raises(GeometryError) as caught:
            _refuse_uncertain(covariance, shape, TrilaterationOptions(max_position_stddev_m=limit_m))
        return str(caught.value)

    def test_is_of_a_larger_stddev_than_allowed_in_any_direction(self) -> None:
        shape = PathShape(np.zeros(3), np.eye(3), np.ones(3))
        _refuse_uncertain(np.diag([0.99**2, 0.5, 0.1, 9.0]), shape, TrilaterationOptions())
        assert self.said([1.02, 0.5, 0.1], [3.0, 2.0, 1.0]) == (
            "the position is not determined: the tag's positions extend over 3 by 2 m only, or are too far away "
            "(stddev 1 m along 1.00, 0.00, 0.00)"
        )

    @pytest.mark.parametrize(("length_m", "is_short"), [(0.199, True), (0.201, False)])
    def test_names_positions_within_a_tenth_of_what_is_allowed(self, length_m: float, is_short: bool) -> None:
        said = self.said([2.5, 1.0, 1.0], [length_m, 0.1, 0.0], limit_m=2.0)
        assert (f"the tag's positions lie within {length_m:.3g} m of each other (stddev 2.5 m" in said) == is_short

    @pytest.mark.parametrize(("width_m", "is_line"), [(0.119, True), (0.121, False)])
    def test_names_a_path_that_is_nearly_straight(self, width_m: float, is_line: bool) -> None:
        said = self.said([0.1, 500.0, 0.3], [4.0, width_m, 0.0])
        assert ("lie on a line, and the anchor may be anywhere on a circle around that line" in said) == is_line
        assert said.endswith("(stddev 1e+02 m along 0.00, 1.00, 0.00)")

    @pytest.mark.parametrize(("angle_deg", "is_across"), [(44.0, True), (46.0, False), (-155.0, True)])
    def test_names_the_direction_across_the_plane(self, angle_deg: float, is_across: bool) -> None:
        """It is the nearest of the plane's axes up to 45 degrees."""
        cosine, sine = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
        turn = np.array([[cosine, 0.0, sine], [0.0, 1.0, 0.0], [-sine, 0.0, cosine]])
        said = self.said([0.1, 0.2, 5.0], [4.0, 3.0, 0.1], turn)
        assert ("the anchor is near the plane of the tag's positions" in said) == is_across
        upward = np.abs(cosine), np.sign(cosine) * sine
        assert said.endswith(f"(stddev 5 m along {upward[1]:.2f}, 0.00, {upward[0]:.2f})")


class TestMirrorImage:
    FLAT = grid() * [1.0, 1.0, 0.0]

    def test_in_a_plane_fits_as_well(self) -> None:
        found = found_in(self.FLAT)
        mirror = _mirror(found, _covariance(found), np.zeros(3), np.array([0.0, 0.0, 1.0]))
        assert mirror is not None
        np.testing.assert_allclose(mirror[:3], ANCHOR_M * [1.0, 1.0, -1.0], atol=1e-6)
        assert _gap(found, mirror) == pytest.approx(0.0, abs=1e-6)

    def test_is_about_the_middle_of_the_path(self) -> None:
        raised = self.FLAT + np.array([0.0, 0.0, 1.0])
        found = found_in(raised)
        mirror = _mirror(found, _covariance(found), np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, 1.0]))
        assert mirror is not None
        np.testing.assert_allclose(mirror[:3], ANCHOR_M * [1.0, 1.0, 0.0] + [0.0, 0.0, 2.0 - ANCHOR_M[2]], atol=1e-6)

    def test_of_an_anchor_within_two_stddevs_of_the_plane_is_the_same_place(self) -> None:
        """The images are 7 m apart."""
        found = found_in(self.FLAT)
        up = np.array([0.0, 0.0, 1.0])
        for stddev, is_other in ((3.4, True), (3.6, False)):
            mirror = _mirror(found, np.diag([0.0, 0.0, stddev**2, 0.0]), np.zeros(3), up)
            assert (mirror is not None) == is_other

    @pytest.mark.parametrize(("stddev_m", "is_told"), [(0.9, False), (1.1, True)])
    def test_whose_cost_is_larger_by_four_and_a_half_is_told_from_the_anchor(
        self, stddev_m: float, is_told: bool
    ) -> None:
        """The limit is a difference of the costs, which is as the inverse of the noise's variance."""
        tilted = grid() * [1.0, 1.0, 0.12]
        unit = found_in(tilted, stddev_m=0.3)
        up = np.array([0.0, 0.0, 1.0])
        other = improve(unit.fit.problem, np.append(ANCHOR_M * [1.0, 1.0, -1.0], 0.0))
        squares = np.sum(unit.fit.problem.residuals_m(other) ** 2)
        assert _gap(unit, other) == pytest.approx(0.5 * squares / 0.3**2, rel=0.1)
        found = found_in(tilted, stddev_m=stddev_m * float(np.sqrt(squares / 9)))
        assert (_mirror(found, 1e-9 * np.eye(4), np.zeros(3), up) is not None) == is_told

    def test_costs_less_by_errors_that_the_ranges_have_in_common(self) -> None:
        tilted = grid() * [1.0, 1.0, 0.12]
        found = found_in(tilted, stddev_m=1.0)
        other = improve(found.fit.problem, np.append(ANCHOR_M * [1.0, 1.0, -1.0], 0.0))
        four_times = replace(found.errors, covariance_m2=4 * found.errors.covariance_m2)
        assert _gap(replace(found, errors=four_times), other) == pytest.approx(_gap(found, other) / 4, rel=0.03)

    def test_is_told_by_a_direction_unless_that_is_along_the_plane(self) -> None:
        up = np.array([0.0, 0.0, 7.0])
        for direction, tells in (([3.0, 4.0, 6e-7], True), ([3.0, 4.0, 4e-7], False), ([0.0, 0.0, -1.0], True)):
            told = _unless_along_plane(np.array(direction), up)
            assert (told is not None) == tells


class TestConclusion:
    """Positions in a plane at a height of 1 m, whose middle is off the origin."""

    FLAT = TestMirrorImage.FLAT + np.array([10.0, 0.0, 1.0])

    def concluded(self, side: float, **known: Any) -> Trilateration:
        anchor = AnchorRanges(self.FLAT, distances(self.FLAT, np.array([16.0, -4.0, 3.5])), **known)
        found = found_in(TestMirrorImage.FLAT, np.array([6.0, -4.0, 2.5 * side]))
        return _conclude(anchor, found, TrilaterationOptions())

    @pytest.mark.parametrize("side", [1.0, -1.0])
    def test_puts_the_upper_of_two_places_first(self, side: float) -> None:
        found = self.concluded(side)
        np.testing.assert_allclose(found.position_m, [16.0, -4.0, 3.5], atol=1e-6)
        assert found.mirror_position_m is not None
        np.testing.assert_allclose(found.mirror_position_m, [16.0, -4.0, -1.5], atol=1e-6)
        np.testing.assert_allclose(found.residuals_m, 0.0, atol=1e-6)
        assert found.noise_stddev_m == 0.1
        assert 0.0 < found.range_bias_stddev_m < 0.2

    @pytest.mark.parametrize("side", [1.0, -1.0])
    @pytest.mark.parametrize(("toward", "height"), [([0.0, 1.0, 2.0], 3.5), ([0.0, 1.0, -2.0], -1.5)])
    def test_takes_the_place_that_is_told(self, side: float, toward: list[float], height: float) -> None:
        found = self.concluded(side, toward=np.array(toward))
        np.testing.assert_allclose(found.position_m, [16.0, -4.0, height], atol=1e-6)
        assert found.mirror_position_m is None

    def test_has_no_stddev_of_a_bias_that_is_known(self) -> None:
        anchor = AnchorRanges(self.FLAT, distances(self.FLAT))
        known = TrilaterationOptions(range_bias_stddev_m=0.0)
        assert _conclude(anchor, found_in(TestMirrorImage.FLAT), known).range_bias_stddev_m == 0.0

    def test_becomes_an_anchor_with_its_stddev_and_bias(self) -> None:
        found = replace(
            self.concluded(1.0), covariance_m2=np.diag([1.0, 4.0, 7.0]), range_bias_m=0.1, range_bias_stddev_m=0.02
        )
        assert found.position_stddev_m == 2.0
        both, one, none = (
            AnchorPlacement("A", 64, each, None).anchor
            for each in (found, replace(found, mirror_position_m=None), None)
        )
        assert (both.position_m, both.position_stddev_m) == (None, 0.0)
        assert (both.range_bias_m, both.range_bias_stddev_m) == (0.1, 0.02)
        assert one.position_m is not None
        assert (one.position_stddev_m, one.range_bias_m, one.range_bias_stddev_m) == (2.0, 0.1, 0.02)
        assert none.anchor_id == "A"
        assert none.position_m is None


def test_each_anchor_of_a_log_has_its_ranges_at_known_places_and_what_is_known_of_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked: list[tuple[Mapping[str, AnchorRanges], TrilaterationOptions]] = []
    monkeypatch.setattr(trilateration, "_trilaterate_together", lambda *given: asked.append(given))
    log = RangeLog.from_arrays(
        ["a", "b", "a", "b"],
        [1.0, 2.0, 3.0, 4.0],
        timestamp_s=[0.0, 1.0, 2.0, 3.0],
        range_stddev_m=[0.1, 0.2, 0.3, 0.4],
        tag_id=["t", "t", "u", "u"],
    )
    places = np.arange(12.0).reshape(4, 3)
    places[0, 1] = np.nan
    trilaterate_anchors(log, places, toward={"a": [0, 0, 1]}, height_m={"b": 2.5})
    anchors, options = asked[0]
    assert options == TrilaterationOptions()
    a, b = anchors["a"], anchors["b"]
    np.testing.assert_array_equal(a.tag_positions_m, places[[2]])
    np.testing.assert_array_equal(a.range_m, [3.0])
    np.testing.assert_array_equal(b.range_m, [2.0, 4.0])
    np.testing.assert_array_equal(b.range_stddev_m, [0.2, 0.4])
    np.testing.assert_array_equal(b.timestamp_s, [1.0, 3.0])
    np.testing.assert_array_equal(b.tags, [0, 1])
    np.testing.assert_array_equal(a.toward, [0.0, 0.0, 1.0])
    assert (b.toward, a.height_m, b.height_m, a.shared_stddev_m) == (None, None, 2.5, None)
    trilaterate_anchors(replace(log, shared_stddev_m=np.arange(4.0)), places, options=KNOWN_BIAS)
    anchors, options = asked[1]
    assert options is KNOWN_BIAS
    np.testing.assert_array_equal(anchors["b"].shared_stddev_m, [1.0, 3.0])
    assert (anchors["a"].toward, anchors["a"].height_m) == (None, None)


def test_anchors_without_enough_ranges_are_told_and_do_not_hinder_others(monkeypatch: pytest.MonkeyPatch) -> None:
    calibrated: list[bool] = []

    def errors(fits: list[PointFit], times: object, tags: object, *, is_calibrated: bool) -> list[FitErrors]:
        calibrated.append(is_calibrated)
        return [FitErrors(np.arange(len(fit.own_stddev_m)), np.diag(fit.own_stddev_m**2)) for fit in fits]

    monkeypatch.setattr(trilateration, "errors_of_fits", errors)
    monkeypatch.setattr(trilateration, "_profile_stddev", lambda *given: 50.0)
    monkeypatch.setattr(AnchorRanges, "fit", lambda anchor, options: found_in(anchor.tag_positions_m).fit)

    def ranges(num: int, shared: float | None) -> AnchorRanges:
        places = grid()[np.linspace(0, 63, num).astype(np.int64)]
        return AnchorRanges(places, distances(places), shared_stddev_m=None if shared is None else np.full(num, shared))

    anchors = {"few": ranges(3, None), "all": ranges(64, 0.1), "least": ranges(4, 0.1)}
    options = TrilaterationOptions(max_position_stddev_m=0.3)
    few, whole, least = trilateration._trilaterate_together(anchors, options)
    assert (few.anchor_id, few.num_ranges, few.found) == ("few", 3, None)
    assert few.why_not == "3 ranges at known positions of the tag, 4 are needed"
    assert whole.found is not None
    np.testing.assert_allclose(whole.found.position_m, ANCHOR_M, atol=1e-6)
    assert (whole.why_not, whole.num_ranges) == (None, 64)
    assert least.found is None
    assert "the position is not determined" in str(least.why_not)
    assert calibrated == [True]
    trilateration._trilaterate_together(anchors | {"other": ranges(64, None)}, options)
    assert calibrated == [True, False]
    assert trilateration._trilaterate_together({"few": ranges(3, None)}, options)[0].found is None

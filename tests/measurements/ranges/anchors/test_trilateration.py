"""An anchor is located from ranges at known positions, with its mirror image and error, or refused with a reason."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from scipy.stats import chi2
from tests.simulated.path import loop_path

from rangesfm.errors import GeometryError
from rangesfm.measurements.ranges.anchors.trilateration import (
    Trilateration,
    TrilaterationOptions,
    trilaterate,
    trilaterate_anchors,
)
from rangesfm.measurements.ranges.errors.components import COMPONENTS
from rangesfm.measurements.ranges.errors.range_bins import range_bins
from rangesfm.measurements.ranges.range_log import RangeLog

Array = npt.NDArray[np.float64]

ANCHOR_M = np.array([6.0, -4.0, 3.5])
KNOWN_BIAS = TrilaterationOptions(range_bias_stddev_m=0.0)


def flight(num: int = 100) -> Array:
    """(n, 3) positions on a loop of 8 x 6 m that rises and falls."""
    return loop_path(60.0, height_amplitude_m=1.5, seed=1).centers(np.linspace(0.0, 60.0, num))


def flat() -> Array:
    """(100, 3) positions on the same loop at a constant height of 1 m."""
    return flight() * [1.0, 1.0, 0.0] + [0.0, 0.0, 1.0]


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

    def test_that_read_short_are_found_though_short_ranges_err(self) -> None:
        positions, rng = flight(), np.random.default_rng(0)
        is_outlier = rng.permutation(100) < 40
        ranges = distances(positions) + noise(100, 0.05)
        found = trilaterate(positions, np.where(is_outlier, ranges * rng.uniform(0.02, 0.5, 100), ranges))
        assert np.all(found.weights[is_outlier] < 0.1)
        assert found.position_stddev_m < 0.3
        assert squared_error(found) < chi2.ppf(0.999, 3)


class TestPositionsInAPlane:
    def test_give_both_places(self) -> None:
        found = trilaterate(flat(), distances(flat()) + noise(100, 0.02))
        assert found.mirror_position_m is not None
        np.testing.assert_allclose(sorted([found.position_m[2], found.mirror_position_m[2]]), [-1.5, 3.5], atol=0.1)
        np.testing.assert_allclose(found.mirror_position_m[:2], ANCHOR_M[:2], atol=0.1)

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


def test_three_good_ranges_in_ten_decide() -> None:
    stddevs = np.repeat([0.02, 0.5], [30, 70])
    known, unknown = (np.median(errors_over_seeds(stddevs, given=given)) for given in (True, False))
    assert known < 0.03
    assert unknown < 0.5 * np.median(errors_over_seeds(np.full(100, 0.3), given=False))


class TestErrorCurve:
    def test_short_ranges_say_more_once_their_error_was_learnt(self) -> None:
        positions = 0.2 * flight()
        near = np.array([1.0, -0.8, 1.0])
        ranges = distances(positions, near) + noise(100, 0.05)
        unknown = trilaterate(positions, ranges - 0.3 * np.exp(-distances(positions, near)), options=KNOWN_BIAS)
        learnt = trilaterate(positions, ranges, shared_stddev_m=np.full(100, 0.01), options=KNOWN_BIAS)
        assert learnt.position_stddev_m < 0.95 * unknown.position_stddev_m
        for found in (unknown, learnt):
            assert squared_error(found, near) < chi2.ppf(0.999, 3)

    def test_ranges_where_the_curve_was_not_learnt_count_for_less(self) -> None:
        wrong = np.arange(100) % 2 == 0
        ranges = distances(flight()) + noise(100, 0.05) + np.where(wrong, 0.3, 0.0)
        equal, doubted = (
            trilaterate(flight(), ranges, shared_stddev_m=np.where(wrong, stddev, 0.01), options=KNOWN_BIAS)
            for stddev in (0.01, 1.0)
        )
        assert np.linalg.norm(doubted.position_m - ANCHOR_M) < 0.5 * np.linalg.norm(equal.position_m - ANCHOR_M)


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

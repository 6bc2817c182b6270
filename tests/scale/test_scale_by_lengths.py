"""The scale by measured lengths alone: its uncertainty, and which length contradicts the others."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import special
from tests.known import known

from rangesfm.arrays import Array, Mask
from rangesfm.distances.locate_lengths import LocatedDistances
from rangesfm.errors import GeometryError
from rangesfm.scale.linear_map import FALSE_ALARM_RATE
from rangesfm.scale.scale_by_lengths import LengthScale, ScaleByKind, _Lengths, _quantile, scale_by_lengths

SCALE, TAPE_M = 0.45, 0.005


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(7)


def path(rng: np.random.Generator) -> Array:
    """(60, 3) random positions in a room, in a unit of their own."""
    return rng.uniform(-1, 1, (60, 3)) * [4.0, 5.0, 2.0]


def located(centers: Array, num: int, rng: np.random.Generator, bending: float = 0.0) -> LocatedDistances:
    """Taped distances between cameras at least a metre apart, in a map where each has a slightly different scale."""
    pairs = [(a, b) for a, b in rng.permuted(np.tile(np.arange(60), (500, 1)), axis=1)[:, :2].tolist()]
    ends = np.array([centers[[a, b]] for a, b in pairs if np.linalg.norm(centers[a] - centers[b]) > 1 / SCALE][:num])
    model = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    metric = SCALE * model * np.exp(bending * rng.standard_normal(num)) + TAPE_M * rng.standard_normal(num)
    return replace(LocatedDistances.of(metric, np.full(num, TAPE_M), model_length=model), ends=ends)


def scaled(distances: LocatedDistances, centers: Array) -> LengthScale:
    return known(scale_by_lengths(distances, centers))


@pytest.mark.parametrize("bending", [0.0, 0.004])
def test_the_interval_holds_the_truth_and_honest_lengths_stay(bending: float) -> None:
    rng, off, num_left_out = np.random.default_rng(0), [], 0
    for _ in range(60):
        centers = path(rng)
        found = scaled(located(centers, 3, rng, bending), centers)
        off.append(np.log(found.value / SCALE) / found.relative_stddev)
        num_left_out += int(np.count_nonzero(~found.is_kept))
    assert np.mean(np.abs(off) < 1.96) >= 0.9
    assert num_left_out <= 3


@pytest.mark.parametrize("off_m", [1.0, -0.3])
def test_a_mistyped_length_is_left_out_and_its_size_found(rng: np.random.Generator, off_m: float) -> None:
    centers = path(rng)
    honest = located(centers, 5, rng)
    wrong = replace(honest, distance_m=honest.distance_m + off_m * (np.arange(5) == 2))
    found = scaled(wrong, centers)
    np.testing.assert_array_equal(found.is_kept, np.arange(5) != 2)
    assert found.too_long_m[2] == pytest.approx(off_m, abs=4 * found.stddev_m[2])
    assert found.statistic[2] > found.threshold[2]
    assert found.value == pytest.approx(SCALE, rel=0.01)


def test_the_threshold_of_a_length_allows_for_every_size_that_the_bending_may_have(rng: np.random.Generator) -> None:
    """Errors of lengths that are wrong by the bending alone are proportional to its size."""
    taped = located(path(rng), 4, rng, bending=0.004)
    lengths = _Lengths.of(replace(taped, stddev_m=np.full(4, 1e-9)), np.arange(4), 10.0)
    fit = lengths.fit(np.arange(4) != 2)
    limit = np.sqrt(lengths.test(np.ones(4, dtype=bool), 2).threshold)
    risk = 2 * fit.probabilities @ special.ndtr(-limit / fit.sizes)
    assert risk == pytest.approx(FALSE_ALARM_RATE / 4, rel=1e-3)


def test_nothing_checks_a_single_length(rng: np.random.Generator) -> None:
    centers = path(rng)
    found = scaled(located(centers, 1, rng), centers)
    assert np.isinf(found.stddev_m[0])
    assert found.statistic[0] == 0
    assert found.is_kept.all()


def test_the_other_kinds_tell_whether_a_single_length_is_wrong(rng: np.random.Generator) -> None:
    """Positions and ranges agree against a mistyped length; a length and ranges agree against wrong positions."""
    centers = path(rng)
    honest = located(centers, 1, rng)
    mistyped = replace(honest, distance_m=1.09 * honest.distance_m)
    right, wrong = ScaleByKind(SCALE, 0.01 * SCALE), ScaleByKind(1.09 * SCALE, 0.01 * SCALE)
    left_out = known(scale_by_lengths(mistyped, centers, [right, right]))
    assert not left_out.is_used
    assert left_out.beside_ranges(mistyped).distance_m.size == 0
    assert left_out.too_long_m[0] == pytest.approx(0.09 * honest.distance_m[0], rel=0.2)
    assert known(scale_by_lengths(mistyped, centers, [right])).is_used
    assert known(scale_by_lengths(honest, centers, [right, wrong])).is_used
    assert known(scale_by_lengths(honest, centers, [right, right])).value == scaled(honest, centers).value


def test_of_two_that_contradict_each_other_none_is_left_out_and_the_interval_says_so(rng: np.random.Generator) -> None:
    centers = path(rng)
    honest = located(centers, 2, rng)
    found = scaled(replace(honest, distance_m=honest.distance_m * [1.0, 1.2]), centers)
    assert found.is_kept.all()
    assert found.relative_stddev > 0.03


def test_printed_sides_are_wrong_together(rng: np.random.Generator) -> None:
    centers = path(rng)
    alone = scaled(located(centers, 8, rng), centers)
    sides = replace(located(centers, 8, rng), is_printed=np.ones(8, dtype=bool))
    sides = replace(sides, distance_m=SCALE * sides.model_length, stddev_m=0.01 * sides.distance_m)
    together = scaled(sides, centers)
    assert together.components["tape"] == pytest.approx(0.01, rel=0.05)
    assert alone.components["tape"] < 0.6 * TAPE_M / (1.0 * np.sqrt(4))


def test_checks_have_no_say_and_two_ends_in_one_place_none_at_all(rng: np.random.Generator) -> None:
    centers = path(rng)
    given = located(centers, 2, rng)
    assert scale_by_lengths(replace(given, is_check=np.ones(2, dtype=bool)), centers) is None
    assert scale_by_lengths(None, centers) is None
    with pytest.raises(GeometryError, match="both its ends in one place"):
        scale_by_lengths(replace(given, model_length=np.array([0.0, 1.0])), centers)


EXTENT = 10.0


def lengths_of(
    model: list[float], metric: list[float], tape_m: float | list[float] = TAPE_M, *, is_everywhere: bool = False
) -> _Lengths:
    """Lengths at unknown places of a map, which its bending makes wrong one by one."""
    num = len(model)
    taped = LocatedDistances.of(np.array(metric), np.full(num, tape_m), model_length=np.array(model))
    taped = replace(taped, is_everywhere=np.full(num, is_everywhere))
    return _Lengths.of(taped, np.arange(num), EXTENT)


def all_of(lengths: _Lengths) -> Mask:
    return np.ones(len(lengths.model), dtype=bool)


def test_the_scale_of_a_map_varies_smoothly_along_its_lengths() -> None:
    """Each length sees the mean along its way; the correlation falls over a quarter of the path's extent."""
    places = [np.linspace([0.0, 0.0, 0.0], [4.0, 0.0, 0.0], 8), np.linspace([1.0, 2.0, 0.0], [1.0, 2.0, 3.0], 8)]
    places.append(np.full((8, 3), np.nan))
    taped = LocatedDistances.of(np.array([1.8, 1.4, 2.2]), np.full(3, 0.01), model_length=np.array([4.0, 3.0, 5.0]))
    ends = np.array([[way[0], way[-1]] for way in places])
    taped = replace(taped, ends=ends, mark_stddev=np.array([0.1, 0.2, 0.3]))
    lengths = _Lengths.of(taped, np.array([0, 1, 2]), EXTENT)

    def alike(one: Array, other: Array) -> float:
        return float(np.mean([np.exp(-0.5 * np.sum((a - b) ** 2) / 2.5**2) for a in one for b in other]))

    expected = np.array([[alike(one, other) for other in places] for one in places])
    # A length at unknown ends has a scale of its own.
    expected[2], expected[:, 2] = [0.0, 0.0, 1.0], [0.0, 0.0, 1.0]
    np.testing.assert_allclose(lengths.of_bending, expected * np.outer([4.0, 3.0, 5.0], [4.0, 3.0, 5.0]))
    np.testing.assert_allclose(lengths.of_marks, np.diag([0.01, 0.04, 0.09]))
    np.testing.assert_allclose(lengths.of_tape_m2, 1e-4 * np.eye(3))
    part = _Lengths.of(replace(taped, is_everywhere=np.array([False, True, False])), np.array([2, 1]), EXTENT)
    np.testing.assert_allclose(part.of_bending, np.diag([25.0, 0.0]))
    np.testing.assert_allclose(part.model, [5.0, 3.0])
    np.testing.assert_allclose(part.metric, [2.2, 1.4])


def test_only_printed_sides_have_the_error_of_their_size_in_common() -> None:
    taped = LocatedDistances.of(np.ones(3), np.array([0.01, 0.02, 0.03]), model_length=np.ones(3))
    lengths = _Lengths.of(replace(taped, is_printed=np.array([True, False, True])), np.arange(3), EXTENT)
    expected = [[1e-4, 0.0, 3e-4], [0.0, 4e-4, 0.0], [3e-4, 0.0, 9e-4]]
    np.testing.assert_allclose(lengths.of_tape_m2, expected)


def test_a_length_below_a_billionth_of_the_path_has_both_ends_in_one_place() -> None:
    lengths_of([1.0, 1.05e-9 * EXTENT], [1.0, 1.0])
    with pytest.raises(GeometryError, match="both its ends in one place"):
        lengths_of([1.0, 0.95e-9 * EXTENT], [1.0, 1.0])


def test_other_scales_are_lengths_of_one_unit_that_know_no_bending() -> None:
    lengths = lengths_of([2.0], [1.0], 0.1).beside([ScaleByKind(0.5, 0.02), ScaleByKind(0.6, 0.03)])
    np.testing.assert_allclose(lengths.model, [2.0, 1.0, 1.0])
    np.testing.assert_allclose(lengths.metric, [1.0, 0.5, 0.6])
    np.testing.assert_allclose(lengths.of_tape_m2, np.diag([0.01, 4e-4, 9e-4]))
    np.testing.assert_allclose(lengths.of_marks, np.zeros((3, 3)))
    np.testing.assert_allclose(lengths.of_bending, np.diag([4.0, 0.0, 0.0]))
    assert len(lengths_of([2.0], [1.0]).beside([]).model) == 1


def test_one_length_says_nothing_of_the_bending_which_is_as_in_other_maps() -> None:
    """The root mean square of a lognormal number with a spread of 0.6 is its median times exp(0.36)."""
    lengths = lengths_of([4.0], [2.0], 0.01)
    fit = lengths.fit(all_of(lengths))
    assert fit.scale == pytest.approx(0.5)
    assert fit.bending == pytest.approx(0.008 * np.exp(0.36), rel=1e-4)
    assert fit.probabilities @ fit.sizes**2 == pytest.approx(1.0)
    assert fit.probabilities @ np.log(fit.sizes * fit.bending / 0.008) ** 2 == pytest.approx(0.36, rel=1e-3)
    np.testing.assert_allclose(fit.gains, [0.25])
    assert fit.parts["bending"][0, 0] == pytest.approx((2.0 * fit.bending) ** 2)
    assert fit.parts["tape"][0, 0] == pytest.approx(1e-4)


@pytest.mark.parametrize("ratio", [1.0, 1.02, 1.05])
def test_the_size_of_the_bending_is_learnt_from_how_lengths_differ(ratio: float) -> None:
    """The ratio of two lengths is normal with the sum of their variances; sizes of the bending are integrated over."""
    lengths = lengths_of([4.0, 5.0], [2.0, 2.5 * ratio], [0.004, 0.01])
    fit = lengths.fit(all_of(lengths))
    logs = np.linspace(-5.0, 6.0, 20001)
    variances = [2 * (0.5 * 0.008 * np.exp(logs)) ** 2 + 0.001**2 + 0.002**2]
    apart = 0.5 * (ratio - 1)
    densities = np.exp(-0.5 * (logs / 0.6) ** 2 - 0.5 * apart**2 / variances[0]) / np.sqrt(variances[0])
    expected = 0.008 * np.sqrt(densities @ np.exp(2 * logs) / densities.sum())
    # The errors of marks and of the bending are proportional to the scale, which is a little above a half.
    assert fit.bending == pytest.approx(expected, rel=0.002 + 0.7 * (ratio - 1))
    own = (fit.scale * fit.bending) ** 2 + np.array([0.001, 0.002]) ** 2
    assert fit.scale == pytest.approx(np.average([0.5, 0.5 * ratio], weights=1 / own), rel=1e-4)
    np.testing.assert_allclose(fit.gains @ lengths.model, 1.0)
    assert fit.gains @ lengths.metric == pytest.approx(fit.scale)


def test_errors_of_marks_are_errors_of_the_model_which_the_scale_makes_metres() -> None:
    lengths = replace(lengths_of([4.0, 4.0], [2.0, 2.04], is_everywhere=True), of_marks=np.diag([0.0, 0.01]))
    fit = lengths.fit(all_of(lengths))
    own = 0.005**2 + np.array([0.0, 0.01 * fit.scale**2])
    assert fit.scale == pytest.approx(np.average([0.5, 0.51], weights=1 / own), rel=1e-5)
    np.testing.assert_allclose(fit.parts["marks"], np.diag([0.0, 0.01 * fit.scale**2]), rtol=1e-3)


def test_a_length_is_tested_against_what_the_others_predict() -> None:
    """The others predict 0.5 with a stddev by the sum of their weights if nothing bends and errors are independent."""
    model, tape_m = np.array([4.0, 2.0, 6.0, 3.0]), np.array([0.01, 0.02, 0.02, 0.03])
    metric = 0.5 * model + np.array([0.0, 0.1, 0.0, 5.0])
    lengths = lengths_of(model.tolist(), metric.tolist(), tape_m.tolist(), is_everywhere=True)
    kept = np.array([True, True, True, False])
    for k in (1, 3):
        others = kept & (np.arange(4) != k)
        weights = (model / tape_m)[others] ** 2
        scale, variance = np.average((metric / model)[others], weights=weights), 1 / weights.sum()
        found = lengths.test(kept, k)
        assert found.too_long_m == pytest.approx(metric[k] - model[k] * scale)
        of_all = model[k] ** 2 * variance + tape_m[k] ** 2
        assert found.stddev_m == pytest.approx(np.sqrt(of_all))
        assert found.redundancy == pytest.approx(tape_m[k] ** 2 / of_all)
        assert found.threshold == pytest.approx(special.chdtri(1, FALSE_ALARM_RATE / 4))
        assert found.excess == pytest.approx((found.too_long_m / found.stddev_m) ** 2 / found.threshold)
    assert lengths.test(kept, 1).too_long_m == pytest.approx(0.1)


def test_a_fit_of_all_lengths_may_stand_for_that_of_the_others() -> None:
    lengths = lengths_of([4.0, 5.0, 6.0], [2.0, 2.6, 3.0])
    of_all = lengths.fit(all_of(lengths))
    bent = replace(of_all, bending=10 * of_all.bending)
    own, by_all, by_bent = (lengths.test(all_of(lengths), 1, fit) for fit in (None, of_all, bent))
    assert own.stddev_m < by_all.stddev_m < by_bent.stddev_m
    relative = (TAPE_M / np.array([4.0, 5.0, 6.0])) ** 2 + (bent.scale * bent.bending) ** 2
    by_others = 1 / (1 / relative[0] + 1 / relative[2])
    assert by_bent.stddev_m == pytest.approx(5.0 * np.sqrt(relative[1] + by_others))


def test_nothing_predicts_the_only_length_that_is_kept() -> None:
    lengths = lengths_of([4.0, 5.0], [2.0, 2.5])
    found = lengths.test(np.array([True, False]), 0)
    assert found[:3] == (0.0, np.inf, 0.0)
    assert found.threshold == pytest.approx(special.chdtri(1, FALSE_ALARM_RATE / 2))
    assert found.excess == 0.0


@pytest.mark.parametrize(
    ("factors", "kept"),
    [
        ([1.0, 1.3], [True, True]),
        ([1.0, 1.001, 1.3], [True, True, False]),
        ([1.0, 1.001, 1.3, 1.6], [True, True, True, False]),
        ([1.0, 1.001, 0.999, 1.3, 1.6], [True, True, True, False, False]),
        ([1.0, 1.001, 0.999, 1.002, 0.998], [True, True, True, True, True]),
        ([1.0, 1.001, 0.999, 1.002, 1.4, 0.6, 1.9], [True, True, True, True, False, False, False]),
    ],
)
def test_a_minority_of_lengths_is_left_out_the_worst_first(factors: list[float], kept: list[bool]) -> None:
    model = [4.0, 5.0, 6.0, 4.5, 5.5, 3.5, 4.2][: len(factors)]
    lengths = lengths_of(model, [0.45 * each * factor for each, factor in zip(model, factors, strict=True)])
    np.testing.assert_array_equal(lengths.agreeing(), kept)


def test_the_scale_per_metre_of_each_length_and_the_components_by_cause() -> None:
    """The weights do not depend on the lengths, in which the scale is linear, if there are no bending and no marks."""
    model, metric = np.array([4.0, 5.0, 6.0]), np.array([2.0, 2.51, 3.0])
    taped = LocatedDistances.of(metric, np.full(3, 0.01), model_length=model)
    taped = replace(taped, is_everywhere=np.ones(3, dtype=bool))
    found = scaled(taped, ROOM)
    for row in range(3):
        longer = scaled(replace(taped, distance_m=metric + 1e-3 * np.eye(3)[row]), ROOM)
        assert found.by_metre[row] == pytest.approx(1e3 * (longer.value / found.value - 1), rel=1e-6)
    weights = model / (model @ model)
    assert found.components["tape"] == pytest.approx(0.01 * np.linalg.norm(weights) / found.value)
    assert found.components["marks"] == found.components["bending"] == 0.0
    assert found.relative_stddev == pytest.approx(found.components["tape"])
    assert found.alone == ScaleByKind(found.value, found.value * found.relative_stddev)
    np.testing.assert_allclose(found.statistic, (found.too_long_m / found.stddev_m) ** 2)
    marked = scaled(replace(taped, mark_stddev=np.full(3, 0.02)), ROOM)
    # Both errors have the same share in each length, so that the weights stay.
    assert marked.components["marks"] == pytest.approx(0.02 * np.linalg.norm(weights), rel=1e-6)


def test_lengths_that_are_checks_or_between_anchors_or_left_out_have_no_effect() -> None:
    metric = np.array([9.0, 9.0, 2.0, 2.5, 3.0, 5.0])
    taped = LocatedDistances.of(
        metric,
        np.full(6, 0.01),
        model_length=np.array([1.0, np.nan, 4.0, 5.0, 6.0, 7.0]),
        anchor_pair=np.array([[-1, -1], [0, 1], [-1, -1], [-1, -1], [-1, -1], [-1, -1]]),
    )
    found = scaled(replace(taped, is_check=np.arange(6) == 0), ROOM)
    np.testing.assert_array_equal(found.rows, [2, 3, 4, 5])
    np.testing.assert_array_equal(found.is_kept, [True, True, True, False])
    assert found.value == pytest.approx(0.5)
    assert found.by_metre[3] == 0.0
    assert np.all(found.by_metre[:3] > 0)
    assert found.too_long_m[3] == pytest.approx(1.5)
    # Where the other scales contradict all of the lengths, the scale is still theirs.
    one = scaled(taped.subset(np.arange(6) == 2), ROOM)
    others = [ScaleByKind(0.7, 0.001), ScaleByKind(0.7, 0.001)]
    alone = known(scale_by_lengths(taped.subset(np.arange(6) == 2), ROOM, others))
    assert not alone.is_used
    assert alone.value == pytest.approx(0.5)
    np.testing.assert_allclose(alone.by_metre, one.by_metre)
    assert alone.by_metre[0] == pytest.approx(1 / 2.0)


def test_beside_ranges_one_length_stands_for_all_between_points() -> None:
    one = np.ones(2)
    components = {"tape": 0.03, "marks": 0.04, "bending": 0.12}
    rows = np.arange(2)
    lengths = LengthScale(0.5, components, rows, one > 0, one, one, one, one, one)
    taped = LocatedDistances.of(
        np.array([2.0, 7.0, 3.0]),
        np.array([0.1, 0.2, 0.3]),
        model_length=np.array([4.0, np.nan, 6.0]),
        anchor_pair=np.array([[-1, -1], [0, 1], [-1, -1]]),
    )
    beside, bent = lengths.beside_ranges(taped), lengths.beside_ranges(taped, with_bending=True)
    np.testing.assert_allclose(beside.distance_m, [0.5, 7.0])
    np.testing.assert_allclose(beside.stddev_m, [0.5 * 0.05, 0.2])
    np.testing.assert_allclose(bent.stddev_m, [0.5 * 0.13, 0.2])
    np.testing.assert_array_equal(beside.model_length, [1.0, np.nan])
    np.testing.assert_array_equal(beside.anchor_pair, [[-1, -1], [0, 1]])
    assert len(replace(lengths, is_kept=one < 0).beside_ranges(taped)) == 1
    assert replace(lengths, is_kept=np.array([False, True])).is_used
    assert lengths.scaled_by(4.0).value == pytest.approx(0.125)


def test_the_quantile_of_equal_variances_is_found_however_their_probabilities_are_rounded() -> None:
    """Lengths of the same two points, taped twice, do not differ by a bending of the map."""
    for seed in range(50):
        probabilities = np.random.default_rng(seed).random(21)
        probabilities /= probabilities.sum()
        found = _quantile(np.full(21, 0.0004), probabilities, 0.004)
        assert found == pytest.approx(-0.02 * special.ndtri(0.002), rel=1e-6)


def test_the_quantile_of_normal_numbers_is_between_those_of_their_variances() -> None:
    half = np.array([0.5, 0.5])
    for risk in (0.02, 0.3):
        assert _quantile(np.array([4.0, 4.0]), half, risk) == pytest.approx(-2 * special.ndtri(risk / 2), rel=1e-6)
        both = _quantile(np.array([1.0, 9.0]), half, risk)
        assert 2 * half @ special.ndtr([-both, -both / 3]) == pytest.approx(risk, rel=1e-6)
        # A number without any variance never exceeds anything; rounding may make its variance negative.
        none = _quantile(np.array([-1e-9, 9.0]), half, risk)
        assert special.ndtr(-none / 3) == pytest.approx(risk, rel=1e-6)


ROOM = np.random.default_rng(3).uniform(-1, 1, (60, 3)) * [4.0, 5.0, 2.0]

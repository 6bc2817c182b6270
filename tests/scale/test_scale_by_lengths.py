"""The scale by measured lengths alone: its uncertainty, and which length contradicts the others."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tests.known import known

from rangesfm.arrays import Array
from rangesfm.distances.locate_lengths import LocatedDistances
from rangesfm.errors import GeometryError
from rangesfm.scale.scale_by_lengths import LengthScale, ScaleByKind, scale_by_lengths

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

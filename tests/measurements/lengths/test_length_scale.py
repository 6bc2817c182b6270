"""The scale by measured lengths: its uncertainty, and which length contradicts all else."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.sparse import csr_array
from tests.known import known

from rangesfm.arrays import Array
from rangesfm.errors import GeometryError
from rangesfm.measurements.lengths.length_scale import LengthScale, lengths_between_points
from rangesfm.measurements.lengths.lengths_on_map import lengths_on_map
from rangesfm.measurements.lengths.locate_lengths import LocatedDistances
from rangesfm.measurements.ranges.scale.range_start import scales_by
from rangesfm.solver.bending import Bending, MapBending, bending_parts
from rangesfm.solver.linear_map import Columns
from rangesfm.solver.noise import Component
from rangesfm.solver.posterior import Observations
from rangesfm.util.geometry.similarity import IDENTITY
from rangesfm.util.geometry.trajectory import Trajectory

SCALE, TAPE_M = 0.45, 0.005
NUM = 60


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(7)


def walked(rng: np.random.Generator) -> Trajectory:
    """Random positions in a room, in a unit of their own."""
    centers = rng.uniform(-1, 1, (NUM, 3)) * [4.0, 5.0, 2.0]
    names = tuple(f"{k}.jpg" for k in range(NUM))
    return Trajectory(np.arange(NUM), names, np.arange(float(NUM)), centers, np.tile(np.eye(3), (NUM, 1, 1)))


@dataclass(frozen=True)
class Shaken:
    """The bending of a map whose poses err independently, by an amount that is learnt."""

    path: Trajectory
    median: float = 0.01

    def of_functions(self, by_pose: Array, *, frame_is_free: bool) -> Bending:
        found = bending_parts("bending", by_pose @ by_pose.T, self.median, 0.8)
        nothing = np.zeros(len(by_pose))
        return Bending(found, np.diag(nothing), nothing)


def located(
    path: Trajectory, num: int, rng: np.random.Generator, shaken: float = 0.0, tape_m: float = TAPE_M
) -> LocatedDistances:
    """Taped distances between cameras at least a metre apart, whose places in the map err."""
    true = path.centers - shaken * rng.standard_normal(path.centers.shape)
    rows: list[tuple[int, int]] = []
    while len(rows) < num:
        a, b = rng.choice(NUM, 2, replace=False)
        if np.linalg.norm(path.centers[a] - path.centers[b]) > 1 / SCALE:
            rows.append((a, b))
    start, end = np.array(rows).T
    away = path.centers[end] - path.centers[start]
    model = np.linalg.norm(away, axis=1)
    metric = SCALE * np.linalg.norm(true[end] - true[start], axis=1) + tape_m * rng.standard_normal(num)
    slopes = np.zeros((num, NUM, 6))
    slopes[np.arange(num), end, 3:] += away / model[:, None]
    slopes[np.arange(num), start, 3:] -= away / model[:, None]
    found = LocatedDistances.between_points(metric, np.full(num, tape_m), model)
    return replace(found, by_pose=csr_array(slopes.reshape(num, -1)))


def scaled(
    distances: LocatedDistances,
    path: Trajectory,
    others: Sequence[Observations] = (),
    bending: MapBending | None = None,
) -> LengthScale:
    lengths = known(lengths_between_points(distances, bending or Shaken(path)))
    return lengths.tested(replace(IDENTITY, scale=SCALE) if others else lengths.start, others)


def other(kind: str, longer: float = 0.0) -> Observations:
    """Another kind of measurement, by which the map is larger than it is."""
    one, used = np.array([[0.01**2]]), np.ones(1, dtype=bool)
    return Observations(
        Columns.of_whole(1),
        np.ones((1, 1)),
        np.array([-longer]),
        kind=kind,
        by_pose=np.zeros((1, 6 * NUM)),
        components=(Component(kind, one),),
        alone_m2=one,
        is_used=used,
    )


@pytest.mark.parametrize("median", [0.0001, 0.01])
def test_the_interval_holds_the_truth_and_honest_lengths_stay(median: float) -> None:
    """Maps bend by as much as the population lets expect."""
    rng, off, num_left_out = np.random.default_rng(1), [], 0
    for _ in range(100):
        path = walked(rng)
        shaken = median * float(np.exp(0.8 * rng.standard_normal()))
        found = scaled(located(path, 3, rng, shaken), path, bending=Shaken(path, median))
        off.append(np.log(found.alone.scale.value / SCALE) / found.alone.posterior.uncertainty.empirical)
        num_left_out += int(np.count_nonzero(~found.is_kept))
    assert np.mean(np.abs(off) < 1.96) >= 0.9
    assert num_left_out <= 4


@pytest.mark.parametrize("off_m", [1.0, -0.3])
def test_a_mistyped_length_is_left_out_and_its_size_found(rng: np.random.Generator, off_m: float) -> None:
    path = walked(rng)
    honest = located(path, 5, rng)
    found = scaled(replace(honest, distance_m=honest.distance_m + off_m * (np.arange(5) == 2)), path)
    np.testing.assert_array_equal(found.is_kept, np.arange(5) != 2)
    assert found.errors[2].sizes[0] == pytest.approx(off_m, abs=4 * found.errors[2].stddevs[0])
    assert found.errors[2].statistic > found.threshold
    assert found.alone.scale.value == pytest.approx(SCALE, rel=0.01)


def test_nothing_checks_a_single_length(rng: np.random.Generator) -> None:
    path = walked(rng)
    found = scaled(located(path, 1, rng), path)
    assert np.isinf(found.errors[0].stddevs[0])
    assert found.errors[0].statistic == 0
    assert found.is_kept.all()


def test_the_other_kinds_tell_whether_a_single_length_is_wrong(rng: np.random.Generator) -> None:
    """Positions and ranges agree against a mistyped length; a length and ranges agree against wrong positions."""
    path = walked(rng)
    honest = located(path, 1, rng)
    mistyped = replace(honest, distance_m=1.09 * honest.distance_m)
    left_out = scaled(mistyped, path, [other("ranges"), other("positions")])
    assert not left_out.is_used
    assert not scales_by([left_out])
    assert left_out.errors[0].sizes[0] == pytest.approx(0.09 * honest.distance_m[0], rel=0.2)
    assert scaled(mistyped, path, [other("ranges")]).is_used
    assert scaled(honest, path, [other("ranges"), other("positions", 0.09)]).is_used
    beside = scaled(honest, path, [other("ranges"), other("positions")])
    assert beside.alone.scale == scaled(honest, path).alone.scale
    assert np.isfinite(beside.errors[0].stddevs[0])


def test_of_two_that_contradict_each_other_none_is_left_out_and_the_interval_says_so(rng: np.random.Generator) -> None:
    path = walked(rng)
    honest = located(path, 2, rng)
    found = scaled(replace(honest, distance_m=honest.distance_m * [1.0, 1.2]), path)
    assert found.is_kept.all()
    assert found.alone.posterior.uncertainty.empirical > 0.03


def test_printed_sides_are_wrong_together(rng: np.random.Generator) -> None:
    path = walked(rng)
    alone = scaled(located(path, 8, rng), path)
    sides = replace(located(path, 8, rng), is_printed=np.ones(8, dtype=bool))
    true_m = SCALE * sides.model_length
    sides = replace(sides, distance_m=true_m, stddev_m=0.01 * true_m)
    together = scaled(sides, path)
    assert together.alone.posterior.uncertainty.components["tape"] == pytest.approx(0.01, rel=0.05)
    assert alone.alone.posterior.uncertainty.components["tape"] < 0.6 * TAPE_M / (1.0 * np.sqrt(4))


def test_checks_have_no_say_and_two_ends_in_one_place_none_at_all(rng: np.random.Generator) -> None:
    path = walked(rng)
    given = located(path, 2, rng)
    assert lengths_between_points(replace(given, is_check=np.ones(2, dtype=bool)), Shaken(path)) is None
    with pytest.raises(GeometryError, match="both its ends in one place"):
        lengths_between_points(replace(given, model_length=np.array([0.0, 1.0])), Shaken(path))


def test_without_bending_lengths_weigh_by_tape_and_marks(rng: np.random.Generator) -> None:
    """Errors of marks are errors of the model, which the scale makes metres."""
    path = walked(rng)
    model, mark_stddev = np.array([4.0, 4.0]), np.array([0.0, 0.1])
    taped = LocatedDistances.between_points(np.array([2.0, 2.04]), np.full(2, 0.005), model)
    found = scaled(replace(taped, mark_stddev=mark_stddev), path)
    own = 0.005**2 + (mark_stddev * found.alone.scale.value) ** 2
    assert found.alone.scale.value == pytest.approx(np.average([0.5, 0.51], weights=1 / own), rel=1e-5)
    stddevs = found.alone.posterior.uncertainty.components
    assert np.hypot(stddevs["tape"], stddevs["marks"]) == pytest.approx(1 / np.sqrt(np.sum(2.0**2 / own)), rel=0.02)


def test_a_length_is_tested_against_what_the_others_predict(rng: np.random.Generator) -> None:
    model, tape_m = np.array([4.0, 2.0, 6.0]), np.array([0.01, 0.02, 0.02])
    taped = LocatedDistances.between_points(0.5 * model + np.array([0.0, 0.04, 0.0]), tape_m, model)
    found = scaled(taped, walked(rng))
    weights = (model / tape_m)[[0, 2]] ** 2
    variance = model[1] ** 2 / weights.sum() + tape_m[1] ** 2
    assert found.is_kept.all()
    assert found.errors[1].sizes[0] == pytest.approx(0.04, rel=0.01)
    assert found.errors[1].stddevs[0] == pytest.approx(np.sqrt(variance), rel=0.01)
    assert found.errors[1].redundancy == pytest.approx(tape_m[1] ** 2 / variance, rel=0.01)


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
def test_a_minority_of_lengths_is_left_out_the_worst_first(
    factors: list[float], kept: list[bool], rng: np.random.Generator
) -> None:
    path = walked(rng)
    honest = located(path, len(factors), rng, tape_m=1e-4)
    taped = replace(honest, distance_m=honest.distance_m * factors, stddev_m=np.full(len(factors), TAPE_M))
    np.testing.assert_array_equal(scaled(taped, path).is_kept, kept)


def test_a_length_depends_on_the_poses_of_its_ends(rng: np.random.Generator) -> None:
    path = walked(rng)
    found = lengths_on_map(located(path, 4, rng), SCALE, NUM, np.ones(4, dtype=bool))
    by_pose = found.by_pose.reshape(4, NUM, 6)
    assert not by_pose[:, :, :3].any()
    np.testing.assert_allclose(np.linalg.norm(by_pose[:, :, 3:], axis=2).sum(axis=1), 2 * SCALE)
    np.testing.assert_allclose(by_pose[:, :, 3:].sum(axis=1), 0.0, atol=1e-12)


def test_beside_ranges_the_scale_by_them_stands_for_all_lengths_between_points(rng: np.random.Generator) -> None:
    path = walked(rng)
    lengths = scaled(located(path, 2, rng), path)
    alone = lengths.alone.scale
    assert scales_by([lengths]) == (alone,)
    [in_other_unit] = scales_by([lengths], 3.0)
    assert in_other_unit.value == pytest.approx(3 * alone.value)
    assert in_other_unit.stddev == pytest.approx(3 * alone.stddev)
    assert not scales_by([replace(lengths, is_kept=np.zeros(2, dtype=bool))])


def test_beside_ranges_control_lengths_between_anchors_are_used_one_by_one() -> None:
    nothing, stddevs_m = np.full(4, np.nan), np.array([0.1, 0.2, 0.3, 0.4])
    taped = LocatedDistances.between_points(np.array([2.0, 7.0, 3.0, 4.0]), stddevs_m, nothing)
    pairs, is_check = np.array([[-1, -1], [0, 1], [2, 1], [0, 2]]), np.array([False, False, True, False])
    found = replace(taped, anchor_pair=pairs, is_check=is_check).between_anchors
    np.testing.assert_array_equal(found.anchor_pair, [[0, 1], [0, 2]])
    np.testing.assert_array_equal(found.distance_m, [7.0, 4.0])
    np.testing.assert_array_equal(found.stddev_m, [0.2, 0.4])

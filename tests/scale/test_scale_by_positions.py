"""The similarity by known positions: its robust fit, the errors to expect, and control points that contradict it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import comb
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from scipy import stats
from scipy.sparse import csr_array
from scipy.spatial.transform import Rotation
from tests.known import known
from tests.scale.test_position_equations import known_positions

from rangesfm.errors import GeometryError
from rangesfm.geometry.similarity import IDENTITY, Similarity
from rangesfm.geometry.trajectory import Trajectory
from rangesfm.positions.known_positions import KnownPositions
from rangesfm.ranging.errors.bending import BendingOfBins, ErrorPart
from rangesfm.ranging.errors.learned import ErrorParts
from rangesfm.scale import scale_by_positions as by_positions
from rangesfm.scale.position_equations import at_point
from rangesfm.scale.scale_by_lengths import LengthScale
from rangesfm.scale.scale_by_positions import (
    PositionScale,
    _determine,
    _Fit,
    _Problem,
    expected_positions,
    groups_by_pose,
    moved_similarity,
    refuse_open_turn,
    scale_by_positions,
)

Array = npt.NDArray[np.float64]

TURN = Rotation.from_rotvec([0.3, -0.5, 1.1]).as_matrix()
SITE_FROM_MODEL = Similarity(2.0, TURN, np.array([10.0, -4.0, 1.0]))


@dataclass(frozen=True)
class Bending:
    """A map with the same bending in all coordinates."""

    path: Trajectory
    formal_m: float = 0.0
    shift_m: float = 0.0

    def of_functions(self, by_pose: Array, *, frame_is_free: bool) -> BendingOfBins:
        num = len(by_pose)
        parts = (ErrorPart("bending", np.eye(num), 0.001, spread=1.0),) if self.formal_m else ()
        return BendingOfBins(parts, self.formal_m**2 * np.eye(num), np.full(num, self.shift_m))


def path() -> Trajectory:
    """Three poses; the first is not at the origin of the model and not along its axes."""
    rotations = Rotation.from_rotvec([[0.2, 0.1, -0.4], [0.0, 0.0, 0.3], [0.5, 0.0, 0.0]]).as_matrix()
    centers = np.array([[1.0, 0.5, -0.3], [2.0, 0.0, 0.0], [3.0, 1.0, 0.5]])
    return Trajectory(np.arange(3), ("a", "b", "c"), np.arange(3.0), centers, rotations)


def survey(is_mark: list[bool], noise_m: float = 0.0, stddev_m: float = 0.1, seed: int = 0) -> KnownPositions:
    """Positions in a model of some metres, the antenna's with lever arms."""
    rng, positions = np.random.default_rng(seed), known_positions(is_mark, 3, stddev_m)
    arms_m = np.where(positions.is_mark[:, None], 0.0, 0.5 * rng.standard_normal((len(is_mark), 3)))
    placed = replace(positions, places=3.0 * rng.standard_normal((len(is_mark), 3)), arms_m=arms_m)
    return replace(
        placed, position_m=placed.predicted_m(SITE_FROM_MODEL) + noise_m * rng.standard_normal((len(is_mark), 3))
    )


def problem(
    positions: KnownPositions,
    lengths: LengthScale | None = None,
    refined: Similarity | None = None,
    bending: Bending | None = None,
    lasting_s: tuple[float, ...] = (),
) -> _Problem:
    return _Problem(positions, path(), bending or Bending(path()), lengths, refined, lasting_s)


def length_scale(value: float, relative_stddev: float) -> LengthScale:
    one = np.ones(1)
    return LengthScale(value, {"tape": relative_stddev}, np.zeros(1, dtype=np.int64), one > 0, *np.ones((5, 1)))


def finite_differences(positions: KnownPositions) -> Array:
    """(3 k, 7) changes of the positions by a step from the true similarity, per unit of each number."""
    steps = 1e-6 * np.eye(7)

    def at(step: Array) -> Array:
        return positions.predicted_m(moved_similarity(SITE_FROM_MODEL, step, path())).ravel()

    return np.stack([(at(each) - at(-each)) / 2e-6 for each in steps], axis=1)


def assert_same(found: Similarity, expected: Similarity, atol: float = 1e-8) -> None:
    assert found.scale == pytest.approx(expected.scale, rel=atol)
    np.testing.assert_allclose(found.rotation, expected.rotation, atol=atol)
    np.testing.assert_allclose(found.translation, expected.translation, atol=atol)


def test_a_similarity_is_scaled_and_turned_about_the_first_camera_and_that_is_shifted() -> None:
    step = np.array([0.2, 0.1, -0.3, 0.4, 5.0, 6.0, 7.0])
    moved = moved_similarity(SITE_FROM_MODEL, step, path())
    before, after = SITE_FROM_MODEL.apply(path().centers), moved.apply(path().centers)
    np.testing.assert_allclose(after[0], before[0] + [5.0, 6.0, 7.0])
    turned = Rotation.from_rotvec([0.1, -0.3, 0.4]).apply(before - before[0])
    np.testing.assert_allclose(after - after[0], np.exp(0.2) * turned)
    assert moved.scale == pytest.approx(2.0 * np.exp(0.2))


@pytest.mark.parametrize(("log_scale", "grown"), [(0.9, 0.9), (5.0, 1.0), (-0.9, -0.9), (-5.0, -1.0)])
def test_one_step_changes_the_scale_by_a_factor_of_e_at_most(log_scale: float, grown: float) -> None:
    moved = moved_similarity(SITE_FROM_MODEL, log_scale * np.eye(7)[0], path())
    assert moved.scale == pytest.approx(2.0 * np.exp(grown))


def test_the_design_is_the_finite_difference_and_lever_arms_do_not_scale() -> None:
    positions = survey([True, False, True, False])
    np.testing.assert_allclose(problem(positions)._design(SITE_FROM_MODEL), finite_differences(positions), atol=1e-7)


def test_lengths_say_by_how_many_standard_deviations_the_scale_is_too_large() -> None:
    positions = survey([True] * 3)
    residual, design = problem(positions, length_scale(1.9, 0.02))._priors(SITE_FROM_MODEL)
    np.testing.assert_allclose(residual, [np.log(2.0 / 1.9) / 0.02])
    np.testing.assert_allclose(design, [[50.0, 0, 0, 0, 0, 0, 0]])
    none, nothing = problem(positions)._priors(SITE_FROM_MODEL)
    assert (none.shape, nothing.shape) == ((0,), (0, 7))


def test_given_standard_deviations_grow_with_the_median_of_what_is_left() -> None:
    """Seven positions have 21 coordinates, of which seven fit the similarity."""
    positions = known_positions([True] * 7, stddev_m=0.1)
    sizes = np.arange(1.0, 8.0)
    positions = replace(positions, covariance_m2=sizes[:, None, None] ** 2 * positions.covariance_m2)
    median = float(stats.chi.median(3))
    # In standard deviations, four residuals are small and three are large: the median is that of the small ones.
    lengths = np.array([9.0, 9.0, 9.0, 2.5, 2.5, 2.5, 2.5])
    off_m = (0.1 * sizes * lengths)[:, None] * np.array([0.6, 0.0, -0.8])
    used = np.ones(7, dtype=bool)
    grown = problem(positions)._stddevs_m(off_m, used)
    np.testing.assert_allclose(grown, 0.1 * sizes * 2.5 * np.sqrt(1.5) / median, rtol=1e-3)
    np.testing.assert_allclose(problem(positions)._stddevs_m(0.3 * off_m, used), 0.1 * sizes)
    # Positions that are left out do not count, but get what the others have.
    five = used & (np.arange(7) > 1)
    others = problem(positions)._stddevs_m(np.where(five[:, None], off_m, 1e3), five)
    np.testing.assert_allclose(others, 0.1 * sizes * 2.5 * np.sqrt(15 / 8) / median, rtol=1e-3)


def test_unknown_standard_deviations_come_from_what_is_left_of_their_own_kind() -> None:
    positions = known_positions([True, True, False, False, False], stddev_m=0.1)
    unknown = np.where(positions.is_mark[:, None, None], positions.covariance_m2, np.nan)
    positions = replace(positions, covariance_m2=unknown)
    off_m = np.array([[1e-3, 0, 0], [0, 1e-3, 0], [0, 0, 0.02], [0.02, 0, 0], [0, 0.02, 0]])
    used = np.ones(5, dtype=bool)
    found = problem(positions)._stddevs_m(off_m, used)
    expected = 0.02 * np.sqrt(15 / 8) / float(stats.chi.median(3))
    np.testing.assert_allclose(found, [0.1, 0.1, expected, expected, expected], rtol=1e-3)
    exact = problem(positions)._stddevs_m(np.zeros((5, 3)), used)
    np.testing.assert_allclose(exact, [0.1, 0.1, 1e-9, 1e-9, 1e-9])
    # Without any of a kind, nothing is known of it; two positions have less than seven coordinates.
    marks = problem(positions)._stddevs_m(100 * off_m, positions.is_mark)
    np.testing.assert_allclose(marks[:2], 0.1 * np.sqrt(6) / float(stats.chi.median(3)), rtol=1e-3)
    np.testing.assert_array_equal(marks[2:], 1.0)


def test_without_errors_the_similarity_is_exact_and_all_count() -> None:
    positions = survey([True, True, False, False, True])
    used = np.arange(5) != 4
    wrong = replace(positions, position_m=positions.position_m + np.where(used, 0.0, 100.0)[:, None])
    similarity, weights, stddev_m = problem(wrong).robust(used, None)
    assert_same(similarity, SITE_FROM_MODEL)
    np.testing.assert_allclose(weights, [1.0, 1.0, 1.0, 1.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(stddev_m, 0.1)


@pytest.mark.parametrize("lengths", [None, length_scale(2.2, 0.01)])
@pytest.mark.parametrize("start", [SITE_FROM_MODEL, Similarity(2.3, TURN, np.array([11.0, -4.0, 1.0]))])
def test_the_robust_fit_is_where_the_weighted_residuals_balance(lengths: LengthScale | None, start: Similarity) -> None:
    positions = survey([True] * 5 + [False] * 5, noise_m=0.1)
    positions = replace(positions, position_m=positions.position_m + 4.0 * (np.arange(10) == 2)[:, None])
    used = np.ones(10, dtype=bool)
    of_all = problem(positions, lengths)
    similarity, weights, stddev_m = of_all.robust(used, start)
    off_m = positions.misclosures_m(similarity)
    away = np.sqrt(np.sum(off_m**2, axis=1) / 3) / stddev_m
    np.testing.assert_allclose(weights, 1 / (1 + (away / 2.385) ** 2), rtol=1e-6)
    assert weights[2] < 0.1 < 0.5 < np.delete(weights, 2).min()
    pulls = np.repeat(weights / stddev_m**2, 3) * off_m.ravel()
    balance = pulls @ of_all._design(similarity)
    if lengths is not None:
        balance[0] += np.log(similarity.scale / 2.2) / 0.01**2
    np.testing.assert_allclose(balance, 0.0, atol=1e-3)
    size = np.abs(pulls) @ np.abs(of_all._design(similarity))
    assert np.all(np.abs(balance) < 1e-6 * size)


def test_a_refined_map_keeps_its_place_and_only_outliers_are_told_apart() -> None:
    positions = survey([True] * 6)
    positions = replace(positions, position_m=positions.position_m + 3.0 * (np.arange(6) == 2)[:, None])
    refined = Similarity(2.0, TURN, SITE_FROM_MODEL.translation + 0.05)
    similarity, weights, _ = problem(positions, refined=refined).robust(np.ones(6, dtype=bool), IDENTITY)
    assert similarity is refined
    expected = np.where(np.arange(6) == 2, 1 / (1 + (29.5 / 2.385) ** 2), 1 / (1 + (0.5 / 2.385) ** 2))
    np.testing.assert_allclose(weights, expected, rtol=1e-9)


def parts_of(positions: KnownPositions, lasting_s: tuple[float, ...] = (), bending: Bending | None = None) -> Any:
    """The parts of the errors by name, with positions that are not averaged and an assumed size of 0.7 m."""
    of_all, k = problem(positions, lasting_s=lasting_s, bending=bending), len(positions)
    grouping = csr_array(np.eye(3 * k))
    bent = of_all.bending.of_functions(np.zeros((3 * k, 18)), frame_is_free=True)
    parts = list(of_all._parts(SITE_FROM_MODEL, grouping, np.full(k, 0.7), bent))
    assert len({part.name for part in parts}) == len(parts)
    return {part.name: part for part in parts}


def test_marks_err_by_their_places_in_the_photos_and_by_the_survey_of_their_points() -> None:
    positions = survey([True, True])
    own = np.array([[0.04, 0.01, 0.0], [0.01, 0.09, 0.02], [0.0, 0.02, 0.01]])
    positions = replace(positions, own_covariance=np.stack([own, 2 * own]))
    parts = parts_of(positions, bending=Bending(path(), 0.1))
    assert [*parts] == ["bending", "marks", "points"]
    marks = parts["marks"]
    assert (marks.median_m, marks.spread) == (1.0, 0.0)
    np.testing.assert_allclose(marks.alike[:3, :3], 4 * TURN @ own @ TURN.T)
    np.testing.assert_allclose(marks.alike[3:, 3:], 8 * TURN @ own @ TURN.T)
    np.testing.assert_allclose(parts["points"].alike, 0.01 * np.eye(6))
    assert (parts["points"].median_m, parts["points"].spread) == (1.0, 0.0)
    # What was not given with a point is only assumed, and what is unknown is guessed from what is left.
    some = parts_of(replace(positions, is_stated=np.array([True, False])))["points"]
    assert some.spread == 0.5
    unknown = parts_of(replace(positions, covariance_m2=np.full((2, 3, 3), np.nan)))["points"]
    np.testing.assert_allclose(unknown.alike, 0.49 * np.eye(6))
    assert unknown.spread == 1.0


def test_an_antenna_errs_by_its_arm_and_its_own_words_are_only_believed_within_limits() -> None:
    positions = survey([False, False, True])
    positions = replace(positions, arm_stddev_m=np.array([0.02, 0.03, 0.5]))
    parts = parts_of(positions)
    assert [*parts][:4] == ["marks", "points", "places", "positions"]
    np.testing.assert_allclose(parts["places"].alike, np.diag(np.repeat([0.0004, 0.0009, 0.0], 3)))
    np.testing.assert_allclose(parts["positions"].alike, np.diag(np.repeat([0.01, 0.01, 0.0], 3)))
    np.testing.assert_allclose(parts["points"].alike, np.diag(np.repeat([0.0, 0.0, 0.01], 3)))
    assert (parts["positions"].spread, parts["points"].spread) == (0.5, 0.0)
    assert "marks" not in parts_of(survey([False, False]))


def test_a_wrong_clock_moves_all_positions_along_their_ways_together() -> None:
    positions = survey([False, False])
    assert "clocks" not in parts_of(positions)
    velocity = np.array([[1.0, 0.0, 0.0], [0.0, -2.0, 0.5]])
    moving = replace(positions, velocity=velocity, clock_stddev_s=np.full(2, 0.1))
    by_second = 2.0 * 0.1 * np.concatenate([TURN @ velocity[0], TURN @ velocity[1]])
    np.testing.assert_allclose(parts_of(moving)["clocks"].alike, np.outer(by_second, by_second))


def test_errors_that_last_are_alike_over_their_time_and_not_in_marks() -> None:
    positions = replace(survey([False, True, False]), time_s=np.array([4.0, np.nan, 7.0]))
    parts = parts_of(positions, (3.0, 0.5))
    assert [*parts][-4:] == ["positions_3s", "positions_0.5s", "positions_warp", "frame"]
    for name, lasting_s in (("positions_3s", 3.0), ("positions_0.5s", 0.5)):
        alike = np.exp(-3.0 / lasting_s)
        expected = 0.01 * np.array([[1.0, 0.0, alike], [0.0, 0.0, 0.0], [alike, 0.0, 1.0]])
        np.testing.assert_allclose(parts[name].alike, np.kron(expected, np.eye(3)))
        assert (parts[name].median_m, parts[name].spread) == (0.3, 1.0)
    assert parts_of(survey([True, True]), (3.0,)).keys() == {"marks", "points"}
    # Where the covariance is unknown, the size is that which was assumed.
    unknown = parts_of(replace(positions, covariance_m2=np.full((3, 3, 3), np.nan)), (3.0,))
    assert unknown["positions_3s"].alike[0, 0] == pytest.approx(0.49)


def test_errors_that_last_are_averaged_over_the_times_of_a_group() -> None:
    positions = replace(survey([False] * 4), time_s=np.array([0.0, 7.0, 20.0, 27.0]))
    grouping = csr_array(np.kron([[0.5, 0.5, 0.0, 0.0], [0.0, 0.0, 0.5, 0.5]], np.eye(3)))
    bent = BendingOfBins((), np.zeros((6, 6)), np.zeros(6))
    *_, last, _, _ = problem(positions, lasting_s=(10.0,))._parts(SITE_FROM_MODEL, grouping, np.ones(4), bent)
    within = np.mean([np.exp(-abs(a - b) / 10) for a in range(8) for b in range(8)])
    between = np.mean([np.exp(-abs(a - b - 20) / 10) for a in range(8) for b in range(8)])
    expected = 0.01 * np.array([[within, between], [between, within]])
    np.testing.assert_allclose(last.alike, np.kron(expected, np.eye(3)))


def test_equations_start_from_the_mean_of_the_errors_to_expect() -> None:
    """An outlying position takes no part, but an outlying mark does: only a test leaves it out."""
    positions = survey([True, True, False, False])
    weights = np.array([0.05, 1.0, 0.1, 0.3])
    used = np.array([True, False, True, True])
    of_all = problem(positions, length_scale(1.9, 0.02), bending=Bending(path(), 0.2, 0.01), lasting_s=(3.0,))
    found, bending = of_all.equations(used, SITE_FROM_MODEL, weights, np.full(4, 0.1))
    np.testing.assert_array_equal(found.is_used, np.repeat([True, False, True, True], 3))
    np.testing.assert_allclose(found.linear.residual_m, 0.01, atol=1e-9)
    np.testing.assert_allclose(found.linear.design, of_all._design(SITE_FROM_MODEL))
    np.testing.assert_allclose(found.linear.prior_residual, [np.log(2.0 / 1.9) / 0.02])
    np.testing.assert_array_equal(found.linear.columns.of_map, np.arange(7))
    np.testing.assert_allclose(bending.formal_m2, 0.04 * np.eye(12))
    sizes = found.errors.stddev_of_component
    assert sizes["bending"] == pytest.approx(0.001 * np.exp(1.0))
    assert sizes["points"] == pytest.approx(0.1 * np.sqrt(0.5))
    assert sizes["positions"] == pytest.approx(0.1 * np.exp(0.25) * np.sqrt(0.5))
    assert sizes["positions_3s"] == pytest.approx(0.1 * 0.3 * np.exp(1.0) * np.sqrt(0.5))
    outlier = of_all.equations(np.ones(4, dtype=bool), SITE_FROM_MODEL, weights - 0.01, np.full(4, 0.1))[0]
    assert len(outlier.is_used) == 9
    assert outlier.is_used.all()


def test_positions_move_with_the_poses_in_the_axes_of_the_first_camera() -> None:
    rng = np.random.default_rng(3)
    places, arms = rng.standard_normal((2, 6, 18))
    positions = replace(survey([True, False]), by_pose=csr_array(places), arms_by_pose=csr_array(arms))
    grouping = csr_array(np.kron([[0.5, 0.5]], np.eye(3)))
    found = groups_by_pose(positions, SITE_FROM_MODEL, path(), grouping)
    by_all = 2.0 * places + arms
    mean = TURN @ (by_all[:3] + by_all[3:]) / 2
    assert found.shape == (3, 18)
    for pose in range(3):
        turns, shifts = slice(6 * pose, 6 * pose + 3), slice(6 * pose + 3, 6 * pose + 6)
        np.testing.assert_allclose(found[:, turns], mean[:, turns])
        # A shift by x in the first camera's axes is one by (world from that camera) x in the model's.
        np.testing.assert_allclose(found[:, shifts], mean[:, shifts] @ path().world_from_cam[0])


def test_three_positions_off_a_line_determine_a_similarity() -> None:
    places = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [2.0, 0.0, 0.0], [1.0, 1.0, 0.0]])
    positions = replace(known_positions([True] * 4), places=places)
    assert _determine(positions, np.array([True, False, True, True]))
    assert not _determine(positions, np.array([True, False, False, True]))
    assert not _determine(positions, np.array([True, True, True, False]))
    # The extents across and along are 1 / sqrt(3) and sqrt(2 / 3) of the lengths in a lean triangle.
    for across, is_enough in ((1.8e-7, True), (1.6e-7, False)):
        lean = replace(positions, places=places + across * np.array([[0.0], [1.0], [0.0], [0.0]]) * [0.0, 1.0, 0.0])
        assert _determine(lean, np.array([True, True, True, False])) is is_enough


def test_too_few_positions_are_refused_with_their_number() -> None:
    positions = replace(survey([True] * 4), is_check=np.array([False, True, True, False]))
    with pytest.raises(GeometryError, match=r"^2 known positions are in the map, expected 3 or more that are not on"):
        problem(positions).require_enough()
    problem(replace(positions, is_check=np.arange(4) == 1)).require_enough()
    with pytest.raises(GeometryError, match="2 known positions are in the map"):
        scale_by_positions(positions, path(), Bending(path()))


@pytest.mark.parametrize("row", [1, 2, 3])
def test_a_turn_that_stays_open_is_refused_in_degrees(row: int) -> None:
    covariance = np.diag([9.0, 0.01, 0.01, 0.01, 9.0, 9.0, 9.0])
    covariance[row, row] = 0.295**2
    refuse_open_turn(covariance)
    covariance[row, row] = 0.305**2
    with pytest.raises(GeometryError, match=r"\(17 degrees, 1 stddev\): survey a point off that line"):
        refuse_open_turn(covariance)


def test_few_positions_give_all_triples_and_many_give_300_of_them() -> None:
    few = list(by_positions._triples(13))
    assert len(few) == len(set(few)) == comb(13, 3)
    assert few[0] == (0, 1, 2)
    assert list(by_positions._triples(3)) == [(0, 1, 2)]
    for num in (14, 50):
        many = np.array(list(by_positions._triples(num)))
        assert many.shape == (300, 3)
        assert all(len(set(each)) == 3 for each in many.tolist())
        assert set(many.ravel().tolist()) == set(range(num))


def test_the_start_is_that_of_three_good_positions_with_their_lever_arms() -> None:
    positions = survey([False] * 6)
    wrong = np.array([0, 3])
    off = replace(positions, position_m=positions.position_m + 20.0 * np.isin(np.arange(6), wrong)[:, None])
    # The arms are taken off with the rotation of a first fit, which they disturb a little.
    found = by_positions._of_triples(off, np.arange(6))
    left = np.linalg.norm(positions.misclosures_m(found), axis=1)
    assert np.median(left) < 0.4
    without = by_positions._of_triples(replace(off, arms_m=np.zeros((6, 3))), np.arange(6))
    assert np.median(np.linalg.norm(positions.misclosures_m(without), axis=1)) > np.median(left)
    marks = survey([True] * 6)
    bad = replace(marks, position_m=marks.position_m + 20.0 * np.isin(np.arange(6), wrong)[:, None])
    assert_same(by_positions._of_triples(bad, np.arange(6)), SITE_FROM_MODEL)


def test_the_control_point_that_contradicts_the_others_most_is_left_out() -> None:
    positions = survey([True] * 6, noise_m=0.02)
    off_m = np.zeros((6, 3))
    off_m[1], off_m[4] = [0.0, 2.0, 0.0], [3.0, 0.0, 0.0]
    wrong = problem(replace(positions, position_m=positions.position_m + off_m))
    fit = wrong.fit(np.ones(6, dtype=bool), SITE_FROM_MODEL)
    first = known(wrong.worst(fit, 20.0))
    np.testing.assert_array_equal(first.used, np.arange(6) != 4)
    second = known(wrong.worst(first, 20.0))
    np.testing.assert_array_equal(second.used, ~np.isin(np.arange(6), [1, 4]))
    # The statistic is the squared error in standard deviations, of which nobody doubts one below the threshold.
    own = first.equations.of_mistake(at_point(wrong.known, 4)).statistic
    assert wrong.worst(fit, own * 1.001) is None
    assert own > 20.0


def test_an_antennas_positions_are_never_left_out_as_control_points() -> None:
    positions = survey([False] * 6, noise_m=0.02)
    wrong = problem(replace(positions, position_m=positions.position_m + 3.0 * (np.arange(6) == 2)[:, None]))
    assert wrong.worst(wrong.fit(np.ones(6, dtype=bool), SITE_FROM_MODEL), 0.0) is None


def test_of_three_control_points_none_is_left_out_and_of_four_none_that_keeps_the_others_off_a_line() -> None:
    three = problem(survey([True] * 3, noise_m=3.0))
    assert three.worst(three.fit(np.ones(3, dtype=bool)), 0.0) is None
    positions = known_positions([True] * 4)
    places = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [4.0, 0.0, 0.0], [2.0, 2.0, 0.0]])
    known_m = SITE_FROM_MODEL.apply(places) + 9.0 * (np.arange(4) == 3)[:, None] * [0.0, 0.0, 1.0]
    four = problem(replace(positions, places=places, position_m=known_m))
    found = known(four.worst(four.fit(np.ones(4, dtype=bool)), 0.0))
    assert found.used.sum() == 3
    assert found.used[3]


def fitted(of_all: _Problem) -> tuple[_Fit, PositionScale]:
    fit = of_all.fit(~of_all.known.is_check, SITE_FROM_MODEL)
    return fit, of_all.result(fit, np.zeros(len(of_all.known), dtype=bool), 16.0)


def test_the_scale_is_half_way_between_the_robust_and_the_best_weights() -> None:
    positions = survey([True] * 4 + [False] * 6, noise_m=0.1)
    sizes = np.where(positions.is_mark, 0.02, 0.2)
    positions = replace(positions, covariance_m2=sizes[:, None, None] ** 2 * np.eye(3))
    of_all = problem(positions, lasting_s=(3.0,))
    fit, found = fitted(of_all)
    linear, errors = fit.equations.linear, fit.equations.errors
    design, covariance = linear.design, errors.covariance_m2
    # By generalised least squares with the learnt errors, and by weighted ones with the robust weights.
    information = design.T @ np.linalg.solve(covariance, design)
    best = -np.linalg.solve(information, design.T @ np.linalg.solve(covariance, linear.residual_m))
    order = np.argmax(fit.equations.grouping.toarray()[::3, ::3], axis=1)
    weights = np.repeat((fit.weights / fit.stddev_m**2)[order], 3)
    robust = np.linalg.inv(design.T @ (weights[:, None] * design))
    assert found.uncertainty.formal == pytest.approx(np.sqrt(robust[0, 0]), rel=1e-6)
    gains = robust @ design.T * weights
    by_robust = gains @ covariance @ gains.T
    chance = np.sqrt(by_robust[0, 0] - np.linalg.inv(information)[0, 0])
    half_way = 0.5 * min(1.0, chance / abs(best[0])) * best
    assert_same(found.site_from_model, moved_similarity(fit.similarity, half_way, path()), 1e-7)
    np.testing.assert_allclose(found.best_step, best - half_way, atol=1e-7)
    np.testing.assert_allclose(
        found.covariance, np.linalg.inv(information) + np.outer(half_way, half_way), rtol=1e-5, atol=1e-9
    )
    is_antenna = np.repeat(~positions.is_mark[order], 3)
    by_antenna = np.where(is_antenna, gains[0], 0.0)
    parts = dict(zip(errors.names, errors.covariances_m2, strict=True))
    alone, *lasting = (
        by_antenna @ parts[name] @ by_antenna for name in ("positions", "positions_3s", "positions_warp")
    )
    assert found.inflation == pytest.approx(np.sqrt(1 + sum(lasting) / alone), rel=1e-6)
    assert found.value == found.site_from_model.scale
    assert found.alone.stddev == pytest.approx(found.value * found.uncertainty.empirical)
    np.testing.assert_allclose(found.bending_m2, np.zeros((30, 30)))
    assert found.bending_factor == 1.0


def test_an_outlying_position_is_weighed_as_if_nearly_left_out_in_the_formal_uncertainty() -> None:
    """A mark with a small weight still takes part, with a tenth of a weight."""
    positions = survey([True] * 6)
    positions = replace(positions, position_m=positions.position_m + 3.0 * (np.arange(6) == 2)[:, None])
    fit, found = fitted(problem(positions))
    assert fit.weights[2] < 0.05
    weights = np.repeat(np.maximum(fit.weights, 0.1) / fit.stddev_m**2, 3)
    design = fit.equations.linear.design
    formal = np.linalg.inv(design.T @ (weights[:, None] * design))[0, 0]
    assert found.uncertainty.formal == pytest.approx(np.sqrt(formal), rel=1e-6)


def test_a_refined_maps_formal_uncertainty_has_the_bending_that_the_photos_allow() -> None:
    positions = survey([True] * 6, noise_m=0.1)
    bent = Bending(path(), formal_m=0.2)
    for refined in (None, SITE_FROM_MODEL):
        fit, found = fitted(problem(positions, refined=refined, bending=bent))
        variances = np.repeat(fit.stddev_m**2 / fit.weights, 3) + (0.0 if refined is None else 0.04)
        design = fit.equations.linear.design
        formal = np.linalg.inv(design.T @ (design / variances[:, None]))[0, 0]
        assert found.uncertainty.formal == pytest.approx(np.sqrt(formal), rel=1e-6)
        np.testing.assert_allclose(found.bending_m2, 0.04 * np.eye(18))
        learnt = fit.equations.errors.stddev_of_component["bending"]
        assert found.bending_factor == pytest.approx(learnt / 0.2)


def test_the_size_of_each_positions_own_error_is_the_given_one_times_the_learnt_factor() -> None:
    positions = survey([True, True, False, False], stddev_m=0.1)
    unknown = np.where((np.arange(4) == 1)[:, None, None], np.nan, positions.covariance_m2)
    fit: Any = SimpleNamespace(stddev_m=np.full(4, 0.5), sizes={"points": 2.0, "positions": 3.0})
    of_all = problem(replace(positions, covariance_m2=unknown))
    np.testing.assert_allclose(of_all._own_stddev_m(fit), [0.2, 1.0, 0.3, 0.3])
    fit.sizes = {}
    np.testing.assert_allclose(of_all._own_stddev_m(fit), [0.1, 0.5, 0.1, 0.1])


def test_the_inflation_compares_the_antennas_own_errors_with_those_that_last() -> None:
    """The second of four positions is a mark, and the last takes no part."""
    positions = known_positions([False, True, False, False])
    is_used = np.repeat([True, True, True, False], 3)
    equations = SimpleNamespace(grouping=csr_array(np.eye(12)), is_used=is_used)
    fit: Any = SimpleNamespace(equations=equations)
    sizes = {"points": 9.0, "positions": 1.0, "positions_3s": 2.0, "positions_30s": 2.0}
    covariances = np.array([size**2 * np.eye(9) for size in sizes.values()])
    # The mark errs by an amount of its own, which must not count.
    covariances[2, 3:6, 3:6] *= 100.0
    errors = ErrorParts((*sizes,), np.array([*sizes.values()]), covariances)
    by = np.array([0.1, 0.2, 0.0, 0.3, 0.0, 0.0, 0.0, 0.4, 0.0])
    assert problem(positions)._inflation(fit, errors, by) == pytest.approx(3.0)
    assert problem(positions)._inflation(fit, errors.without("positions"), by) == 1.0
    assert problem(positions)._inflation(fit, errors, np.where(np.arange(9) // 3 == 1, by, 0.0)) == 1.0
    assert problem(positions)._inflation(fit, errors.only("points", "positions"), by) == pytest.approx(1.0)


def test_control_points_are_left_out_at_a_risk_of_two_percent_in_all() -> None:
    positions = survey([True] * 6 + [False], noise_m=0.02)
    off_m = np.where((np.arange(7) == 1)[:, None], [0.0, 2.0, 0.0], 0.0)
    wrong = replace(positions, position_m=positions.position_m + off_m, is_check=np.arange(7) == 3)
    found = scale_by_positions(wrong, path(), Bending(path()), lasting_s=())
    assert found.threshold == pytest.approx(stats.chi2.isf(0.02 / 5, 3))
    assert found.names_left_out == ["P1"]
    np.testing.assert_array_equal(found.is_left_out, np.arange(7) == 1)
    np.testing.assert_array_equal(found.is_used, ~np.isin(np.arange(7), [1, 3]))
    assert (found.num_used, found.has_check) == (5, True)
    assert found.value == pytest.approx(2.0, rel=0.02)
    light = replace(found, weights=np.where(np.arange(7) == 6, 0.099, 0.1))
    assert light.num_used == 4
    none = scale_by_positions(survey([False] * 3, 0.02), path(), Bending(path()), lasting_s=())
    assert none.threshold == pytest.approx(stats.chi2.isf(0.02, 3))
    assert not none.has_check


def test_the_prior_on_the_first_camera_is_the_estimate_by_the_best_weights() -> None:
    found = fitted(problem(survey([True] * 5, noise_m=0.1)))[1]
    found = replace(found, best_step=np.array([0.1, 0.2, 0.0, 0.0, 1.0, 2.0, 3.0]))
    first = path()
    camera_from_model = Similarity(1.0, first.world_from_cam[0].T, -first.world_from_cam[0].T @ first.centers[0])
    prior = found.prior(first, camera_from_model)
    middle = found.site_from_model.apply(first.centers[0]) + np.array([1.0, 2.0, 3.0])
    np.testing.assert_allclose(prior.mean.apply(np.zeros(3)), middle)
    assert prior.mean.scale == pytest.approx(found.value * np.exp(0.1))
    np.testing.assert_array_equal(prior.middle, np.zeros(3))
    np.testing.assert_allclose(np.linalg.inv(prior.whitening.T @ prior.whitening), found.covariance, rtol=1e-6)


def test_planned_positions_have_the_errors_to_expect() -> None:
    positions = survey([True, True, True, False, False])
    planned = replace(positions, position_m=positions.predicted_m(IDENTITY), is_check=np.arange(5) == 1)
    found = expected_positions(planned, path(), Bending(path()), (3.0,))
    np.testing.assert_allclose(found.linear.residual_m, 0.0, atol=1e-12)
    np.testing.assert_array_equal(found.is_used, np.repeat(np.arange(5) != 1, 3))
    expected = ("marks", "points", "places", "positions", "positions_3s", "positions_warp", "frame")
    assert found.errors.names == expected
    with pytest.raises(GeometryError, match="2 known positions"):
        expected_positions(replace(planned, is_check=np.arange(5) < 3), path(), Bending(path()))

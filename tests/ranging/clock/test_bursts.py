"""Bursts of ranges are found, paired with photos, and used only if the pairing passes certain tests."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from scipy.spatial.transform import Rotation
from tests.known import known

from rangesfm.arrays import Array, Indices
from rangesfm.geometry.trajectory import Trajectory
from rangesfm.ranging.clock import bursts as module
from rangesfm.ranging.clock.bursts import (
    BurstPairing,
    Bursts,
    curve_of,
    find_bursts,
    offsets_that_keep,
    pair_bursts,
)
from rangesfm.ranging.clock.search import TimedRanges
from rangesfm.ranging.clock.squares import fit_squares

PAIRING = BurstPairing(1.5, np.arange(9), np.arange(9), variance=1e-3, num_spare=5.0, chance=1e-6)
ANCHORS_M = np.array([[6.0, 1.0, 2.0], [99.0, 99.0, 99.0], [-4.0, 5.0, 1.0]])
PHOTO_TIMES = 4.0 * np.arange(5, dtype=np.float64)


def test_a_path_explains_medians_that_are_enough_and_that_nothing_else_explains() -> None:
    assert PAIRING.explains()
    assert replace(PAIRING, num_spare=4.0).explains()
    assert replace(PAIRING, chance=1.34e-3).explains()


@pytest.mark.parametrize("pairing", [replace(PAIRING, num_spare=3.99), replace(PAIRING, chance=1.36e-3)])
def test_few_medians_or_chance_explain_nothing(pairing: BurstPairing) -> None:
    assert not pairing.explains()


def test_the_odds_are_those_of_the_variances_for_the_smaller_number_of_medians() -> None:
    rival = replace(PAIRING, variance=4e-3, num_spare=8.0)
    assert PAIRING.log_odds(rival) == pytest.approx(5.0 * np.log(2))
    assert rival.log_odds(PAIRING) == pytest.approx(-5.0 * np.log(2))
    assert PAIRING.log_odds(replace(rival, num_spare=4.0)) == pytest.approx(4.0 * np.log(2))
    assert PAIRING.log_odds(replace(rival, num_spare=3.9)) == np.inf


def burst_ranges(*times: Array) -> TimedRanges:
    """Return ranges at these times, of ten metres to one anchor."""
    times_s = np.concatenate(times)
    zero = np.zeros(len(times_s), dtype=np.int64)
    return TimedRanges(times_s, np.full(len(times_s), 10.0), zero, zero)


def test_a_burst_has_the_median_of_each_anchor_and_tag_whatever_the_order_of_the_log() -> None:
    first = [(0.2, 5.0, 0, 0), (0.0, 4.0, 0, 0), (0.4, 9.0, 0, 0), (0.3, 7.0, 2, 1), (0.1, 8.0, 2, 1), (0.5, 3.0, 0, 1)]
    second = [(4.0 + time, range_m + 1, anchor, tag) for time, range_m, anchor, tag in first[:5]]
    third = [(8.0 + time, range_m + 2, anchor, tag) for time, range_m, anchor, tag in first[:3]]
    times, ranges_m, anchors, tags = (np.array(column) for column in zip(*third, *first, *second))
    found = known(find_bursts(TimedRanges(times, ranges_m, anchors.astype(int), tags.astype(int)), PHOTO_TIMES))
    np.testing.assert_allclose(found.start_s, [0.0, 4.0, 8.0])
    np.testing.assert_allclose(found.end_s, [0.5, 4.4, 8.4])
    np.testing.assert_allclose(found.middle_s, [0.25, 4.2, 8.2])
    np.testing.assert_array_equal(found.num_ranges, [6, 5, 3])
    assert [*zip(found.anchor.tolist(), found.tag.tolist())] == [(0, 0), (0, 1), (2, 1)]
    np.testing.assert_array_equal(found.range_m, [[5.0, 3.0, 7.5], [6.0, np.nan, 8.5], [7.0, np.nan, np.nan]])


@pytest.mark.parametrize(("pause_s", "num"), [(0.99, 3), (1.01, 4)])
def test_a_pause_of_a_quarter_of_the_time_between_photos_ends_a_burst(pause_s: float, num: int) -> None:
    burst = np.array([0.0, 0.1])
    found = known(find_bursts(burst_ranges(burst, burst + 5, burst + 10, burst + 10.1 + pause_s), PHOTO_TIMES))
    assert len(found.start_s) == num


@pytest.mark.parametrize(("size", "num"), [(2, 3), (3, 4)])
def test_a_burst_of_less_than_a_quarter_of_the_usual_size_is_none(size: int, num: int) -> None:
    burst = 0.1 * np.arange(12, dtype=np.float64)
    found = known(find_bursts(burst_ranges(burst, burst[:size] + 4, burst + 8, burst + 12), PHOTO_TIMES))
    np.testing.assert_array_equal(found.num_ranges, [12, 3, 12, 12] if num == 4 else [12, 12, 12])
    assert found.start_s[1] == (4.0 if num == 4 else 8.0)


def test_a_log_has_bursts_if_they_are_half_as_many_as_the_photos() -> None:
    log = burst_ranges(np.array([0.0, 0.1]), np.array([4.0, 4.1]))
    assert find_bursts(log, 4.0 * np.arange(4, dtype=np.float64)) is not None
    assert find_bursts(log, 4.0 * np.arange(5, dtype=np.float64)) is None


def test_offsets_pair_three_quarters_of_the_bursts_that_can_be_paired_the_most_first() -> None:
    """One photo further, one burst less is paired: three of four are enough, and five of seven are not."""
    for num, wanted in ((4, [100.0, 90.0, 110.0]), (7, [100.0, 90.0, 110.0])):
        bursts = 10.0 * np.arange(num, dtype=np.float64)
        assert module._offsets(bursts, bursts + 100, 1.0) == pytest.approx(wanted)


def test_an_offset_is_the_median_of_the_differences_within_reach_and_those_at_its_edge_count() -> None:
    bursts = np.array([0.0, 50.0, 130.0])
    assert module._offsets(bursts, bursts + 100 + np.array([-1.0, 0.25, 1.25]), 1.25) == pytest.approx([100.25])
    # The first and the last difference are exactly as far from the middle one as the reach.
    assert module._offsets(bursts, bursts + 100 + np.array([-1.0, 0.0, 1.0]), 1.0) == pytest.approx([100.0])


@pytest.mark.parametrize(("apart_s", "wanted"), [(1.75, [0.0]), (2.25, [0.0, 2.25])])
def test_two_offsets_are_further_apart_than_twice_the_reach(apart_s: float, wanted: list[float]) -> None:
    assert module._offsets(np.zeros(4), np.array([0.0, apart_s]), 1.0) == pytest.approx(wanted)


def survey(
    num: int = 24, noise_m: float = 0.0, arms_m: Array | None = None, turn: float = 1.0
) -> tuple[Trajectory, Bursts]:
    """Return photos 4 s apart, and the bursts at them on a clock 100 s behind, of two anchors and two tags."""
    rng = np.random.default_rng(0)
    arms_m = np.zeros((2, 3)) if arms_m is None else arms_m
    turns = Rotation.from_rotvec(turn * rng.normal(size=(num, 3))).as_matrix()
    centers, times = 3 * rng.normal(size=(num, 3)), 4.0 * np.arange(num, dtype=np.float64)
    names = tuple(f"{k}.jpg" for k in range(num))
    photos = Trajectory(np.arange(num), names, times, centers / 0.5, turns)
    anchor, tag = np.array([0, 2, 2]), np.array([0, 0, 1])
    antennas = centers[:, None] + np.einsum("nij,lj->nli", turns, arms_m[tag])
    ranges = np.linalg.norm(antennas - ANCHORS_M[anchor], axis=2) + noise_m * rng.normal(size=(num, 3))
    return photos, Bursts(times - 100.5, times - 99.5, np.full(num, 9), ranges, anchor, tag)


def test_bursts_are_paired_with_the_photos_at_which_their_ranges_fit_best() -> None:
    photos, bursts = survey(12)
    pairings = pair_bursts(bursts, photos, np.zeros((2, 3)))
    assert pairings[0].offset_s == pytest.approx(100.0)
    np.testing.assert_array_equal(pairings[0].burst, np.arange(12))
    np.testing.assert_array_equal(pairings[0].photo, np.arange(12))
    assert pairings[0].variance == pytest.approx(1e-6)  # of a millimetre, which is the least
    assert pairings[0].chance < 1e-20
    # 7 offsets pair 9 of the 12 bursts or more, one photo more or less each.
    assert sorted(round(pairing.offset_s) for pairing in pairings) == [100 + 4 * k for k in range(-3, 4)]
    variances = [pairing.variance for pairing in pairings]
    assert variances == sorted(variances)
    assert variances[1] > 0.1
    later = next(pairing for pairing in pairings if round(pairing.offset_s) == 104)
    np.testing.assert_array_equal(later.photo - later.burst, 1)
    assert not later.explains()


def test_pairings_with_too_few_medians_come_last() -> None:
    """One burst or two less leave fewer than four medians beyond the nine unknowns, and fit by chance."""
    photos, bursts = survey(5)
    pairings = pair_bursts(bursts, photos, np.zeros((2, 3)))
    assert pairings[0].offset_s == pytest.approx(100.0)
    assert pairings[0].num_spare == pytest.approx(6.0)
    assert all(pairing.num_spare < 4 for pairing in pairings[1:])
    # With this noise, one of the small pairings even has the smallest variance.
    noisy = bursts._replace(range_m=bursts.range_m + np.random.default_rng(6).normal(0, 0.5, bursts.range_m.shape))
    first, second, third = pair_bursts(noisy, photos, np.zeros((2, 3)))
    assert first.num_spare >= 4
    assert second.variance < 0.5 * first.variance
    assert second.variance < third.variance


@pytest.mark.parametrize(("late_s", "num"), [(0.99, 12), (1.0, 12), (1.01, 11)])
@pytest.mark.parametrize("side", [-1, 1])
def test_a_burst_belongs_to_a_photo_within_a_quarter_of_the_time_between_photos(
    late_s: float, num: int, side: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    def pairing_of(_bursts: Bursts, _photos: Trajectory, _arms: Array, burst: Indices, photo: Indices) -> BurstPairing:
        return replace(PAIRING, burst=burst, photo=photo)

    monkeypatch.setattr(module, "_fit", pairing_of)
    photos, bursts = survey(12)
    shift = np.zeros(12)
    shift[7] = side * late_s
    late = bursts._replace(start_s=bursts.start_s + shift, end_s=bursts.end_s + shift)
    pairings = pair_bursts(late, photos, np.zeros((2, 3)))
    own = next(pairing for pairing in pairings if np.array_equal(pairing.photo, pairing.burst))
    assert len(own.burst) == num
    assert (7 in own.burst) == (num == 12)


def fit_of(bursts: Bursts, photos: Trajectory, arms_m: Array, rows: Indices) -> BurstPairing:
    return module._fit(bursts, photos, arms_m, rows, rows)


def test_the_variance_and_the_chance_of_a_pairing_are_those_of_an_f_test() -> None:
    photos, bursts = survey(noise_m=0.05)
    bursts.range_m[3, 1] = np.nan
    rows = np.arange(2, 22)
    found = fit_of(bursts, photos, np.zeros((2, 3)), rows)
    burst, link = np.nonzero(np.isfinite(bursts.range_m[rows]))
    range_m, anchor = bursts.range_m[rows][burst, link], bursts.anchor[link]
    squares = fit_squares(photos.centers[rows][burst], range_m, anchor, 5.0)
    num_spare = squares.weights.sum() - 9
    assert len(range_m) == 59
    assert found.num_spare == pytest.approx(num_spare)
    assert found.variance == pytest.approx(np.sum(squares.weights * squares.residuals_m**2) / num_spare)
    variation = sum(np.sum((range_m[anchor == one] - range_m[anchor == one].mean()) ** 2) for one in (0, 2)) / 57
    chance = stats.f.sf(variation / found.variance, 57, num_spare)
    assert found.chance == pytest.approx(chance, rel=1e-6, abs=0.0)
    assert found.offset_s == pytest.approx(100.0)
    np.testing.assert_array_equal(found.burst, rows)


def test_ranges_that_the_path_does_not_explain_have_a_chance() -> None:
    photos, bursts = survey()
    shuffled = bursts._replace(range_m=bursts.range_m[np.random.default_rng(2).permutation(24)])
    found = fit_of(shuffled, photos, np.zeros((2, 3)), np.arange(24))
    assert 0.01 < found.chance < 1.0
    assert not found.explains()


def test_each_tag_has_its_own_lever_arm_in_the_axes_of_the_camera() -> None:
    """The lever arms are applied with the scale of a fit without them, which is a little off."""
    arms_m = np.array([[0.3, -0.2, 0.1], [-0.1, 0.4, 0.2]])
    photos, bursts = survey(60, arms_m=arms_m)
    rows = np.arange(60)
    right = fit_of(bursts, photos, arms_m, rows).variance
    for wrong in (np.zeros((2, 3)), -arms_m, arms_m[::-1]):
        assert fit_of(bursts, photos, wrong, rows).variance > 30 * right


def test_few_medians_leave_hardly_anything_to_spare() -> None:
    photos, bursts = survey(6, noise_m=0.1)
    few = bursts._replace(range_m=bursts.range_m[:, :1], anchor=bursts.anchor[:1], tag=bursts.tag[:1])
    found = fit_of(few, photos, np.zeros((2, 3)), np.arange(5))
    assert found.num_spare == pytest.approx(1e-3)
    assert found.variance < 0.1
    single = fit_of(few, photos, np.zeros((2, 3)), np.arange(1))
    assert (single.variance, single.num_spare, single.chance) == (1e-6, 1e-3, 1.0)


def test_the_offset_of_a_pairing_is_the_median_distance_of_the_middles_from_the_photos() -> None:
    photos, bursts = survey()
    late = bursts._replace(end_s=bursts.end_s + 0.5 * (np.arange(24) > 3))
    assert fit_of(late, photos, np.zeros((2, 3)), np.arange(24)).offset_s == pytest.approx(99.75)


def uneven() -> tuple[Trajectory, Bursts]:
    """Return photos 2, 4, 4 and 8 s apart, and bursts of a second or more at them, on a clock 100 s behind."""
    times = np.array([0.0, 2.0, 6.0, 10.0, 18.0])
    photos = Trajectory(np.arange(5), tuple("abcde"), times, np.zeros((5, 3)), np.tile(np.eye(3), (5, 1, 1)))
    half = np.array([0.5, 0.25, 0.5, 0.75, 1.0])
    one = np.ones((5, 1))
    nil = np.zeros(1, dtype=np.int64)
    return photos, Bursts(times - 100 - half, times - 100 + half, np.full(5, 9), one, nil, nil)


@pytest.mark.parametrize(
    ("rows", "earliest_s", "latest_s"),
    [
        ([0], 98.5, 100.5),  # before the first photo half of the median gap, after it half of its own
        ([1], 99.25, 101.75),
        ([2], 98.5, 101.5),
        ([3], 98.75, 101.25),  # after it half of the median gap, although its own is longer
        ([4], 99.0, 101.0),
        ([0, 1, 2, 3, 4], 99.25, 100.5),
    ],
)
def test_bursts_stay_at_their_photos_up_to_half_of_the_gaps(
    rows: list[int], earliest_s: float, latest_s: float
) -> None:
    photos, bursts = uneven()
    pairing = replace(PAIRING, burst=np.array(rows), photo=np.array(rows))
    assert offsets_that_keep(pairing, bursts, photos) == pytest.approx((earliest_s, latest_s))


def test_the_curve_is_level_while_the_bursts_stay_and_a_point_where_they_do_not() -> None:
    photos, bursts = uneven()
    stays = replace(PAIRING, offset_s=100.0, burst=np.arange(5), photo=np.arange(5), variance=4.0)
    # A burst of ten seconds is nearest to its photo at no offset.
    long = bursts._replace(start_s=bursts.start_s - [0, 0, 9, 0, 0])
    other = replace(stays, offset_s=104.0, burst=np.arange(4), photo=np.arange(1, 5), variance=9.0)
    curve = curve_of([other, stays], bursts, photos)
    np.testing.assert_allclose(curve.offsets_s[curve.costs_m == 2.0], [99.25, 100.0, 100.5])
    assert np.all(np.diff(curve.offsets_s) > 0)
    point = curve_of([replace(stays, offset_s=100.0)], long, photos)
    np.testing.assert_allclose(point.offsets_s, [100.0])
    np.testing.assert_allclose(point.costs_m, [2.0])

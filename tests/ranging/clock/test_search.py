"""The search over all time offsets of the clocks."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rangesfm.arrays import Array, Mask
from rangesfm.geometry.trajectory import Trajectory
from rangesfm.options import AssociationOptions
from rangesfm.ranging.clock import search
from rangesfm.ranging.clock.search import (
    OffsetCurve,
    PathSamples,
    TimedRanges,
    moving_path,
    on_path,
    scan_offsets,
)


@pytest.mark.parametrize("rounding", [0.0, 1e-15])
def test_a_camera_that_stands_still_but_for_rounding_explains_no_range_at_any_offset(rounding: float) -> None:
    """No ranges fit any offset, not even ranges that vary as the rounding errors do."""
    rng = np.random.default_rng(0)
    wobble = rng.normal(size=(400, 3)).cumsum(axis=0)
    centers = np.array([1.0, 2.0, 3.0]) + rounding * wobble / np.abs(wobble).max()
    path = PathSamples(0.0, 0.025, centers, np.zeros((1, 400, 3)), np.ones(400, dtype=bool))
    zero = np.zeros(400, dtype=np.int64)
    ranges = TimedRanges(0.025 * np.arange(400, dtype=np.float64), 20.0 + wobble[:, 0], zero, zero)
    np.testing.assert_allclose(scan_offsets(ranges, path).scores, 0.0, atol=1e-3)


def test_peaks_are_the_highest_within_a_separation_the_best_first() -> None:
    offsets = 0.05 * np.arange(41, dtype=np.float64)
    scores = np.exp(-((offsets - 0.5) ** 2) / 0.005) + 0.8 * np.exp(-((offsets - 0.75) ** 2) / 0.005)
    scores += 0.9 * np.exp(-((offsets - 1.6) ** 2) / 0.005)
    curve = OffsetCurve(offsets, 1 - scores, scores)
    assert curve.peaks(0.1, 9) == pytest.approx([0.5, 1.6, 0.75])
    assert curve.peaks(0.3, 9) == pytest.approx([0.5, 1.6])
    assert curve.peaks(0.1, 1) == pytest.approx([0.5])
    assert OffsetCurve(offsets[:1], scores[:1], scores[:1]).peaks(0.1, 9) == [0.0]


def test_a_curve_for_the_report_has_all_offsets_near_the_best_and_the_best_of_each_interval() -> None:
    offsets = 0.05 * np.arange(2000, dtype=np.float64)
    costs = 1 + np.abs(np.sin(offsets)) + (offsets - 40) ** 2
    shown = OffsetCurve(offsets, costs, -costs).around(40.0)
    assert set(offsets[np.abs(offsets - 40) < 4.99]) <= set(shown.offsets_s)
    assert 300 < len(shown.offsets_s) <= 400
    assert np.all(np.diff(shown.offsets_s) > 0)
    np.testing.assert_array_equal(shown.costs_m, costs[np.searchsorted(offsets, shown.offsets_s)])
    far = shown.offsets_s[shown.offsets_s < 34]
    # 200 intervals of 10 offsets: each shows where its cost is the least, here at its end that is nearer to 40 s.
    assert np.abs(np.diff(far) - 10 * 0.05).max() < 0.51


def test_a_tag_is_between_the_samples_where_both_are_known() -> None:
    centers = np.array([[0.0, 0, 0], [1, 0, 0], [3, 0, 0], [3, 2, 0]])
    arms = np.stack([np.zeros((4, 3)), np.tile([0.0, 0.0, 0.5], (4, 1))])
    path = PathSamples(10.0, 0.5, centers, arms, np.array([True, True, True, False]))
    times = np.array([9.9, 10.0, 10.25, 10.75, 11.0, 11.2, 11.6])
    np.testing.assert_array_equal(path.knows(times), [False, True, True, True, False, False, False])
    places, velocities = path.tag(times[1:4], np.array([0, 1, 1]), scale=2.0)
    np.testing.assert_allclose(places, np.array([[0, 0, 0], [0.5, 0, 0.25], [2, 0, 0.25]]))
    np.testing.assert_allclose(velocities, [[2, 0, 0], [2, 0, 0], [4, 0, 0]])
    without_arm, _ = path.tag(times[3:4], np.array([1]), scale=np.inf)
    np.testing.assert_array_equal(without_arm, [[2, 0, 0]])


def on_a_line(times: Array, turn_rad_s: float = 0.0) -> Trajectory:
    """Return photos of a camera that moves evenly, and turns evenly about the z axis."""
    turns = Rotation.from_rotvec(np.outer(turn_rad_s * (times - times[0]), [0, 0, 1])).as_matrix()
    names = tuple(f"{k}.jpg" for k in range(len(times)))
    return Trajectory(np.arange(len(times)), names, times, np.outer(times - times[0], [2.0, 0, 1.0]), turns)


def test_a_path_is_sampled_every_twentieth_of_a_second_between_photos_that_are_not_too_far_apart() -> None:
    """Its lever arms turn with the camera; nothing is known across the long gap."""
    times = np.array([100.0, 101.0, 102.0, 105.01, 106.0, 107.02])
    arms = np.array([[0.0, 0.0, 0.0], [0.3, 0.0, 0.1]])
    path = moving_path(on_a_line(times, 0.5), arms, AssociationOptions(max_interpolation_gap_s=2.0))
    assert (path.start_s, path.step_s) == (100.0, 0.05)
    assert len(path) == 141
    assert path.tag_from_center.shape == (2, 141, 3)
    since = 0.05 * np.arange(141)
    off = (since > 2.0 + 1e-6) & (since < 5.01)
    np.testing.assert_array_equal(path.is_known, ~off)
    np.testing.assert_allclose(path.centers, np.where(off[:, None], 0.0, np.outer(since, [2, 0, 1])), atol=1e-3)
    turned = np.column_stack([0.3 * np.cos(0.5 * since), 0.3 * np.sin(0.5 * since), np.full(141, 0.1)])
    np.testing.assert_allclose(path.tag_from_center[1], np.where(off[:, None], 0.0, turned), atol=1e-3)
    np.testing.assert_array_equal(path.tag_from_center[0], 0.0)


def test_a_lone_photo_next_to_which_nothing_is_interpolated_is_no_part_of_the_path() -> None:
    """Ranges near it would need a camera that stands still."""
    times = np.array([0.0, 1.0, 4.0, 7.01, 8.0])
    path = moving_path(on_a_line(times), np.zeros((1, 3)), AssociationOptions(max_interpolation_gap_s=2.0))
    since = 0.05 * np.arange(len(path))
    np.testing.assert_array_equal(path.is_known, (since <= 1.0 + 1e-9) | (since > 7.01))


def test_a_longer_path_than_can_be_sampled_so_densely_is_sampled_more_coarsely(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(search, "_MAX_NUM_STEPS", 32)
    path = moving_path(on_a_line(np.array([10.0, 11.0, 12.0])), np.zeros((1, 3)), AssociationOptions())
    assert path.step_s == 2 / 32
    assert len(path) == 33
    short = moving_path(on_a_line(np.array([10.0, 10.5, 11.0])), np.zeros((1, 3)), AssociationOptions())
    assert short.step_s == 0.05


def winding(num: int, is_known: Mask | None = None, step_s: float = 0.05, start_s: float = 0.0) -> PathSamples:
    """Return a path that winds about without repeating itself."""
    rng = np.random.default_rng(0)
    speed = np.apply_along_axis(np.convolve, 0, rng.normal(size=(num, 3)), np.hanning(20), "same")
    known = np.ones(num, dtype=bool) if is_known is None else is_known
    centers = np.where(known[:, None], 0.1 * speed.cumsum(axis=0) + [5, 6, 7], 0.0)
    return PathSamples(start_s, step_s, centers, np.zeros((1, num, 3)), known)


def ranges_on(path: PathSamples, samples: Array, offset_s: float, noise_m: float = 0.0) -> TimedRanges:
    """Return ranges to two anchors, taken at samples of a path (no fractions), on a clock with this offset."""
    index = samples.astype(np.int64)
    anchor = np.arange(len(index)) % 2
    places = 0.6 * (path.centers[index] - [5, 6, 7]) - np.array([[4.0, -3.0, 1.0], [-2.0, 5.0, 0.0]])[anchor]
    noise = noise_m * np.random.default_rng(1).normal(size=len(index))
    times = path.start_s + path.step_s * samples - offset_s
    return TimedRanges(times, np.linalg.norm(places, axis=1) + noise, anchor, np.zeros(len(index), dtype=np.int64))


def fitted_at(path: PathSamples, ranges: TimedRanges, offset_s: float, weights: Array) -> tuple[float, float]:
    """Return score and cost of one offset by a plain least-squares fit."""
    place = np.rint((ranges.times_s + offset_s - path.start_s) / path.step_s).astype(np.int64)
    inside = (place >= 0) & (place < len(path))
    inside &= path.is_known[np.where(inside, place, 0)]
    points, range_m, anchor = path.centers[place[inside]], ranges.range_m[inside], ranges.anchor[inside]
    points = points - points.mean(axis=0)
    roots = np.sqrt(weights[inside]) / (2 * range_m)
    own = [np.where((anchor == one)[:, None], np.column_stack([points, np.ones(len(points))]), 0.0) for one in (0, 1)]
    columns = roots[:, None] * np.column_stack([np.sum(points**2, axis=1), *own])
    values = roots * range_m**2
    unknowns = np.linalg.lstsq(columns, values, rcond=None)[0]
    if unknowns[0] < 0:
        unknowns = np.append(0.0, np.linalg.lstsq(columns[:, 1:], values, rcond=None)[0])
    residual = float(np.sum((values - columns @ unknowns) ** 2))
    variation = 0.0
    for one in (0, 1):
        squared, factor = range_m[anchor == one] ** 2, roots[anchor == one] ** 2
        variation += float(np.sum(factor * (squared - np.average(squared, weights=factor)) ** 2))
    num = weights[inside].sum()
    return 0.5 * float(np.log(variation / residual)), float(np.sqrt(residual / num))


@pytest.mark.parametrize("is_weighted", [False, True])
def test_each_offset_of_a_scan_has_score_and_cost_of_a_plain_fit(is_weighted: bool) -> None:
    known = np.ones(300, dtype=bool)
    known[120:150] = False
    path = winding(300, known, start_s=50.0)
    samples = np.random.default_rng(2).permutation(np.flatnonzero(known)[20:220:2]).astype(np.float64)
    ranges = ranges_on(path, samples, 1000.0, noise_m=0.05)
    weights = np.random.default_rng(3).uniform(0.2, 2.0, len(samples)) if is_weighted else np.ones(len(samples))
    curve = scan_offsets(ranges, path, weights if is_weighted else None)
    assert curve.offsets_s[np.argmax(curve.scores)] == pytest.approx(1000.0)
    for offset_s in (1000.0, 999.0, 999.85, 1000.2, 1001.5):
        score, cost = fitted_at(path, ranges, offset_s, weights)
        place = int(np.argmin(np.abs(curve.offsets_s - offset_s)))
        assert curve.offsets_s[place] == pytest.approx(offset_s)
        assert curve.scores[place] == pytest.approx(score, abs=0.02)
        assert curve.costs_m[place] == pytest.approx(cost, rel=0.02)


def test_offsets_that_put_half_as_many_ranges_on_the_path_as_the_best_are_tried() -> None:
    path = winding(201)
    ranges = ranges_on(path, np.arange(201, dtype=np.float64), 0.0)
    curve = scan_offsets(ranges, path)
    np.testing.assert_allclose(curve.offsets_s, 0.05 * np.arange(-100, 101), atol=1e-9)


@pytest.mark.parametrize(("num_early", "is_tried"), [(39, False), (41, True)])
def test_a_part_of_the_log_with_less_than_half_of_the_ranges_is_left_out(num_early: int, is_tried: bool) -> None:
    """The parts are a year apart, so that no offset puts both on the path."""
    path = winding(200)
    late = ranges_on(path, np.arange(20, 180, 2, dtype=np.float64), -1e6)
    early = ranges_on(path, np.arange(20, 180, 2, dtype=np.float64)[:num_early], 0.0)
    both = TimedRanges(*(np.concatenate(pair) for pair in zip(late, early)))
    curve = scan_offsets(both, path)
    assert np.all(np.diff(curve.offsets_s) > 0)
    assert np.any(np.abs(curve.offsets_s) < 10) == is_tried
    near = np.abs(curve.offsets_s + 1e6) < 10
    assert curve.offsets_s[near][np.argmax(curve.scores[near])] == pytest.approx(-1e6)
    shuffled = np.random.default_rng(4).permutation(len(both.times_s))
    weights = np.random.default_rng(5).uniform(0.9, 1.1, len(shuffled))
    again, ordered = scan_offsets(both.take(shuffled), path, weights[shuffled]), scan_offsets(both, path, weights)
    np.testing.assert_allclose(again.costs_m[:100], ordered.costs_m[:100], rtol=1e-6)


def test_the_part_with_most_ranges_on_the_path_at_once_need_not_be_the_longest() -> None:
    """Sixty ranges take three times as long as the path: 20 are on it at once, less than half of the other fifty."""
    path = winding(200)
    dense = ranges_on(path, np.arange(20, 170, 3, dtype=np.float64), -1e6)
    sparse = ranges_on(path, np.arange(60, dtype=np.float64), 0.0)._replace(times_s=0.5 * np.arange(60.0))
    curve = scan_offsets(TimedRanges(*(np.concatenate(pair) for pair in zip(sparse, dense))), path)
    assert curve.offsets_s.max() < -1e5


@pytest.mark.parametrize(("pause_s", "num"), [(9.9, 1), (10.1, 2)])
def test_a_log_is_split_at_pauses_longer_than_the_path(pause_s: float, num: int) -> None:
    times = np.array([3.0, 1.0, 2.0, 3.0 + pause_s, 4.0 + pause_s])
    parts = search._parts(times, 10.0)
    assert [part.tolist() for part in parts] == ([[1, 2, 0, 3, 4]] if num == 1 else [[1, 2, 0], [3, 4]])


def test_the_first_ranges_on_the_path_are_taken_up_to_a_number() -> None:
    path = winding(100)
    ranges = TimedRanges(np.array([9.0, 1.0, 2.0, 3.0]), np.arange(4.0), np.arange(4), np.arange(4))
    np.testing.assert_array_equal(on_path(ranges, path, 1.0, 2).range_m, [1.0, 2.0])
    np.testing.assert_array_equal(on_path(ranges, path, 1.0, 9).range_m, [1.0, 2.0, 3.0])
    np.testing.assert_array_equal(on_path(ranges, path, -8.0, 9).anchor, [0])

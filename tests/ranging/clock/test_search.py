"""The search over all time offsets of the clocks."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rangesfm.arrays import Array
from rangesfm.geometry.trajectory import Trajectory
from rangesfm.options import AssociationOptions
from rangesfm.ranging.clock.search import (
    OffsetCurve,
    PathSamples,
    TimedRanges,
    moving_path,
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

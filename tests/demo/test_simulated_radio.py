"""A simulated radio measures the distance between the antennas, with the errors it is given."""

from __future__ import annotations

import numpy as np
import pytest
from tests.simulated.path import loop_path
from tests.simulated.ranges import simulate_ranges_at

from rangesfm.demo.simulated_radio import CameraPath, Radio, SimulatedRanges, simulate_ranges

PATH = loop_path(100.0, start_s=50.0)
ANCHORS = {"east": (9.0, 1.0, 0.5), "north": (0.0, 8.0, 2.0), "up": (-3.0, -2.0, 4.0)}
TAG = (0.02, -0.12, -0.05)


def test_path_goes_through_the_given_poses() -> None:
    whole = loop_path(20.0, seed=4)
    times = np.linspace(0.0, 20.0, 9)
    path = CameraPath.through(times, whole.centers(times), whole.world_from_cam(times))
    np.testing.assert_allclose(path.centers(times), whole.centers(times), atol=1e-12)
    np.testing.assert_allclose(path.world_from_cam(times), whole.world_from_cam(times), atol=1e-9)


def _errors(simulated: SimulatedRanges) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    return simulated.log.range_m - simulated.distance_m


def test_perfect_radio_measures_the_distance_from_the_lever_arm_to_the_anchor() -> None:
    simulated = simulate_ranges(PATH, ANCHORS, TAG, Radio(rate_hz=5.0, time_offset_s=2.5))
    log = simulated.log
    assert log.timestamp_s is not None
    times = log.timestamp_s + 2.5
    tags = PATH.centers(times) + PATH.world_from_cam(times) @ np.array(TAG)
    anchors = np.array([ANCHORS[log.anchor_ids[index]] for index in log.anchor_index])
    np.testing.assert_allclose(log.range_m, np.linalg.norm(tags - anchors, axis=1), atol=1e-9)
    np.testing.assert_allclose(simulated.image_time_s, times, atol=1e-9)


def test_each_anchor_answers_at_the_rate_and_one_after_the_other() -> None:
    log = simulate_ranges(PATH, ANCHORS, TAG, Radio(rate_hz=5.0)).log
    assert log.timestamp_s is not None
    assert log.anchor_ids == ("east", "north", "up")
    np.testing.assert_array_equal(np.bincount(log.anchor_index), [500, 500, 500])
    np.testing.assert_allclose(np.diff(log.timestamp_s), 1 / 15, atol=1e-9)
    assert log.timestamp_s[0] == 50.0


def test_noise_has_the_given_stddev_and_each_anchor_its_bias() -> None:
    radio = Radio(rate_hz=50.0, range_stddev_m=0.08, range_bias_m={"east": 0.25})
    simulated = simulate_ranges(PATH, ANCHORS, TAG, radio, seed=1)
    for index, bias in enumerate((0.25, 0.0, 0.0)):
        errors = _errors(simulated)[simulated.log.anchor_index == index]
        assert errors.mean() == pytest.approx(bias, abs=4 * 0.08 / np.sqrt(len(errors)))
        assert errors.std() == pytest.approx(0.08, rel=0.05)


def test_obstructed_ranges_are_the_given_share_and_read_long() -> None:
    radio = Radio(rate_hz=50.0, obstructed_share=0.2, obstructed_mean_m=1.5)
    simulated = simulate_ranges(PATH, ANCHORS, TAG, radio, seed=2)
    assert simulated.is_obstructed.mean() == pytest.approx(0.2, abs=0.02)
    errors = _errors(simulated)
    assert np.all(errors[simulated.is_obstructed] > 0)
    assert errors[simulated.is_obstructed].mean() == pytest.approx(1.5, rel=0.1)
    np.testing.assert_allclose(errors[~simulated.is_obstructed], 0.0, atol=1e-12)


def test_lost_ranges_are_the_given_share_of_all() -> None:
    simulated = simulate_ranges(PATH, ANCHORS, TAG, Radio(rate_hz=50.0, lost_share=0.3), seed=3)
    assert len(simulated.log) / 15000 == pytest.approx(0.7, abs=0.02)
    assert len(simulated.image_time_s) == len(simulated.distance_m) == len(simulated.log)


def test_ranges_are_rounded_to_the_resolution() -> None:
    simulated = simulate_ranges(PATH, ANCHORS, TAG, Radio(resolution_m=0.05))
    np.testing.assert_allclose(simulated.log.range_m / 0.05, np.rint(simulated.log.range_m / 0.05), atol=1e-9)
    assert np.abs(_errors(simulated)).max() <= 0.025 + 1e-9


def test_ranges_at_given_poses_are_one_to_each_anchor() -> None:
    times = np.array([60.0, 61.0])
    simulated = simulate_ranges_at(times, PATH.centers(times), PATH.world_from_cam(times), ANCHORS, TAG, Radio())
    assert simulated.log.timestamp_s is not None
    np.testing.assert_array_equal(simulated.log.timestamp_s, [60, 60, 60, 61, 61, 61])
    np.testing.assert_array_equal(simulated.log.anchor_index, [0, 1, 2, 0, 1, 2])
    tag = PATH.centers(times)[1] + PATH.world_from_cam(times)[1] @ np.array(TAG)
    assert simulated.log.range_m[4] == pytest.approx(np.linalg.norm(tag - np.array(ANCHORS["north"])))


def test_same_seed_same_log_and_another_seed_another() -> None:
    radio = Radio(range_stddev_m=0.1, obstructed_share=0.1, lost_share=0.1)
    first, second = (simulate_ranges(PATH, ANCHORS, TAG, radio, seed=7).log for _ in range(2))
    np.testing.assert_array_equal(first.range_m, second.range_m)
    assert len(simulate_ranges(PATH, ANCHORS, TAG, radio, seed=8).log) != len(first)


def test_antenna_on_the_anchor_still_gives_a_positive_range() -> None:
    times = np.array([60.0])
    anchors = {"here": PATH.centers(times)[0]}
    radio = Radio(range_bias_m={"here": -0.5})
    simulated = simulate_ranges_at(times, PATH.centers(times), PATH.world_from_cam(times), anchors, (0, 0, 0), radio)
    assert simulated.log.range_m[0] > 0

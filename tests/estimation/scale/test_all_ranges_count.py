"""Ranges between photos, and many ranges at one photo, all contribute to the scale."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation
from scipy.stats import chi2
from tests.simulated.path import loop_path

from rangesfm.demo.simulated_radio import CameraPath, Radio, simulate_ranges
from rangesfm.estimation.scale.initialize import initialize_scale
from rangesfm.estimation.scale.scale_estimate import ScaleEstimate
from rangesfm.measurements.ranges.anchors.anchor import Anchor
from rangesfm.measurements.ranges.association import associate
from rangesfm.measurements.ranges.range_log import RangeLog
from rangesfm.measurements.ranges.range_observations import RangeObservations, RangeStatus
from rangesfm.options import RangeModelOptions, ScaleOptions
from rangesfm.util.geometry.trajectory import Trajectory

Array = npt.NDArray[np.float64]

TAG_IN_CAM_M = (0.05, -0.12, -0.03)
TRUE_SCALE = 0.45
RANGE_STDDEV_M = 0.1
# Biases are known to be zero.
RANGE_MODEL = RangeModelOptions(range_bias_stddev_m=0.0, common_bias_stddev_m=0.0)
OPTIONS = ScaleOptions(max_relative_stddev=1.0)


def unscaled(path: CameraPath, times: Array) -> Trajectory:
    """Keyframes in the first camera's frame, in a unit of their own."""
    rotation, origin = path.world_from_cam(times[:1])[0], path.centers(times[:1])[0]
    names = tuple(f"{number:03d}.jpg" for number in range(len(times)))
    centers = (path.centers(times) - origin) @ rotation / TRUE_SCALE
    return Trajectory(np.arange(len(times)), names, times, centers, rotation.T @ path.world_from_cam(times))


def in_first_camera(path: CameraPath, time: float, position: Array) -> Array:
    rotation, origin = path.world_from_cam(np.array([time]))[0], path.centers(np.array([time]))[0]
    return np.asarray(rotation.T @ (position - origin))


def scale_of(observations: RangeObservations, trajectory: Trajectory, anchors: list[Anchor]) -> ScaleEstimate:
    return initialize_scale(
        observations, trajectory, anchors, anchor_frame="first_camera", options=OPTIONS, range_model=RANGE_MODEL, seed=0
    )


def test_interpolated_ranges_give_a_far_better_scale_than_those_at_photos_alone() -> None:
    positions = {"A": np.array([9.0, 1.0, 2.0]), "B": np.array([-8.0, 6.0, 1.0])}
    errors_of_all, errors_of_near = [], []
    for seed in range(10):
        path = loop_path(60.0, seed=seed)
        trajectory = unscaled(path, np.arange(0.0, 60.0))
        log = simulate_ranges(path, positions, TAG_IN_CAM_M, Radio(10.0, RANGE_STDDEV_M), seed)
        anchors = [Anchor(name, in_first_camera(path, 0.0, position)) for name, position in positions.items()]
        found = associate(log, trajectory, TAG_IN_CAM_M)
        is_far = np.abs(log.timestamp_s - np.rint(log.timestamp_s)) > 0.02
        near = replace(found, status=np.where(is_far, RangeStatus.CHECK, found.status).astype(np.int8))
        errors_of_all.append(scale_of(found, trajectory, anchors).value / TRUE_SCALE - 1)
        errors_of_near.append(scale_of(near, trajectory, anchors).value / TRUE_SCALE - 1)
    # Ten times as many ranges make the scale up to 3.2 times as accurate.
    assert np.sqrt(np.mean(np.square(errors_of_all))) < 0.6 * np.sqrt(np.mean(np.square(errors_of_near)))


def stop_and_go_log(stops: Array, rotations: Array, anchor_m: Array, num_at_each: int, seed: int) -> RangeLog:
    """A log of ranges within a second around each stop; the stops are ten seconds apart."""
    rng = np.random.default_rng([seed, num_at_each])
    stop = np.repeat(np.arange(len(stops)), num_at_each)
    times = 10.0 * stop + rng.uniform(-1.0, 1.0, len(stop))
    tags = stops + rotations @ np.array(TAG_IN_CAM_M)
    ranges = np.linalg.norm(tags[stop] - anchor_m, axis=1) + RANGE_STDDEV_M * rng.standard_normal(len(stop))
    return RangeLog.from_arrays(["A"] * len(stop), ranges, timestamp_s=times)


def test_ranges_at_a_still_camera_all_count() -> None:
    rng = np.random.default_rng(0)
    angle = np.linspace(0.0, 5.0, 25)
    stops = np.stack([5 * np.cos(angle), 5 * np.sin(angle), 0.3 * np.sin(2 * angle)], axis=1)
    rotations = Rotation.from_rotvec(rng.normal(0, 0.4, (25, 3))).as_matrix()
    rotations, stops = rotations[0].T @ rotations, (stops - stops[0]) @ rotations[0]
    anchor_m, num_seeds = np.array([9.0, 6.0, 3.0]), 30
    names = tuple(f"{number:02d}.jpg" for number in range(25))
    trajectory = Trajectory(np.arange(25), names, np.linspace(0.0, 240.0, 25), stops / TRUE_SCALE, rotations)
    least, most = np.sqrt(chi2.ppf([0.001, 0.999], num_seeds) / num_seeds)
    spreads = []
    for num_at_each in (6, 200):  # with 200, there are more ranges than errors are learnt from
        errors, stated = [], []
        for seed in range(num_seeds):
            log = stop_and_go_log(stops, rotations, anchor_m, num_at_each, seed)
            found = associate(log, trajectory, TAG_IN_CAM_M)
            assert np.all(found.status == RangeStatus.USED)
            np.testing.assert_array_equal(found.before, np.repeat(np.arange(25), num_at_each))
            np.testing.assert_array_equal(found.before, found.after)
            estimate = scale_of(found, trajectory, [Anchor("A", anchor_m)])
            errors.append(estimate.value / TRUE_SCALE - 1)
            stated.append(estimate.uncertainty.components["white"])
        spreads.append(np.sqrt(np.mean(np.square(errors))))
        assert least < spreads[-1] / np.median(stated) < most
    # Noise is all that these ranges have, but not all that is expected of a radio. Errors that last, as by distance,
    # are so much larger than the noise of 5000 ranges that the weights are chosen for these: the spread is not 5.8, but
    # at least 4 times smaller.
    assert spreads[1] < spreads[0] / 4

"""The scale by an inertial sensor alone: it is near the truth within its interval, and open where the motion is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation
from tests.simulated.inertial import CAM_FROM_IMU, Motion, by_hand, by_walk, imu_log, photos
from tests.simulated.model import synthetic_model
from tests.simulated.surveys import adjusted

from rangesfm.demo.simulated_imu import PHONE
from rangesfm.errors import GeometryError
from rangesfm.estimation.photo_bending import bending_of_model
from rangesfm.measurements.imu.inertial_fit import InertialProblem
from rangesfm.measurements.imu.inertial_scale import InertialScale, scale_by_sensor
from rangesfm.measurements.imu.log import ImuLog, clipped_samples
from rangesfm.measurements.imu.motion import Mounting
from rangesfm.measurements.imu.sensor_prior import SensorPrior
from rangesfm.options import CameraOptions, RefineOptions
from rangesfm.solver.bending import WalkBending
from rangesfm.util.geometry.similarity import IDENTITY, align_points
from rangesfm.util.geometry.trajectory import trajectory_from_reconstruction

Array = npt.NDArray[np.float64]
METRES_PER_UNIT = 1 / 0.37
PRIOR = SensorPrior(clock_s=0.005, turn_rad=0.01, arm_m=0.02)


def posed(motion: Motion, accel_scale: Array, *, seed: int = 1) -> InertialProblem:
    """Return a log with scale errors on the path of photos."""
    log, path = imu_log(motion, seed=seed), photos(motion, noise_rad=3e-4)
    log = ImuLog(log.timestamp_s, log.gyro_rad_s, (1 + accel_scale) * log.accel_m_s2)
    return InertialProblem(log, Mounting(CAM_FROM_IMU, np.zeros(3)), PRIOR, WalkBending(path))


def located(motion: Motion, accel_scale: Array, *, seed: int = 1) -> InertialScale:
    """Return its scale."""
    problem = posed(motion, accel_scale, seed=seed)
    return scale_by_sensor(problem)


@pytest.fixture(scope="module")
def of_hands() -> list[InertialScale]:
    """Scales by sensors whose axes have scale errors."""
    scale_errors = [np.random.default_rng(seed).normal(0, 0.03, 3) for seed in range(4)]
    hands = [by_hand(seed, axes=(3.0, 3.0, 3.0)) for seed in range(4)]
    return [located(hand, errors, seed=k) for k, (hand, errors) in enumerate(zip(hands, scale_errors, strict=True))]


def test_a_log_gives_metres_whatever_the_scale_errors_of_its_axes(of_hands: list[InertialScale]) -> None:
    errors = []
    for found in (each.alone for each in of_hands):
        off = np.log(found.scale.value / METRES_PER_UNIT)
        assert found.posterior.uncertainty.half_width_95 < 0.03
        errors.append(off / found.posterior.uncertainty.empirical)
    assert np.abs(errors).max() < 3
    assert np.sqrt(np.mean(np.square(errors))) < 2


def test_errors_of_photos_on_an_even_walk_do_not_make_the_map_smaller() -> None:
    errors = []
    for seed in range(4):
        motion = by_walk(seed)
        path = photos(motion, every_s=0.5, noise_rad=5e-4, noise_m=0.005, seed=seed)
        mounting, log = Mounting(CAM_FROM_IMU, np.zeros(3)), imu_log(motion, grade=PHONE, seed=seed)
        found = scale_by_sensor(InertialProblem(log, mounting, PRIOR, WalkBending(path))).alone
        errors.append([np.log(found.scale.value / METRES_PER_UNIT), found.posterior.uncertainty.empirical])
    off, stddev = np.transpose(errors)
    assert abs(off.mean()) < 0.05
    assert np.abs(off / stddev).max() < 3
    assert np.sqrt(np.mean(np.square(off / stddev))) < 1.7


def test_the_sensor_corrects_the_shape_of_a_map_by_bad_photos_and_not_only_its_scale() -> None:
    for seed in (9, 10):
        motion, times_s = by_hand(seed), np.arange(2.0, 58.0, 0.7)
        turns = motion.world_from_imu(times_s).as_matrix() @ CAM_FROM_IMU.T
        made = synthetic_model(
            *(times_s, motion.places_m(times_s), turns),
            num_observations=60,
            max_track_length=8,
            depth_range_m=(1.5, 6.0),
            pixel_stddev=2.0,
            metric_from_sfm=IDENTITY,
            seed=seed,
        )
        model = adjusted(made.reconstruction)
        path = trajectory_from_reconstruction(model, made.timestamps_s)
        bending = bending_of_model(model, path, CameraOptions(refine_intrinsics=False), RefineOptions(), 1)
        log = imu_log(motion, grade=PHONE, seed=seed)
        found = scale_by_sensor(InertialProblem(log, Mounting(CAM_FROM_IMU, np.zeros(3)), PRIOR, bending)).alone
        off = np.log(found.scale.value / align_points(path.centers, made.centers_m).scale)
        assert abs(off) < 0.008
        assert found.posterior.uncertainty.half_width_95 < 0.01


def test_the_interval_of_a_rover_that_hardly_turns_or_accelerates_is_wide() -> None:
    hand = by_hand(0, axes=(0.0, 0.0, 1.0))
    slow = replace(hand, frequencies_hz=hand.frequencies_hz / 10, amplitudes_rad=hand.amplitudes_rad / 10)
    [doubt] = (kind := located(slow, np.zeros(3))).doubts(kind.alone.posterior.uncertainty)
    assert kind.alone.posterior.uncertainty.half_width_95 > 0.04
    assert "moved too evenly" in doubt.reason


def test_the_upward_direction_is_known_to_less_than_half_a_degree(of_hands: list[InertialScale]) -> None:
    errors = []
    for found in of_hands:
        # The simulated world is upright after it was turned by this rotation.
        upright = Rotation.from_rotvec([0.3, -1.0, 2.0]).apply([0.0, 0.0, 1.0])
        true = found.problem.path.world_from_cam[0].T @ upright
        assert found.upward.stddev_rad < np.deg2rad(0.5)
        errors.append(np.linalg.norm(found.upward.up_in_first_camera - true) / found.upward.stddev_rad)
    assert np.max(errors) < 4


def test_axes_that_are_not_at_right_angles_neither_tilt_the_map_nor_hide_its_scale() -> None:
    problem = posed(by_hand(1, axes=(3.0, 3.0, 3.0)), np.zeros(3))
    across = np.array([[0.0, 0.02, -0.01], [-0.01, 0.0, 0.02], [0.02, 0.01, 0.0]])
    log = replace(problem.log, accel_m_s2=problem.log.accel_m_s2 @ (np.eye(3) + across).T)
    right, wrong = (scale_by_sensor(replace(problem, log=each)) for each in (problem.log, log))
    assert wrong.alone.posterior.uncertainty.half_width_95 < 1.2 * right.alone.posterior.uncertainty.half_width_95
    assert wrong.alone.scale.value == pytest.approx(right.alone.scale.value, rel=0.002)
    apart = np.linalg.norm(wrong.upward.up_in_first_camera - right.upward.up_in_first_camera)
    assert apart < right.upward.stddev_rad


def test_a_log_of_another_day_is_refused() -> None:
    problem = posed(by_hand(), np.zeros(3))
    later = replace(problem.log, timestamp_s=problem.log.timestamp_s + 86400.0)
    with pytest.raises(GeometryError, match="no time in common"):
        scale_by_sensor(replace(problem, log=later))


def clipped_at(log: ImuLog, most_m_s2: float) -> ImuLog:
    accel_m_s2 = np.clip(log.accel_m_s2, -most_m_s2, most_m_s2)
    return replace(log, accel_m_s2=accel_m_s2, clipped=clipped_samples(log.gyro_rad_s, accel_m_s2))


def test_a_stretch_at_the_end_of_an_accelerometers_scale_is_left_out() -> None:
    """A fifth of the samples is clipped, at a value that no data sheet has."""
    problem = posed(by_hand(5, axes=(3.0, 3.0, 3.0)), np.zeros(3))
    log = problem.log
    most = float(np.quantile(np.abs(log.accel_m_s2).max(axis=1), 0.8))
    clipped = clipped_at(log, most)
    assert np.mean(clipped.clipped[:, 1]) == pytest.approx(0.2, abs=0.01)
    assert not clipped.clipped[:, 0].any()
    assert not clipped_at(log, 2 * np.abs(log.accel_m_s2).max()).clipped.any()
    whole, found = (scale_by_sensor(replace(problem, log=each)) for each in (log, clipped))
    assert len(found.intervals) < len(whole.intervals)
    off = [float(np.log(each.alone.scale.value / METRES_PER_UNIT)) for each in (whole, found)]
    assert abs(off[1]) < 0.01 + abs(off[0])
    assert abs(off[1]) < 3 * found.alone.posterior.uncertainty.empirical


def test_a_sensor_that_is_at_the_end_of_its_scale_between_all_photos_tells_nothing() -> None:
    problem = posed(by_hand(5), np.zeros(3))
    clipped = clipped_at(problem.log, 1.0)
    with pytest.raises(GeometryError, match="at the end of its scale between all photos"):
        scale_by_sensor(replace(problem, log=clipped))

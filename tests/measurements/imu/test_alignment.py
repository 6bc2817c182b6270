"""A sensor's log is aligned with photos by the turns that both have seen, and mistakes are named."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.simulated.inertial import CAM_FROM_IMU, by_hand, imu_log, photos

from rangesfm.arrays import Array
from rangesfm.errors import GeometryError, InputError
from rangesfm.measurements.imu.alignment import ImuAlignment, align_imu
from rangesfm.measurements.imu.log import ImuLog

MOTION = by_hand()
OFFSET_S = -1234.567
LOG, PATH = imu_log(MOTION, offset_s=OFFSET_S), photos(MOTION)


def turned(rotation: Array) -> float:
    """Angle of a rotation, radians."""
    return float(np.linalg.norm(Rotation.from_matrix(rotation).as_rotvec()))


@pytest.mark.parametrize("num_seeds", [4, 12])
def test_offset_rotation_and_bias_are_found_within_their_errors(num_seeds: int) -> None:
    errors = []
    for seed in range(num_seeds):
        motion = by_hand(seed)
        found = align_imu(imu_log(motion, offset_s=OFFSET_S, seed=seed), photos(motion))
        assert not found.mistakes
        turn = Rotation.from_matrix(found.cam_from_imu @ CAM_FROM_IMU.T).as_rotvec()
        stddevs = np.sqrt(np.diag(found.rotation_covariance))
        biases = (found.gyro_bias_rad_s - [0.01, -0.02, 0.015]) / np.sqrt(np.diag(found.covariance)[4:])
        errors.append([(found.time_offset_s - OFFSET_S) / found.time_offset_stddev_s, *turn / stddevs, *biases])
        assert found.time_offset_stddev_s < 1e-3
        assert abs(found.time_offset_s - OFFSET_S) < 3e-3
        assert np.linalg.norm(turn) < np.radians(0.3)
    # Neighbouring turns share a photo, whose error cancels in their sum: the stated errors are rather too large.
    assert 0.2 < np.sqrt(np.mean(np.square(errors))) < 1.3


def test_right_values_that_are_given_are_no_mistakes() -> None:
    nearly = Rotation.from_rotvec([0.0, 0.008, 0.0]).as_matrix() @ CAM_FROM_IMU
    assert not align_imu(LOG, PATH, time_offset_s=OFFSET_S + 0.004, cam_from_imu=nearly).mistakes


def with_wrong_photos(share: float) -> ImuAlignment:
    rng = np.random.default_rng(0)
    world_from_cam = PATH.world_from_cam.copy()
    for k in np.flatnonzero(rng.random(len(PATH)) < share):
        world_from_cam[k] = Rotation.random(random_state=int(k)).as_matrix()
    return align_imu(LOG, replace(PATH, world_from_cam=world_from_cam))


def test_some_photos_with_wrong_poses_change_little() -> None:
    assert abs(with_wrong_photos(0.05).time_offset_s - OFFSET_S) < 3e-3


def test_gaps_in_the_log_are_left_out() -> None:
    away = (LOG.timestamp_s - LOG.timestamp_s[0]) % 10.0 < 1.0
    rest = ImuLog(LOG.timestamp_s[~away], LOG.gyro_rad_s[~away], LOG.accel_m_s2[~away])
    found = align_imu(rest, PATH)
    assert abs(found.time_offset_s - OFFSET_S) < 3e-3
    assert len(found.turns) < 0.85 * len(PATH)


def changed(*, gyro: Array | None = None, accel: Array | None = None) -> ImuLog:
    return replace(
        LOG,
        gyro_rad_s=LOG.gyro_rad_s if gyro is None else gyro,
        accel_m_s2=LOG.accel_m_s2 if accel is None else accel,
    )


def test_degrees_are_named_and_converted() -> None:
    found = align_imu(changed(gyro=np.degrees(LOG.gyro_rad_s)), PATH)
    assert ["taken as degrees a second" in line for line in found.mistakes] == [True]
    assert abs(found.time_offset_s - OFFSET_S) < 3e-3
    np.testing.assert_allclose(found.log.gyro_rad_s, LOG.gyro_rad_s)


@pytest.mark.parametrize("wrong", [LOG.gyro_rad_s[:, [1, 0, 2]], LOG.gyro_rad_s * [1, 1, -1], -LOG.gyro_rad_s])
def test_a_mirrored_gyroscope_is_refused(wrong: Array) -> None:
    with pytest.raises(GeometryError, match=r"imu\.csv: the turns of the gyroscope are .* in a mirror"):
        align_imu(changed(gyro=wrong), PATH)


def test_axes_of_the_accelerometer_that_are_not_those_of_the_gyroscope_are_named() -> None:
    with pytest.raises(GeometryError, match="y, z, x of the gyroscope"):
        align_imu(changed(accel=LOG.accel_m_s2[:, [1, 2, 0]]), PATH)


def test_an_accelerometer_without_gravity_is_named() -> None:
    up = np.array([0.0, 0.0, 9.81])
    times_s = LOG.timestamp_s + OFFSET_S
    with pytest.raises(GeometryError, match="with gravity in it"):
        align_imu(changed(accel=LOG.accel_m_s2 - MOTION.world_from_imu(times_s).inv().apply(up)), PATH)


def test_a_sensor_that_slips_is_named() -> None:
    half, slip = len(LOG.timestamp_s) // 2, Rotation.from_euler("y", 20, degrees=True)
    gyro, accel = (np.vstack([of[:half], slip.apply(of[half:])]) for of in (LOG.gyro_rad_s, LOG.accel_m_s2))
    with pytest.raises(GeometryError, match=r"sits 20 deg otherwise .* fixed to the camera"):
        align_imu(changed(gyro=gyro, accel=accel), PATH)


def test_wrong_values_that_are_given_are_named_and_not_taken() -> None:
    found = align_imu(LOG, PATH, time_offset_s=-OFFSET_S, cam_from_imu=CAM_FROM_IMU.T)
    rotation, offset = found.mistakes
    assert "give its inverse" in rotation
    assert "it has the other sign" in offset
    assert abs(found.time_offset_s - OFFSET_S) < 3e-3
    tilted = Rotation.from_rotvec([0.0, 0.1, 0.0]).as_matrix() @ CAM_FROM_IMU
    (line,) = align_imu(LOG, PATH, cam_from_imu=tilted).mistakes
    assert "is 5.7 deg from the one" in line


def test_a_log_of_something_else_is_refused() -> None:
    with pytest.raises(GeometryError, match="is the log of this survey"):
        align_imu(imu_log(by_hand(99)), PATH)


def test_turns_about_one_axis_need_the_rotation() -> None:
    motion = by_hand(axes=(0.0, 0.0, 1.0))
    log, path = imu_log(motion), photos(motion)
    with pytest.raises(GeometryError, match=r"do not determine how the sensor sits.*about two axes"):
        align_imu(log, path)
    found = align_imu(log, path, cam_from_imu=CAM_FROM_IMU)
    assert not found.mistakes
    assert abs(found.time_offset_s) < 3e-3
    np.testing.assert_allclose(found.cam_from_imu, CAM_FROM_IMU)


def test_a_camera_that_does_not_turn_is_refused() -> None:
    motion = by_hand(axes=(0.0, 0.0, 0.0))
    with pytest.raises(GeometryError):
        align_imu(imu_log(motion), photos(motion))


def test_a_motion_that_repeats_leaves_the_offset_open() -> None:
    motion = by_hand()
    swing = replace(motion, frequencies_hz=np.round(motion.frequencies_hz * 8).clip(1) / 8)
    with pytest.raises(GeometryError, match="at time offsets of"):
        align_imu(imu_log(swing), photos(swing))


@pytest.mark.parametrize(
    ("path", "kind", "text"),
    [
        (replace(PATH, timestamps_s=None), InputError, "give image times"),
        (photos(MOTION, until_s=6.0), GeometryError, "5 turns between photos"),
        (photos(MOTION, every_s=7.0), GeometryError, "0 turns between photos at most 5 s apart"),
    ],
)
def test_photos_that_tell_nothing_are_refused(path: object, kind: type[Exception], text: str) -> None:
    with pytest.raises(kind, match=text):
        align_imu(LOG, path)  # type: ignore[arg-type]


def test_a_log_shorter_than_the_turns_is_refused() -> None:
    short = ImuLog(LOG.timestamp_s[:200], LOG.gyro_rad_s[:200], LOG.accel_m_s2[:200], "imu.csv")
    with pytest.raises(InputError, match=r"imu\.csv: the sensor's log .* has no stretch without gaps"):
        align_imu(short, PATH)

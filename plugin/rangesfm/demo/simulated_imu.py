"""Simulated log of an inertial sensor along a known motion, with noise, zeros that wander, and scale factors."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from rangesfm.arrays import Array
from rangesfm.measurements.imu.formats import CANONICAL_COLUMNS
from rangesfm.measurements.imu.log import ImuLog

GRAVITY_M_S2 = 9.81
_STEP_S = 1e-3  # over which a motion is differentiated


@dataclass(frozen=True)
class Grade:
    """Errors of a sensor.

    Attributes:
        gyro_noise, accel_noise: white noise, rad/s and m/s^2 per root of Hz.
        gyro_bias, accel_bias: standard deviations of the zeros, rad/s and m/s^2. gyro_walk, accel_walk: of their random
            walks after a second.
        scale: standard deviation of the scale factor of each axis of the accelerometer; a tenth of it of the gyroscope.
        cross: standard deviation of the share by which an axis of the accelerometer reads of each other.
    """

    gyro_noise: float
    accel_noise: float
    gyro_bias: float
    accel_bias: float
    gyro_walk: float
    accel_walk: float
    scale: float = 0.03
    cross: float = 0.01


PHONE = Grade(2e-4, 3e-3, 0.015, 0.1, 1e-5, 5e-4)


def simulate_imu(
    world_from_imu: Callable[[Array], Rotation],
    places_m: Callable[[Array], Array],
    times_s: Array,
    rate_hz: float,
    grade: Grade,
    rng: np.random.Generator,
    gravity_m_s2: float = GRAVITY_M_S2,
) -> ImuLog:
    """Return what a sensor measures on its way through a world whose z is up.

    Args:
        world_from_imu: returns its k rotations at (k,) times. places_m: returns its (k, 3) places. Both are
            differentiated, for which times near zero are exact enough, and those since 1970 are not.
        times_s: (k,) of its samples, which are evenly spaced by ``rate_hz``.
    """
    h = _STEP_S
    now = world_from_imu(times_s)
    gyro = (world_from_imu(times_s - h).inv() * world_from_imu(times_s + h)).as_rotvec() / (2 * h)
    later, here, before = (places_m(times_s + k * h) for k in (1, 0, -1))
    force = now.inv().apply((later - 2 * here + before) / h**2 + np.array([0.0, 0.0, gravity_m_s2]))
    walked = rng.normal(size=(2, *gyro.shape)).cumsum(axis=1) / np.sqrt(rate_hz)
    zeros, scales = rng.normal(size=(2, 2, 3))
    noise = rng.normal(size=(2, *gyro.shape)) * np.sqrt(rate_hz)
    cross = grade.cross * rng.normal(size=(3, 3)) * (1 - np.eye(3))
    gyro = (1 + 0.1 * grade.scale * scales[0]) * gyro + grade.gyro_bias * zeros[0] + grade.gyro_walk * walked[0]
    force = (
        (1 + grade.scale * scales[1]) * force
        + force @ cross.T
        + grade.accel_bias * zeros[1]
        + grade.accel_walk * walked[1]
    )
    return ImuLog(times_s, gyro + grade.gyro_noise * noise[0], force + grade.accel_noise * noise[1])


def imu_table(log: ImuLog) -> str:
    """Return the text of a log in the canonical table."""
    values = np.column_stack([log.timestamp_s, log.gyro_rad_s, log.accel_m_s2])
    rows = (",".join([f"{time_s:.3f}", *(f"{value:.5f}" for value in row)]) for time_s, *row in values.tolist())
    return "\n".join([",".join(CANONICAL_COLUMNS), *rows]) + "\n"

"""A simulated inertial sensor on a camera that is carried by hand, and the photos that it took."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from rangesfm.arrays import Array
from rangesfm.geometry.trajectory import Trajectory
from rangesfm.measurements.imu.log import ImuLog

GRAVITY_M_S2 = 9.81
CAM_FROM_IMU = Rotation.from_euler("zyx", (100.0, -20.0, 65.0), degrees=True).as_matrix()


@dataclass(frozen=True)
class Motion:
    """A smooth motion of a sensor: turns about its axes and a path, each a sum of sines.

    Attributes:
        amplitudes_rad: (3, m) of the angles about x, y and z. amplitudes_m: (3, m) of the place.
        frequencies_hz: (m,). phases: (3, m).
    """

    amplitudes_rad: Array
    amplitudes_m: Array
    frequencies_hz: Array
    phases: Array

    def world_from_imu(self, times_s: Array) -> Rotation:
        waves = np.sin(2 * np.pi * self.frequencies_hz * times_s[:, None, None] + self.phases)
        return Rotation.from_euler("zyx", np.sum(self.amplitudes_rad * waves, axis=2)[:, ::-1])

    def places_m(self, times_s: Array) -> Array:
        waves = np.sin(2 * np.pi * self.frequencies_hz * times_s[:, None, None] + self.phases[::-1])
        return np.asarray(np.sum(self.amplitudes_m * waves, axis=2))


def by_hand(seed: int = 0, *, axes: tuple[float, float, float] = (1.0, 1.0, 1.0)) -> Motion:
    """Return a motion that turns about three axes, or less about some of them."""
    rng = np.random.default_rng(seed)
    frequencies_hz = rng.uniform(0.03, 0.8, 12)
    turns = rng.normal(size=(3, 12)) * np.array(axes)[:, None] * 0.08 / frequencies_hz**0.5
    return Motion(
        turns, rng.normal(size=(3, 12)) * 0.02 / frequencies_hz, frequencies_hz, rng.uniform(0, 6.28, (3, 12))
    )


def imu_log(
    motion: Motion, *, offset_s: float = 0.0, rate_hz: float = 100.0, until_s: float = 70.0, seed: int = 1
) -> ImuLog:
    """Return the log of a sensor with the noise and the biases of a phone's.

    Args:
        offset_s: image time minus time of the log.
    """
    rng = np.random.default_rng(seed)
    times_s = np.arange(0.0, until_s, 1 / rate_hz)
    h = 1e-3
    now = motion.world_from_imu(times_s)
    gyro = (motion.world_from_imu(times_s - h).inv() * motion.world_from_imu(times_s + h)).as_rotvec() / (2 * h)
    later, here, before = (motion.places_m(times_s + k * h) for k in (1, 0, -1))
    force = now.inv().apply((later - 2 * here + before) / h**2 + np.array([0.0, 0.0, GRAVITY_M_S2]))
    gyro = gyro + rng.normal(size=gyro.shape) * 2e-3 + np.array([0.01, -0.02, 0.015])
    force = force + rng.normal(size=force.shape) * 0.03 + np.array([0.05, 0.02, -0.08])
    return ImuLog(times_s - offset_s, gyro, force, "imu.csv")


def photos(motion: Motion, *, until_s: float = 60.0, every_s: float = 0.7, noise_rad: float = 1e-3) -> Trajectory:
    """Return the path of the camera, in a world of its own and another unit."""
    rng = np.random.default_rng(3)
    times_s = np.arange(2.0, until_s, every_s)
    errors = Rotation.from_rotvec(rng.normal(size=(len(times_s), 3)) * noise_rad)
    world = Rotation.from_rotvec([0.3, -1.0, 2.0])
    turns = world * motion.world_from_imu(times_s) * Rotation.from_matrix(CAM_FROM_IMU.T) * errors
    names = tuple(f"{k:04}.jpg" for k in range(len(times_s)))
    centers = world.apply(motion.places_m(times_s)) * 0.37
    return Trajectory(np.arange(len(times_s)), names, times_s, centers, turns.as_matrix())

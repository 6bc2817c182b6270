"""A simulated inertial sensor on a camera that a hand, a drone or a rover carries, and the photos that it took."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from rangesfm.arrays import Array
from rangesfm.demo.simulated_imu import GRAVITY_M_S2, Grade, simulate_imu
from rangesfm.measurements.imu.log import ImuLog
from rangesfm.util.geometry.trajectory import Trajectory

RATE_HZ = 100.0
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


@dataclass(frozen=True)
class Walk(Motion):
    """A motion by hand that is carried round a room: a circle at steady speed, on which the camera looks forward.

    Attributes:
        radius_m: of the circle. speed_m_s: on it.
    """

    radius_m: float
    speed_m_s: float

    def _angles(self, times_s: Array) -> Array:
        return times_s * self.speed_m_s / self.radius_m

    def world_from_imu(self, times_s: Array) -> Rotation:
        return Rotation.from_euler("z", self._angles(times_s)[:, None]) * super().world_from_imu(times_s)

    def places_m(self, times_s: Array) -> Array:
        angles = self._angles(times_s)
        circle = self.radius_m * np.column_stack([np.cos(angles), np.sin(angles), 0 * angles])
        return np.asarray(circle + super().places_m(times_s))


def by_walk(seed: int = 0) -> Walk:
    """Return an even walk round a room, with a hand that hardly sways."""
    rng = np.random.default_rng(seed)
    frequencies_hz = rng.uniform(0.05, 0.6, 8)
    turns, places = rng.normal(size=(2, 3, 8)) * np.array([[[0.03]], [[0.002]]])
    waves = turns / frequencies_hz**0.5, places / frequencies_hz, frequencies_hz, rng.uniform(0, 6.28, (3, 8))
    return Walk(*waves, radius_m=rng.uniform(1.4, 2.2), speed_m_s=0.5)


def by_hand(seed: int = 0, *, axes: tuple[float, float, float] = (1.0, 1.0, 1.0)) -> Motion:
    """Return a motion that turns about three axes, or less about some of them."""
    rng = np.random.default_rng(seed)
    frequencies_hz = rng.uniform(0.03, 0.8, 12)
    turns = rng.normal(size=(3, 12)) * np.array(axes)[:, None] * 0.08 / frequencies_hz**0.5
    return Motion(
        turns, rng.normal(size=(3, 12)) * 0.02 / frequencies_hz, frequencies_hz, rng.uniform(0, 6.28, (3, 12))
    )


def by_drone(seed: int = 0) -> Motion:
    """Return a flight of some tens of metres, with all headings and small tilts."""
    rng = np.random.default_rng(seed)
    frequencies_hz = rng.uniform(0.02, 0.3, 12)
    turns = rng.normal(size=(3, 12)) * np.array([[0.05], [0.05], [0.2]]) / frequencies_hz**0.5
    places = rng.normal(size=(3, 12)) * np.array([[0.1], [0.1], [0.03]]) / frequencies_hz
    return Motion(turns, places, frequencies_hz, rng.uniform(0, 6.28, (3, 12)))


def by_rover(seed: int = 0) -> Motion:
    """Return a drive on level ground that hardly accelerates."""
    rng = np.random.default_rng(seed)
    frequencies_hz = rng.uniform(0.005, 0.04, 12)
    turns = rng.normal(size=(3, 12)) * np.array([[0.001], [0.001], [0.1]]) / frequencies_hz**0.5
    places = rng.normal(size=(3, 12)) * np.array([[0.003], [0.003], [0.0]]) / frequencies_hz
    return Motion(turns, places, frequencies_hz, rng.uniform(0, 6.28, (3, 12)))


TACTICAL = Grade(1e-5, 2e-4, 1e-3, 0.02, 1e-6, 5e-5)
CONSTANT = Grade(2e-4, 3e-3, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
"""The noise of a phone's sensor, and nothing else besides zeros that are always the same."""
ZEROS = np.array([[0.01, -0.02, 0.015], [0.05, 0.02, -0.08]])


def imu_log(
    motion: Motion,
    *,
    offset_s: float = 0.0,
    until_s: float = 70.0,
    seed: int = 1,
    grade: Grade = CONSTANT,
    gravity_m_s2: float = GRAVITY_M_S2,
) -> ImuLog:
    """Return the log of a sensor.

    Args:
        offset_s: image time minus time of the log.
    """
    times_s = np.arange(0.0, until_s, 1 / RATE_HZ)
    rng = np.random.default_rng(seed)
    log = simulate_imu(motion.world_from_imu, motion.places_m, times_s, RATE_HZ, grade, rng, gravity_m_s2)
    gyro_zero, accel_zero = ZEROS if grade is CONSTANT else np.zeros((2, 3))
    gyro_rad_s, accel_m_s2 = log.gyro_rad_s + gyro_zero, log.accel_m_s2 + accel_zero
    return ImuLog(times_s - offset_s, gyro_rad_s, accel_m_s2, "imu.csv")


def photos(
    motion: Motion,
    *,
    until_s: float = 60.0,
    every_s: float = 0.7,
    noise_rad: float = 1e-3,
    noise_m: float = 0.0,
    bend: float = 0.0,
    seed: int = 3,
) -> Trajectory:
    """Return the path of the camera, in a world of its own and another unit.

    Args:
        bend: how far the path is bent, as a share of its size.
    """
    rng = np.random.default_rng(seed)
    times_s = np.arange(2.0, until_s, every_s)
    errors = Rotation.from_rotvec(rng.normal(size=(len(times_s), 3)) * noise_rad)
    world = Rotation.from_rotvec([0.3, -1.0, 2.0])
    turns = world * motion.world_from_imu(times_s) * Rotation.from_matrix(CAM_FROM_IMU.T) * errors
    names = tuple(f"{k:04}.jpg" for k in range(len(times_s)))
    places_m = motion.places_m(times_s)
    knots_s = np.linspace(times_s[0], times_s[-1], 7)
    bent = bend * np.linalg.norm(places_m.std(axis=0)) * rng.normal(size=(7, 3))
    places_m = places_m + np.column_stack([np.interp(times_s, knots_s, axis) for axis in bent.T])
    centers = world.apply(places_m + noise_m * rng.normal(size=places_m.shape)) * 0.37
    return Trajectory(np.arange(len(times_s)), names, times_s, centers, turns.as_matrix())

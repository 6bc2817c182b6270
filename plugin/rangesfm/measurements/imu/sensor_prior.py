"""What is known of an inertial sensor before its log is looked at: sizes of its errors, with their sources."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rangesfm.arrays import Array
from rangesfm.measurements.imu.log import ImuNoise
from rangesfm.measurements.imu.preintegration import (
    ACCEL,
    ACCEL_BIAS,
    ACCEL_CROSS,
    ACCEL_SCALE,
    CLOCK,
    GYRO,
    GYRO_BIAS,
    GYRO_SCALE,
    NUM_OF_SENSOR,
)

GRAVITY_M_S2 = 9.80
"""Length of gravity: the middle between equator and pole at sea level (WGS 84: 9.780 to 9.832)."""
GRAVITY_STDDEV = 0.0015
"""Relative standard deviation of that length over the earth."""


@dataclass(frozen=True)
class KnownSize:
    """Size of an error over sensors.

    Attributes:
        median: of the standard deviation. spread: standard deviation of its logarithm; 0: it is known.
    """

    median: float
    spread: float

    @property
    def usual(self) -> float:
        """Root mean square of the size over sensors (lognormal)."""
        return float(self.median * np.exp(self.spread**2))

    def about(self, given: float) -> KnownSize:
        """Return the size with a given median, as far apart from it as usual; 0 is what nobody has measured."""
        return replace(self, median=given) if given > 0 else self


# Data sheets of phones' sensors (BMI160, LSM6DSO, MPU-9250) state 0.004 to 0.01 deg/s and 70 to 300 ug per root of Hz.
# kalibr advises several times as much; a tactical sensor has a tenth. The median lies between, with a spread to match.
NOISE = (KnownSize(2e-4, 1.0), KnownSize(3e-3, 1.0))
"""White noise of gyroscope, rad/s/sqrt(Hz), and accelerometer, m/s^2/sqrt(Hz)."""
# Calibrations of TUM-VI (2e-6, 9e-5) and of EuRoC (2e-5, 3e-3).
WALK = (KnownSize(6e-6, 1.2), KnownSize(5e-4, 1.2))
"""Random walk of the biases, rad/s/sqrt(s) and m/s^2/sqrt(s)."""


# Noise of photos besides that of their map: of the times at which they were taken (a millisecond, as of clocks of
# separate devices), and of the poses of a path without points.
PHOTO_TIMES, POSE_TURNS, POSE_PLACES = KnownSize(1e-3, 1.0), KnownSize(3e-4, 1.0), KnownSize(1e-3, 1.0)


ARM_STDDEV_M, GIVEN_ARM_STDDEV_M = 0.05, 0.01
"""Standard deviation of each coordinate of the sensor in the camera, metres: where nothing is known (the half length of
a phone), and as people measure it with a ruler."""


GIVEN_TURN_STDDEV_RAD = float(np.radians(1.0))
"""Standard deviation of a rotation that is given and that the turns of the photos do not show: a protractor's."""


@dataclass(frozen=True)
class SensorPrior:
    """Standard deviations of what is constant.

    Attributes:
        gyro_bias_rad_s, accel_bias_m_s2: offsets at zero (BMI160: 3 deg/s, 40 mg; MPU-9250: 5 deg/s, 60 to 80 mg).
        gyro_scale, accel_scale: shares by which an axis reads too much (MPU-9250, product specification 1.1: 3 % each).
        accel_cross: share by which it reads of another ("cross-axis sensitivity"; BMI160: 1 %, MPU-9250: 2 %).
        clock_s: of the offset between the clocks of sensor and photos.
        turn_rad, arm_m: of the mounting's rotation, and of its place.
        noise, walk: of gyroscope and accelerometer.
    """

    clock_s: float
    turn_rad: float
    arm_m: float
    gyro_bias_rad_s: float = 0.05
    accel_bias_m_s2: float = 0.5
    gyro_scale: float = 0.03
    accel_scale: float = 0.03
    accel_cross: float = 0.01
    noise: tuple[KnownSize, KnownSize] = NOISE
    walk: tuple[KnownSize, KnownSize] = WALK

    def with_given(self, noise: ImuNoise) -> SensorPrior:
        """Return the prior with the sensor's noise as a file states it, which is exceeded in use (kalibr's wiki)."""
        gyro, accel = noise.gyro_noise_density_rad_s_rthz, noise.accel_noise_density_m_s2_rthz
        return replace(
            self,
            noise=(NOISE[GYRO].about(gyro), NOISE[ACCEL].about(accel)),
            walk=(WALK[GYRO].about(noise.gyro_bias_walk), WALK[ACCEL].about(noise.accel_bias_walk)),
        )

    @property
    def of_sensor(self) -> Array:
        """(19,) of the sensor's numbers."""
        found = np.empty(NUM_OF_SENSOR)
        found[GYRO_BIAS], found[ACCEL_BIAS] = self.gyro_bias_rad_s, self.accel_bias_m_s2
        found[GYRO_SCALE], found[ACCEL_SCALE] = self.gyro_scale, self.accel_scale
        found[ACCEL_CROSS], found[CLOCK] = self.accel_cross, self.clock_s
        return found

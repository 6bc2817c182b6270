"""A planned inertial sensor on the camera: what it would say of a map, by its linear problem at the true motion."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Annotated, Literal

import numpy as np
from pydantic import Field
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from rangesfm.errors import GeometryError
from rangesfm.measurements.imu.alignment import MIN_NUM_TURNS
from rangesfm.measurements.imu.inertial_fit import InertialProblem, InertialState
from rangesfm.measurements.imu.inertial_scale import InertialScale
from rangesfm.measurements.imu.log import ImuLog
from rangesfm.measurements.imu.motion import Mounting
from rangesfm.measurements.imu.sensor_prior import (
    ARM_STDDEV_M,
    GIVEN_TURN_STDDEV_RAD,
    GRAVITY_M_S2,
    NOISE,
    PHOTO_TIMES,
    POSE_PLACES,
    POSE_TURNS,
    WALK,
    SensorPrior,
)
from rangesfm.measurements.imu.words import IMU
from rangesfm.measurements.planned_kind import PlannedKind
from rangesfm.solver.bending import MapBending
from rangesfm.util.geometry.gravity import UP_IN_SITE

# Noise of a tactical sensor, as a share of a phone's (see ``NOISE``).
_TACTICAL = 0.1
# Samples a second of phones.
_RATE_HZ = 100.0
_Noise = Annotated[float, Field(ge=1e-7, le=1.0)]


class PlannedSensor(PlannedKind, table=IMU):
    """Planned inertial sensor on the camera: a gyroscope and an accelerometer."""

    advice = "record the inertial sensor of a phone on the camera"

    grade: Literal["phone", "tactical"] = "phone"
    """Noise of the sensor: that of phones, action cameras and cheap rigs, or a tenth of it."""
    gyro_noise: _Noise | None = None
    """Noise density of the gyroscope, rad/s per root of Hz (default: by the grade)."""
    accel_noise: _Noise | None = None
    """Noise density of the accelerometer, m/s^2 per root of Hz (default: by the grade)."""

    @classmethod
    def like(cls, learnt: Mapping[str, float]) -> PlannedSensor:
        """Return a sensor with the noise of that of a result."""
        return cls(gyro_noise=learnt.get("gyro_noise"), accel_noise=learnt.get("accel_noise"))

    @property
    def sizes(self) -> Mapping[str, float]:
        """Sizes of the errors that a run would learn, by name."""
        share = _TACTICAL if self.grade == "tactical" else 1.0
        (gyro, accel), (gyro_walk, accel_walk) = ([share * each.usual for each in sizes] for sizes in (NOISE, WALK))
        return {
            "gyro_noise": self.gyro_noise or gyro,
            "accel_noise": self.accel_noise or accel,
            "gyro_bias_walk": gyro_walk,
            "accel_bias_walk": accel_walk,
            "photo_times": PHOTO_TIMES.usual,
            "pose_turns": POSE_TURNS.usual,
            "pose_places": POSE_PLACES.usual,
        }

    def on_map(self, bending: MapBending) -> InertialScale:
        """Return what the sensor says of a true map.

        It sits with its axes along those of the camera, which moves smoothly from photo to photo. What a run finds of
        its rotation, or is given, is known to a degree, and its clock to a part of a sample.

        Args:
            bending: of the map, in the site with z up.

        Raises:
            GeometryError: there are fewer photos than a run needs to align the sensor.
        """
        path = bending.path
        if len(path) <= MIN_NUM_TURNS:
            raise GeometryError(f"{len(path)} photos do not tell how it sits, expected more than {MIN_NUM_TURNS}")
        times_s, mounting = path.times_s, Mounting(np.eye(3), np.zeros(3))
        places, turns = (
            CubicSpline(times_s, path.centers),
            RotationSpline(times_s, Rotation.from_matrix(path.world_from_cam)),
        )
        at_s = np.linspace(times_s[0], times_s[-1], int((times_s[-1] - times_s[0]) * _RATE_HZ) + 2)
        gravity = -GRAVITY_M_S2 * UP_IN_SITE
        log = ImuLog(at_s, turns(at_s, 1), turns(at_s).inv().apply(places(at_s, 2) - gravity))
        prior = SensorPrior(log.step_s / np.sqrt(12), GIVEN_TURN_STDDEV_RAD, ARM_STDDEV_M)
        problem = InertialProblem(log, mounting, prior, bending)
        state = replace(InertialState.at_rest(gravity, mounting, len(path)), velocities_m_s=places(times_s, 1))
        return InertialScale(problem, state, self.sizes, problem.summed_up(state, self.sizes))

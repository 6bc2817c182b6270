"""The entry of an inertial sensor in ``result.json``."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import ClassVar

import numpy as np

from rangesfm.arrays import Array
from rangesfm.measurements.kind_entry import KindEntry
from rangesfm.util.files.records import Count, Number, NumberOrNull, Record, Vector
from rangesfm.util.geometry.numerics import NORMAL_95


class ImuTimeOffsetEntry(Record):
    """The time offset of an inertial sensor: image time = time of its log + ``value_s``."""

    value_s: Number
    stddev_s: Number


class ImuEntry(KindEntry):
    """The inertial sensor, as far as the final map shows it.

    Attributes:
        num: samples in the log. num_used: between the photos.
        rotation_imu_to_cam_xyzw: takes the sensor's axes to the camera's.
        gravity_in_world: m/s^2, in the world of the metric models. up_stddev_deg: standard deviation of its direction.
        accel_scale_factors: by how much the axes of the accelerometer read too much, 1: not at all.
        accel_bias_m_s2, gyro_bias_rad_s: mean biases.
        accel_noise, gyro_noise: densities of the white noise, m/s^2 and rad/s per root of Hz.
    """

    num: Count
    num_used: Count
    time_offset: ImuTimeOffsetEntry
    rotation_imu_to_cam_xyzw: tuple[Number, Number, Number, Number]
    gravity_in_world: Vector
    up_stddev_deg: NumberOrNull
    accel_scale_factors: Vector
    accel_bias_m_s2: Vector
    gyro_bias_rad_s: Vector
    accel_noise: NumberOrNull
    gyro_noise: NumberOrNull

    caption: ClassVar[str] = "Inertial sensor"
    meanings: ClassVar[Mapping[str, str]] = {
        "num": "samples in the log",
        "num_used": "between the photos",
        "time_offset": "time offset, and its standard deviation, s",
        "rotation_imu_to_cam_xyzw": "rotation from the sensor's axes to the camera's, as a quaternion x, y, z, w",
        "gravity_in_world": "gravity in the map, m/s²",
        "up_stddev_deg": "standard deviation of its direction, degrees",
        "accel_scale_factors": "scale factors of the accelerometer's axes, 1: right",
        "accel_bias_m_s2": "zero of the accelerometer, m/s²",
        "gyro_bias_rad_s": "zero of the gyroscope, rad/s",
        "accel_noise": "noise of the accelerometer, m/s² per √Hz",
        "gyro_noise": "noise of the gyroscope, rad/s per √Hz",
    }

    def lines(self) -> Iterator[str]:
        """Yield how many samples are used, and how well they tell what is up."""
        tilt = "" if self.up_stddev_deg is None else f", level within {NORMAL_95 * self.up_stddev_deg:.2f} deg"
        yield f"inertial sensor: {self.num_used} of {self.num} samples used{tilt} (95 %)"

    @property
    def fact(self) -> str:
        """That the samples give metres and the vertical."""
        num = f"{self.num_used:,}".replace(",", "\u202f")
        return f"{num} samples of an inertial sensor give it metres, and say what is up."

    @property
    def up(self) -> tuple[Array, float] | None:
        """Against gravity."""
        if self.up_stddev_deg is None:
            return None
        down = np.array(self.gravity_in_world)
        return -down / np.linalg.norm(down), float(np.deg2rad(self.up_stddev_deg))

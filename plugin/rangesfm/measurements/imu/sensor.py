"""An inertial sensor on the camera: its log, what is known of how it sits, and its alignment with the photos."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from rangesfm.arrays import Array
from rangesfm.measurements.imu.alignment import ImuAlignment, align_imu
from rangesfm.measurements.imu.calibration import read_imu_noise
from rangesfm.measurements.imu.formats import read_imu
from rangesfm.measurements.imu.log import ImuLog
from rangesfm.options import ImuOptions
from rangesfm.util.geometry.trajectory import Trajectory


@dataclass(frozen=True)
class InertialSensor:
    """A sensor that is fixed to the camera.

    Attributes:
        log: as read.
        imu_in_cam_m: (3,) lever arm; None if it is not given.
        time_offset_s: image time minus time of the log, as given; None to search for it.
        cam_from_imu: (3, 3) rotation, as given; None to find it.
        alignment: with the photos of a map; None before there is one.
    """

    log: ImuLog
    imu_in_cam_m: Array | None = None
    time_offset_s: float | None = None
    cam_from_imu: Array | None = None
    alignment: ImuAlignment | None = None

    def aligned_with(self, path: Trajectory) -> InertialSensor:
        """Return the sensor with its alignment; errors are those of ``align_imu``."""
        found = align_imu(self.log, path, time_offset_s=self.time_offset_s, cam_from_imu=self.cam_from_imu)
        return replace(self, alignment=found)


def read_sensor(options: ImuOptions) -> InertialSensor | None:
    """Read what a survey says of an inertial sensor; None if it has none.

    Raises:
        InputError: a file cannot be read.
    """
    if options.path is None:
        return None
    log, xyzw = read_imu(options.path), options.rotation_imu_to_cam_xyzw
    return InertialSensor(
        log if options.noise is None else replace(log, noise=read_imu_noise(options.noise)),
        None if options.imu_in_cam_m is None else np.array(options.imu_in_cam_m),
        options.time_offset_s,
        None if xyzw is None else Rotation.from_quat(xyzw).as_matrix(),
    )

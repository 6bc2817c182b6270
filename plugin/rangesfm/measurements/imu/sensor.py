"""An inertial sensor on the camera: its log, what is known of how it sits, and its alignment with the photos."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from rangesfm.arrays import Array
from rangesfm.measurements.imu.alignment import ImuAlignment, align_imu
from rangesfm.measurements.imu.calibration import read_imu_noise
from rangesfm.measurements.imu.formats import read_imu
from rangesfm.measurements.imu.log import ImuLog
from rangesfm.measurements.kind_as_read import KindAsRead, TimedLog
from rangesfm.options import ImuOptions
from rangesfm.util.files.clock_times import span_text
from rangesfm.util.geometry.numerics import NORMAL_95
from rangesfm.util.geometry.trajectory import Trajectory


@dataclass(frozen=True)
class InertialSensor(KindAsRead):
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

    def facts(self) -> Iterator[str]:
        """Yield how much the log has, and when it begins and ends."""
        first_s, last_s = self.log.timestamp_s[[0, -1]]
        rate_hz, span = 1 / self.log.step_s, span_text(first_s, last_s)
        yield f"inertial sensor: {len(self.log)} samples at {rate_hz:.0f} Hz in {self.log.name}, from {span}"

    @property
    def notes(self) -> tuple[str, ...]:
        return self.log.notes

    @property
    def warnings(self) -> tuple[str, ...]:
        return self.log.doubts

    @property
    def timed(self) -> TimedLog:
        log = self.log
        return TimedLog("samples of the inertial sensor", log.path or None, log.timestamp_s, self.time_offset_s)

    @property
    def notes_on_path(self) -> tuple[str, ...]:
        """How far the clocks of photos and sensor are apart."""
        if self.alignment is None:
            return ()
        half_s, num = NORMAL_95 * self.alignment.time_offset_stddev_s, len(self.alignment.turns)
        offset = f"{self.alignment.time_offset_s:+.4f} +- {half_s:.4f} s (95 %)"
        return (f"time offset of the inertial sensor: {offset}, by {num} turns of the photos",)

    @property
    def warnings_on_path(self) -> tuple[str, ...]:
        """What is wrong with the log or with what was given with it."""
        return () if self.alignment is None else self.alignment.mistakes

    def on_path(self, path: Trajectory) -> InertialSensor:
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

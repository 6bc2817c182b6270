"""Words for an inertial sensor and for the components of its errors."""

from __future__ import annotations

from rangesfm.measurements.kind_words import KindWords

IMU = "imu"
IMU_WORDS = KindWords(
    IMU,
    "inertial sensor",
    {
        "gyro_noise": "noise of the gyroscope",
        "gyro_bias_walk": "wandering of the gyroscope's zero",
        "gyro_bias": "zero of the gyroscope",
        "gyro_scale": "scale factors of the gyroscope",
        "accel_noise": "noise of the accelerometer",
        "accel_bias_walk": "wandering of the accelerometer's zero",
        "accel_bias": "zero of the accelerometer",
        "accel_scale": "scale factors of the accelerometer",
        "accel_cross": "angles between the axes of the accelerometer",
        "photo_times": "times of the photos against the inertial sensor",
        "pose_turns": "noise of the photos' turns",
        "pose_places": "noise of the photos' places",
        "log_gaps": "gaps in the log of the inertial sensor",
        "imu_clock": "time offset of the inertial sensor",
        "imu_turn": "rotation between camera and inertial sensor",
        "imu_place": "place of the inertial sensor on the camera",
        "gravity": "length of gravity",
    },
    verb="is",
)

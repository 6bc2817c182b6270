"""What a survey says of an inertial sensor is read with its log: rotation, lever arm, time offset and noise."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from tests.measurements.imu.test_formats import canonical

from rangesfm.errors import InputError
from rangesfm.measurements.imu.calibration import read_imu_noise
from rangesfm.measurements.imu.log import ImuNoise
from rangesfm.measurements.imu.sensor import read_sensor
from rangesfm.options import ImuOptions
from rangesfm.survey.survey_reader import read_survey

KALIBR = """\
#Accelerometers
accelerometer_noise_density: 1.86e-03   #Noise density (continuous-time)
accelerometer_random_walk:   4.33e-04   #Bias random walk
gyroscope_noise_density:     1.87e-04
gyroscope_random_walk:       2.66e-05
rostopic:                    /imu0
update_rate:                 200.0
"""


def test_a_survey_file_has_the_sensor_beside_it(tmp_path: Path) -> None:
    canonical(tmp_path)
    (tmp_path / "imu.yaml").write_text(KALIBR)
    (tmp_path / "survey.toml").write_text(
        '[imu]\npath = "imu.csv"\nnoise = "imu.yaml"\nrotation_imu_to_cam_xyzw = [0, 0, 0.7071, 0.7071]\n'
        "imu_in_cam_m = [0.01, 0, -0.02]\ntime_offset = -0.5\n"
    )
    sensor = read_sensor(read_survey(tmp_path / "survey.toml").imu)
    assert sensor is not None
    assert (sensor.time_offset_s, sensor.log.noise) == (-0.5, ImuNoise(1.87e-4, 1.86e-3, 2.66e-5, 4.33e-4))
    assert sensor.cam_from_imu is not None
    np.testing.assert_allclose(sensor.cam_from_imu @ [1, 0, 0], [0, 1, 0], atol=1e-3)
    np.testing.assert_array_equal(sensor.imu_in_cam_m, [0.01, 0, -0.02])
    assert read_sensor(ImuOptions()) is None


def test_a_quaternion_has_unit_length(tmp_path: Path) -> None:
    canonical(tmp_path)
    (tmp_path / "survey.toml").write_text('[imu]\npath = "imu.csv"\nrotation_imu_to_cam_xyzw = [1, 0, 0, 1]\n')
    with pytest.raises(InputError, match=r"survey\.toml:3: .*expected a list of 4 numbers: a quaternion x, y, z, w"):
        read_survey(tmp_path / "survey.toml")


def test_a_missing_log_is_named_with_its_key(tmp_path: Path) -> None:
    (tmp_path / "survey.toml").write_text('[imu]\npath = "imu*.csv"\n')
    with pytest.raises(InputError, match=r"survey\.toml:2: \[imu\] path: .*no file there"):
        read_survey(tmp_path / "survey.toml")


def test_noise_may_be_in_the_table_of_a_sensor(tmp_path: Path) -> None:
    path = tmp_path / "imu.yaml"
    path.write_text("imu0:\n" + "".join(f"  {line}\n" for line in KALIBR.splitlines()))
    assert read_imu_noise(path).gyro_bias_walk == 2.66e-5


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[", "cannot be read as YAML"),
        ("a: 1", "has no noise of an inertial sensor"),
        (KALIBR.replace("4.33e-04", "much"), "accelerometer_random_walk is 'much', expected a number"),
        (KALIBR.replace("gyroscope_random_walk", "x"), "gyroscope_random_walk is None"),
    ],
)
def test_noise_that_cannot_be_read_is_refused(text: str, said: str, tmp_path: Path) -> None:
    (tmp_path / "imu.yaml").write_text(text)
    with pytest.raises(InputError, match=rf"imu\.yaml: {said}"):
        read_imu_noise(tmp_path / "imu.yaml")

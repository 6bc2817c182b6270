"""The demo with an inertial sensor: its log is that of the path on which the photos were taken."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.simulated.small_demo import make_small_demo

from rangesfm.demo.simulated_imu import PHONE
from rangesfm.demo.survey import CAM_FROM_IMU, IMU_TIME_OFFSET_S

if TYPE_CHECKING:
    from pathlib import Path

    from tests.conftest import Command


def test_the_demo_uses_a_phones_sensor_beside_its_ranges(
    rangesfm_command: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rangesfm.demo.survey.make_demo_survey", make_small_demo)
    printed = rangesfm_command("demo", "yard", "--imu", "--num_photos", "28", cwd=tmp_path).stdout
    assert "samples used, level within" in printed
    result = json.loads((tmp_path / "yard" / "out" / "result.json").read_text(encoding="utf-8"))
    assert {*result["scale"]["by_kind"]} == {"ranges", "imu"}
    [against] = [test for test in result["tests"] if test["name"] == "imu against ranges"]
    assert not against["rejected"]
    imu = result["imu"]
    offset = imu["time_offset"]
    assert offset["value_s"] == pytest.approx(IMU_TIME_OFFSET_S, abs=3 * offset["stddev_s"])
    off = Rotation.from_quat(imu["rotation_imu_to_cam_xyzw"]).inv() * Rotation.from_matrix(CAM_FROM_IMU)
    assert np.degrees(off.magnitude()) < 1.0
    down = np.array(imu["gravity_in_world"]) / np.linalg.norm(imu["gravity_in_world"])
    assert np.degrees(np.arccos(-down[2])) < 0.5
    # What the path does not explain counts as noise.
    assert imu["accel_noise"] < 4 * PHONE.accel_noise

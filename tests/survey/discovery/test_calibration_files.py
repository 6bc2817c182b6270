"""Calibrations of other programs become COLMAP's cameras, with its pixel convention."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from rangesfm.errors import InputError
from rangesfm.options import CameraOptions
from rangesfm.sfm.camera import check_camera
from rangesfm.survey.discovery.calibration_files import CameraCalibration, read_calibrations

KALIBR = """\
cam0:
  camera_model: pinhole
  distortion_coeffs: [-0.28, 0.07, 0.0002, 0.00002]
  distortion_model: radtan
  intrinsics: [458.6, 457.3, 366.7, 248.4]
  resolution: [752, 480]
  rostopic: /cam0/image_raw
cam1:
  camera_model: pinhole
  distortion_coeffs: [-0.01, 0.02, 0.003, 0.004]
  distortion_model: equidistant
  intrinsics: [457.6, 456.1, 379.5, 255.2]
  resolution: [640, 480]
"""
ROS = """\
image_width: 640
image_height: 480
camera_name: narrow
camera_matrix:
  rows: 3
  cols: 3
  data: [430.2, 0, 306.7, 0, 430.5, 227.2, 0, 0, 1]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.34, 0.11, 0.0003, -0.0001, {third}]
"""


def calibrated(model: str, params: tuple[float, ...], *more: Any) -> CameraCalibration:
    return CameraCalibration(CameraOptions(model=model, params=params), *more)


def read(path: Path, text: str) -> tuple[CameraCalibration, ...]:
    path.write_text(text)
    cameras = read_calibrations(path)
    for camera in cameras:
        check_camera(camera.camera)
    return cameras


def test_kalibrs_cameras_are_moved_by_half_a_pixel(tmp_path: Path) -> None:
    assert read(tmp_path / "camchain.yaml", KALIBR) == (
        CameraCalibration(
            CameraOptions(model="OPENCV", params=(458.6, 457.3, 367.2, 248.9, -0.28, 0.07, 0.0002, 0.00002)), (752, 480)
        ),
        CameraCalibration(
            CameraOptions(model="OPENCV_FISHEYE", params=(457.6, 456.1, 380.0, 255.7, -0.01, 0.02, 0.003, 0.004)),
            (640, 480),
        ),
    )


def test_a_ros_camera_with_a_third_coefficient_is_full_opencv(tmp_path: Path) -> None:
    pinhole, four = (430.2, 430.5, 307.2, 227.7), (-0.34, 0.11, 0.0003, -0.0001)
    (plain,) = read(tmp_path / "plain.yaml", ROS.format(third=0.0))
    assert plain == calibrated("OPENCV", (*pinhole, *four), (640, 480))
    (full,) = read(tmp_path / "full.yml", ROS.format(third=0.05))
    assert full == CameraCalibration(
        CameraOptions(model="FULL_OPENCV", params=(*pinhole, *four, 0.05, 0.0, 0.0, 0.0)), (640, 480)
    )


def test_colmaps_cameras_are_taken_as_they_are(tmp_path: Path) -> None:
    text = "# Camera list\n1 PINHOLE 640 480 500 501 320 240\n2 SIMPLE_RADIAL 480 640 500 240 320 0.01\n"
    assert read(tmp_path / "cameras.txt", text) == (
        calibrated("PINHOLE", (500, 501, 320, 240), (640, 480)),
        calibrated("SIMPLE_RADIAL", (500, 240, 320, 0.01), (480, 640)),
    )


def test_a_camera_as_json_may_have_the_lever_arm(tmp_path: Path) -> None:
    camera = {
        "camera_model": "PINHOLE",
        "width": 64,
        "height": 48,
        "params": [50, 50, 32, 24],
        "tag_in_cam_m": [0, 1, 2],
    }
    assert read(tmp_path / "any.json", json.dumps(camera)) == (
        calibrated("PINHOLE", (50, 50, 32, 24), (64, 48), (0, 1, 2)),
    )


@pytest.mark.parametrize(
    ("name", "text"),
    [("a.txt", "t x y\n1 2 3\n"), ("a.json", "[1]"), ("a.json", "{"), ("a.yaml", "a: [b"), ("a.md", "#")],
)
def test_other_files_are_no_calibrations(name: str, text: str, tmp_path: Path) -> None:
    assert read(tmp_path / name, text) == ()


@pytest.mark.parametrize(
    ("text", "found"),
    [
        (KALIBR.replace("pinhole", "omni"), "camera_model is 'omni', expected pinhole"),
        (KALIBR.replace("radtan", "fov"), "distortion_model is 'fov', expected one of none, radtan"),
        (KALIBR.replace("intrinsics", "intrinsic"), "no 'intrinsics'"),
        (KALIBR.replace("458.6", "many"), "many"),
        ("camera_matrix: 5\n", "not complete"),
    ],
)
def test_a_calibration_that_cannot_be_taken_names_its_file(text: str, found: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=found) as caught:
        read(tmp_path / "camera.yaml", text)
    assert caught.value.path == tmp_path / "camera.yaml"

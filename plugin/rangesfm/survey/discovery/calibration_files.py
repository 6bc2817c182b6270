"""Reading of camera calibrations: files of COLMAP, Kalibr and ROS, and JSON."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from rangesfm.colmap.calibrated_cameras import colmap_camera
from rangesfm.errors import InputError, OptionError
from rangesfm.options import CameraOptions
from rangesfm.util.files.text_tables import read_head

_COLMAP_LINE = re.compile(r"\d+ ([A-Z][A-Z0-9_]+) (\d+) (\d+)((?: [-+.\deE]+)+)", re.ASCII)


@dataclass(frozen=True)
class CameraCalibration:
    """One calibrated camera in COLMAP's conventions.

    Attributes:
        camera: with its parameters, in COLMAP's order and pixel convention.
        size_px: width and height of its photos; None if the file does not say.
        tag_in_cam_m: lever arm of the radio's tag; None if the file does not say.
        cam_from_imu: (4, 4) rows of kalibr's T_cam_imu; None if the file does not say.
    """

    camera: CameraOptions
    size_px: tuple[int, int] | None = None
    tag_in_cam_m: tuple[float, float, float] | None = None
    cam_from_imu: tuple[tuple[float, ...], ...] | None = None


def read_calibrations(path: Path) -> tuple[CameraCalibration, ...]:
    """Read the cameras of a file; none if the file is not a calibration.

    Raises:
        InputError: the calibration is not complete, or COLMAP has no such camera model.
    """
    try:
        return tuple(_READERS[path.suffix.lower()](path)) if path.suffix.lower() in _READERS else ()
    except (OptionError, LookupError, TypeError, ValueError, AttributeError, ArithmeticError) as error:
        what = f"no {error}" if isinstance(error, KeyError) else str(error)
        raise InputError(f"the calibration of a camera is not complete ({what})", path) from None


def _read_colmap(path: Path) -> Iterator[CameraCalibration]:
    lines = [" ".join(line.split()) for line in read_head(path).split("\n")]
    found = [_COLMAP_LINE.fullmatch(line) for line in lines if line and not line.startswith("#")]
    for match in found if all(found) else ():
        assert match is not None
        camera = CameraOptions(model=match[1], params=tuple(map(float, match[4].split())))
        yield CameraCalibration(camera, (int(match[2]), int(match[3])))


def _read_json(path: Path) -> Iterator[CameraCalibration]:
    try:
        camera = json.loads(read_head(path))
    except (ValueError, RecursionError):
        return
    if isinstance(camera, dict) and {"camera_model", "params"} <= camera.keys():
        size_px = (int(camera["width"]), int(camera["height"])) if "width" in camera else None
        arm = camera.get("tag_in_cam_m")
        tag_in_cam_m = None if arm is None else (float(arm[0]), float(arm[1]), float(arm[2]))
        given = CameraOptions(model=camera["camera_model"], params=tuple(map(float, camera["params"])))
        yield CameraCalibration(given, size_px, tag_in_cam_m)


def _read_yaml(path: Path) -> Iterator[CameraCalibration]:
    try:
        content = YAML(typ="safe", pure=True).load(read_head(path))
    except (YAMLError, ValueError, RecursionError):
        return
    if not isinstance(content, dict):
        return
    if "camera_matrix" in content:
        fx, _, cx, _, fy, cy = content["camera_matrix"]["data"][:6]
        coefficients = content["distortion_coefficients"]["data"]
        size = (content["image_width"], content["image_height"])
        yield _of_opencv(path, content["distortion_model"], (fx, fy, cx, cy), coefficients, size)
    for name, camera in content.items():  # Kalibr's
        if re.fullmatch(r"cam\d+", str(name)) and isinstance(camera, dict) and "camera_model" in camera:
            kind, coefficients = camera["camera_model"], camera.get("distortion_coeffs", ())
            if kind != "pinhole":
                raise InputError(f"camera_model is '{kind}', expected pinhole: COLMAP has no other", path)
            distortion = camera.get("distortion_model", "none")
            found = _of_opencv(path, distortion, camera["intrinsics"], coefficients, camera["resolution"])
            yield replace(found, cam_from_imu=_rigid(camera["T_cam_imu"])) if "T_cam_imu" in camera else found


def _rigid(rows: Any) -> tuple[tuple[float, ...], ...]:
    """Return the rows of a matrix (4, 4) of a rotation and a shift.

    Raises:
        ValueError: it is none.
    """
    matrix = np.array(rows, np.float64)
    turned = matrix[:3, :3] @ matrix[:3, :3].T if matrix.shape == (4, 4) else np.zeros((3, 3))
    if not np.allclose(turned, np.eye(3), atol=1e-3) or np.linalg.det(matrix) < 0:
        raise ValueError("T_cam_imu is no rotation and shift of 4 x 4 numbers")
    return tuple(map(tuple, matrix.tolist()))


def _of_opencv(path: Path, distortion: str, pinhole: Any, coefficients: Any, size: Any) -> CameraCalibration:
    return CameraCalibration(colmap_camera(distortion, pinhole, coefficients, path), (int(size[0]), int(size[1])))


_READERS = {".txt": _read_colmap, ".json": _read_json, ".yaml": _read_yaml, ".yml": _read_yaml}

"""A survey with the log of an inertial sensor: it is read, aligned with the photos of the map, and told."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pycolmap
from scipy.spatial.transform import Rotation, RotationSpline
from tests.conftest import Command
from tests.simulated.files import write_rows
from tests.simulated.inertial import CAM_FROM_IMU
from tests.simulated.poses_alone import RANGES, write_poses_alone

from rangesfm.geometry.trajectory import trajectory_from_reconstruction
from rangesfm.measurements.imu.formats import CANONICAL_COLUMNS

OFFSET_S = 3.25


def write_imu(folder: Path, *, gyro_factor: float = 1.0) -> None:
    """Write the log of a sensor that turns as the photos do, and measures nothing but gravity beside."""
    model = pycolmap.Reconstruction(folder / "sparse" / "0")
    times = {image.name: float(k) for k, image in enumerate(sorted(model.images.values(), key=lambda one: one.name))}
    path = trajectory_from_reconstruction(model, times)
    assert path.timestamps_s is not None
    turns = RotationSpline(path.timestamps_s, Rotation.from_matrix(path.world_from_cam @ CAM_FROM_IMU))
    at_s = np.arange(0.0, len(path) - 1, 0.01)
    forces = turns(at_s).inv().apply([0.0, 0.0, 9.81])
    rows = np.column_stack([at_s - OFFSET_S, gyro_factor * turns(at_s, 1), forces]).tolist()
    write_rows(folder / "imu.csv", ",".join(CANONICAL_COLUMNS), rows)


def test_a_run_aligns_the_sensor_with_the_map(tmp_path: Path, rangesfm_command: Command) -> None:
    survey = write_poses_alone(tmp_path)
    write_imu(tmp_path)
    rangesfm_command("scale", *survey.flags, *RANGES, "--imu", "imu.csv", "--output_path", "out", cwd=tmp_path)
    result = json.loads((tmp_path / "out" / "result.json").read_text())
    (told,) = [line for line in result["notes"] if "inertial sensor" in line]
    assert told.startswith("time offset of the inertial sensor: +3.25")
    assert not [line for line in result["warnings"] if "imu.csv" in line]


def test_a_mistake_in_the_log_is_a_warning(tmp_path: Path, rangesfm_command: Command) -> None:
    survey = write_poses_alone(tmp_path)
    write_imu(tmp_path, gyro_factor=float(np.degrees(1)))
    rangesfm_command("scale", *survey.flags, *RANGES, "--imu", "imu.csv", "--output_path", "out", cwd=tmp_path)
    result = json.loads((tmp_path / "out" / "result.json").read_text())
    assert any("taken as degrees a second" in line for line in result["warnings"])

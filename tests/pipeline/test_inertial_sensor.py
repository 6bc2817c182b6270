"""A survey with the log of an inertial sensor, alone and beside ranges: what a user gets who has a phone."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.conftest import Command
from tests.simulated.files import write_anchors, write_model, write_rows
from tests.simulated.inertial import Motion, by_hand, imu_log, photos
from tests.simulated.surveys import Place, model_of_poses

from rangesfm.measurements.imu.formats import CANONICAL_COLUMNS
from rangesfm.pipeline.plan_again import plan_of_result
from rangesfm.planning.expected import expect

OFFSET_S = 3.25
METRES_PER_UNIT = 1 / 0.37
ANCHORS_M = {"N": (2.6, 1.7, 0.4), "E": (-1.9, 2.1, 1.5), "S": (-2.4, -1.8, 0.5), "W": (2.1, -2.2, 1.3)}
SENSOR = ("--imu", "imu.csv")
RANGES = ("--ranges", "uwb.csv", "--ranges_time_offset", "0", "--tag_in_cam", "0,0,0")


def write_survey(
    folder: Path, motion: Motion, *, gyro_factor: float = 1.0, anchors_m: dict[str, Place] = ANCHORS_M
) -> None:
    """Write the path of the photos as a model, the sensor's log, and ranges of a radio at the camera."""
    path = photos(motion, noise_rad=3e-4)
    times = dict(zip(path.image_names, path.times_s.tolist(), strict=True))
    write_model(model_of_poses(path), folder / "sparse", times, folder / "images.csv")
    log = imu_log(motion, offset_s=OFFSET_S)
    rows = np.column_stack([log.timestamp_s, gyro_factor * log.gyro_rad_s, log.accel_m_s2]).tolist()
    write_rows(folder / "imu.csv", ",".join(CANONICAL_COLUMNS), rows)
    rng, at_s = np.random.default_rng(2), np.arange(2.0, 59.0, 0.1)
    names = np.resize(list(anchors_m), len(at_s))
    away = motion.places_m(at_s) - [anchors_m[name] for name in names]
    write_anchors(folder / "anchors.csv", anchors_m)
    range_m = np.linalg.norm(away, axis=1) + rng.normal(0.0, 0.05, len(at_s))
    measured = zip(at_s.tolist(), names.tolist(), range_m.tolist(), strict=True)
    write_rows(folder / "uwb.csv", "timestamp_s,anchor_id,range_m", measured)


@pytest.fixture(scope="module")
def survey(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("with_sensor")
    write_survey(folder, by_hand(2, axes=(3.0, 3.0, 3.0)))
    return folder


def scaled(folder: Path, out: Path, command: Command, *flags: str) -> dict[str, Any]:
    read = ("--input_path", "sparse", "--images", "images.csv")
    command("scale", *read, *flags, "--output_path", str(out), cwd=folder)
    found: dict[str, Any] = json.loads((out / "result.json").read_text())
    return found


def half_width(result: dict[str, Any]) -> float:
    low, high = result["scale"]["interval_95"]
    return float(np.log(high / low) / 2)


@pytest.fixture(scope="module")
def alone(survey: Path, tmp_path_factory: pytest.TempPathFactory, rangesfm_command: Command) -> Path:
    """The output folder of the survey with its sensor alone."""
    out = tmp_path_factory.mktemp("alone") / "out"
    scaled(survey, out, rangesfm_command, *SENSOR)
    return out


def test_photos_and_a_sensor_make_a_metric_and_level_map(alone: Path) -> None:
    result = json.loads((alone / "result.json").read_text())
    assert (result["scale"]["verdict"], result["scale"]["method"]) == ("good", "imu")
    low, high = result["scale"]["interval_95"]
    assert low < METRES_PER_UNIT < high
    assert half_width(result) < 0.03
    imu = result["imu"]
    assert imu["time_offset"]["value_s"] == pytest.approx(OFFSET_S, abs=0.005)
    from_sfm = Rotation.from_quat(result["metric_from_sfm"]["rotation_xyzw"])
    up = (from_sfm * Rotation.from_rotvec([0.3, -1.0, 2.0])).apply([0.0, 0.0, 1.0])  # as ``photos`` turned the world
    down = np.array(imu["gravity_in_world"]) / np.linalg.norm(imu["gravity_in_world"])
    assert np.degrees(np.arccos(-down @ up)) < 0.5
    assert imu["up_stddev_deg"] < 0.5
    again = expect(plan_of_result(alone))  # its map bends as usual, which is more than this one
    assert half_width(result) < again.uncertainty.half_width_95 < 3 * half_width(result)
    report = (alone / "report.html").read_text("utf-8")
    assert "samples of an inertial sensor give it metres" in report
    assert "noise of the accelerometer, m/s² per √Hz" in report


def test_beside_ranges_it_makes_the_interval_narrower(
    survey: Path, alone: Path, tmp_path: Path, rangesfm_command: Command
) -> None:
    by_ranges, both = (
        scaled(survey, tmp_path / str(k), rangesfm_command, *flags)
        for k, flags in enumerate([RANGES, (*SENSOR, *RANGES)])
    )
    by_sensor = json.loads((alone / "result.json").read_text())
    assert half_width(both) < min(half_width(by_ranges), half_width(by_sensor))
    low, high = both["scale"]["interval_95"]
    assert low < METRES_PER_UNIT < high
    assert {*both["scale"]["by_kind"]} == {"ranges", "imu"}
    # The bending of the map is that in the ranges, and not in what the sensor measures in other units.
    assert both["scale"]["error_stddevs"]["bending"] == pytest.approx(
        by_ranges["scale"]["error_stddevs"]["bending"], 0.5
    )
    [against] = [test for test in both["tests"] if test["name"] == "imu against ranges"]
    assert not against["rejected"]


def test_a_motion_that_does_not_show_the_scale_is_named(tmp_path: Path, rangesfm_command: Command) -> None:
    hand = by_hand(2, axes=(3.0, 3.0, 3.0))
    write_survey(tmp_path, replace(hand, amplitudes_m=hand.amplitudes_m / 30))
    scale = scaled(tmp_path, tmp_path / "out", rangesfm_command, *SENSOR)["scale"]
    assert scale["verdict"] == "doubtful"
    assert "the camera moved too evenly for the inertial sensor to show the scale" in scale["reasons"]


def test_gravity_says_on_which_side_of_a_wall_with_anchors_a_path_in_a_plane_is(
    tmp_path: Path, rangesfm_command: Command
) -> None:
    hand = by_hand(2, axes=(3.0, 3.0, 3.0))
    on_wall = {"A": (-2.0, -2.0, -1.2), "B": (-2.0, 2.0, 0.5), "C": (-2.0, -1.5, 1.6), "D": (-2.0, 1.0, -0.9)}
    flat = replace(hand, amplitudes_m=hand.amplitudes_m * [[1], [1], [0]])
    write_survey(tmp_path, flat, anchors_m=on_wall)
    sited = (*RANGES, "--anchors", "anchors.csv", "--anchor_frame", "site")
    without = scaled(tmp_path, tmp_path / "without", rangesfm_command, *sited)
    result = scaled(tmp_path, tmp_path / "out", rangesfm_command, *sited, *SENSOR)
    assert (without["frame"], result["frame"]) == ("first_camera", "site")
    up = -np.array(result["imu"]["gravity_in_world"]) / np.linalg.norm(result["imu"]["gravity_in_world"])
    assert np.degrees(np.arccos(up[2])) < 1.0


def test_positions_in_axes_that_are_not_upright_are_named(
    survey: Path, tmp_path: Path, rangesfm_command: Command
) -> None:
    motion, at_s = by_hand(2, axes=(3.0, 3.0, 3.0)), np.arange(2.0, 59.0, 0.5)
    x, y, z = (motion.places_m(at_s) + np.random.default_rng(4).normal(0.0, 0.02, (len(at_s), 3))).T
    flags = ("--antenna_in_cam", "0,0,0", "--positions_time_offset", "0", *SENSOR)
    said = []
    for name, axes in (("upright", (x, y, z)), ("y up", (x, z, -y))):
        write_rows(tmp_path / f"{name}.csv", "timestamp_s,x_m,y_m,z_m", np.column_stack([at_s, *axes]).tolist())
        result = scaled(survey, tmp_path / name, rangesfm_command, "--positions", str(tmp_path / f"{name}.csv"), *flags)
        said.append([reason for reason in result["scale"]["reasons"] if "vertical of the inertial sensor" in reason])
    assert not said[0]
    assert said[1]


def test_a_mistake_in_the_log_is_a_warning(tmp_path: Path, rangesfm_command: Command) -> None:
    write_survey(tmp_path, by_hand(2, axes=(0.5, 0.5, 0.5)), gyro_factor=float(np.degrees(1)))
    result = scaled(tmp_path, tmp_path / "out", rangesfm_command, *SENSOR)
    assert any("taken as degrees a second" in line for line in result["warnings"])
    low, high = result["scale"]["interval_95"]
    assert low < METRES_PER_UNIT < high

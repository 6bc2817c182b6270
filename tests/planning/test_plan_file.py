"""A plan's file is read, or refused in one line that says where it is wrong."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rangesfm.errors import InputError
from rangesfm.planning.paths import path_through
from rangesfm.planning.plan_file import read_plan

ANCHORS = "[anchors.places]\nA = [0, 0, 2]\nB = [6.0, 0, 2.5]\nC = [3, 5, 1]\n"
PATH = "[path]\nwaypoints = [[1, 1, 1.5], [5, 1, 1.5], [3, 3, 1.5]]\nspeed_m_per_s = 0.5\n"


def written(folder: Path, text: str) -> Path:
    path = folder / "plan.toml"
    path.write_text(text)
    return path


def test_waypoints_are_walked_at_their_speed(tmp_path: Path) -> None:
    plan = read_plan(written(tmp_path, ANCHORS + PATH + "[radio]\nrate_hz = 10\n".replace("10", "10.0")))
    assert [anchor.anchor_id for anchor in plan.anchors] == ["A", "B", "C"]
    assert plan.duration_s == pytest.approx((4 + np.hypot(2, 2)) / 0.5, abs=0.5)
    steps = np.linalg.norm(np.diff(plan.trajectory.centers, axis=0), axis=1)
    assert steps.max() == pytest.approx(0.25)  # it is slower in the corner
    # The camera is level and looks along its way, which is x: its z axis is the way, and its y axis points down.
    np.testing.assert_allclose(plan.trajectory.world_from_cam[0] @ [0, 0, 1], [1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(plan.trajectory.world_from_cam[0] @ [0, 1, 0], [0, 0, -1], atol=1e-12)
    assert np.linalg.det(plan.trajectory.world_from_cam) == pytest.approx(1.0)


@pytest.mark.parametrize("corner_deg", [90.0, 180.0])
def test_corners_are_rounded_off_as_fast_as_the_camera_may_turn(corner_deg: float) -> None:
    around = np.deg2rad(corner_deg)
    waypoints = np.array([[0, 0, 1.6], [8, 0, 1.6], [8 + 8 * np.cos(around), 8 * np.sin(around), 1.6]])
    path = path_through(waypoints.tolist(), speed_m_per_s=0.5, photo_rate_hz=2.0, turn_deg_per_s=30.0)
    turns = Rotation.from_matrix(path.world_from_cam)
    turned_deg = np.rad2deg((turns[:-1].inv() * turns[1:]).magnitude())
    assert turned_deg.max() == pytest.approx(15.0, abs=1.0)  # half a second
    assert turned_deg.sum() == pytest.approx(corner_deg)
    assert np.linalg.norm(path.centers - waypoints[1], axis=1).min() < 0.8
    steps = np.linalg.norm(np.diff(path.centers, axis=0), axis=1)
    assert steps.max() < 0.25 + 1e-9
    np.testing.assert_allclose(path.centers[10:20, 1], 0.0, atol=1e-12)  # lines stay lines


def test_a_vertical_line_is_walked_with_the_heading_before_it() -> None:
    path = path_through([(0, 0, 0), (0, 0, 2), (0, 4, 2), (0, 4, 0)], speed_m_per_s=0.5, photo_rate_hz=2.0)
    np.testing.assert_allclose(path.world_from_cam[:, :, 2], np.tile([0.0, 1.0, 0.0], (len(path), 1)), atol=1e-12)


def test_a_trajectory_and_anchors_may_stand_in_files(tmp_path: Path) -> None:
    (tmp_path / "anchors.csv").write_text("anchor_id,x_m,y_m,z_m,position_stddev_m\nA,0,0,2,0.02\nB,6,0,2,0.02\n")
    rows = [f"{0.1 * k:.1f} {0.05 * k:.2f} 0 1.5 0 0 0 1" for k in range(101)]
    (tmp_path / "walk.tum").write_text("\n".join(rows) + "\n")
    text = '[anchors]\npath = "anchors.csv"\nframe = "unknown"\n[path]\nfile = "walk.tum"\nphoto_rate_hz = 2.0\n'
    plan = read_plan(written(tmp_path, text))
    assert [anchor.position_stddev_m for anchor in plan.anchors] == [0.02, 0.02]
    assert len(plan.trajectory) == 21
    assert plan.duration_s == pytest.approx(10.0)


def test_a_loop_stays_within_its_floor_and_its_heights(tmp_path: Path) -> None:
    text = "[path]\nloop_inside_m = [[0, 0], [12, 0], [12, 8], [0, 8]]\nheights_m = [1.0, 1.8]\nnum_rounds = 2\n"
    path = read_plan(written(tmp_path, ANCHORS + text)).trajectory
    low, high = path.centers.min(axis=0), path.centers.max(axis=0)
    np.testing.assert_allclose(low, [2, 4 / 3, 1.0], atol=0.1)
    np.testing.assert_allclose(high, [10, 20 / 3, 1.8], atol=0.1)
    # Two rounds.
    assert np.linalg.norm(np.diff(path.centers, axis=0), axis=1).sum() == pytest.approx(2 * 2 / 3 * 40, rel=0.1)


def test_anchors_may_be_put_on_walls(tmp_path: Path) -> None:
    text = "[anchors]\nnum_to_place = 4\nwalls_m = [[[0, 0], [12, 0]], [[0, 8], [12, 8]]]\nheights_m = [0.5, 3.0]\n"
    plan = read_plan(written(tmp_path, text + PATH))
    assert not plan.is_placed
    assert set(plan.anchors_m[:, 1]) == {0.0, 8.0}


@pytest.mark.parametrize(
    ("text", "found"),
    [
        (ANCHORS + PATH + "[radoi]\n", "nearest known one is 'radio'"),
        (ANCHORS + PATH + "[radio]\nrate = 5\n", r":\d+: unknown key 'rate' in \[radio\]; .* 'rate_hz'"),
        (ANCHORS + PATH + "[radio]\nrate_hz = -1.0\n", "from 0.001 to 10000"),
        (ANCHORS + PATH + "[radio.stddevs]\nantena = 0.1\n", "no component 'antena', expected some of"),
        (ANCHORS, "none of waypoints, loop_inside_m, file and model, expected one"),
        (ANCHORS + PATH + 'file = "walk.tum"\n', "waypoints and file"),
        (ANCHORS + "[path]\nwaypoints = [[1, 1, 1]]\n", "go nowhere"),
        (ANCHORS + "[path]\nwaypoints = [[1, 1], [2, 2]]\n", "expected a list of lists of 3 numbers"),
        (PATH, "none of path, places and num_to_place"),
        ("[anchors]\nnum_to_place = 4\n" + PATH, "num_to_place is 4 and there are 0 places"),
        ("[anchors]\nnum_to_place = 4\nregion_m = [[0, 0, 0], [5, -1, 3]]\n" + PATH, "the second one in no coordinate"),
        ("[anchors]\nwalls_m = [[[0, 0], [5, 0]]]\n" + ANCHORS + PATH, "walls_m goes with heights_m"),
        ("[anchors]\nwalls_m = [[[0, 0], [0, 0]]]\n" + ANCHORS + PATH, "each a list of 2 corners x, y or more"),
        (ANCHORS + "[path]\nloop_inside_m = [[0, 0], [1, 1]]\n", "a list of 3 corners x, y or more"),
        ("[anchors]\nheights_m = [3.0, 1.0]\n" + ANCHORS + PATH, "the larger one last"),
        ("[anchors]\nplaces = {A = [1, 2]}\n" + PATH, "3 numbers"),
        (ANCHORS + '[path]\nfile = "nothing.tum"\n', "nothing.tum"),
        (ANCHORS + '[path]\nmodel = "nothing"\n', "nothing"),
        ("[anchors\n", "not a TOML file"),
        (ANCHORS + PATH + "[tag.lever_arms_m]\n1 = [0, 0, 0]\n", "a plan has one tag"),
    ],
)
def test_what_is_wrong_is_said_in_one_line(text: str, found: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=found) as refused:
        read_plan(written(tmp_path, text))
    assert "\n" not in str(refused.value)
    assert refused.value.exit_status == 2


def test_an_anchor_without_a_place_is_no_plan(tmp_path: Path) -> None:
    (tmp_path / "anchors.csv").write_text("anchor_id,x_m,y_m,z_m\nA,0,0,2\nB,,,\n")
    with pytest.raises(InputError, match="anchor B has no position"):
        read_plan(written(tmp_path, '[anchors]\npath = "anchors.csv"\n' + PATH))


def test_photos_count_only_where_their_table_stands(tmp_path: Path) -> None:
    assert read_plan(written(tmp_path, ANCHORS + PATH)).photos is None
    photos = read_plan(written(tmp_path, ANCHORS + PATH + "[photos]\nseen_m = [1, 30.5]\n")).photos
    assert photos is not None
    assert photos.seen_m == (1.0, 30.5)
    with pytest.raises(InputError, match="larger one last"):
        read_plan(written(tmp_path, ANCHORS + PATH + "[photos]\nseen_m = [8, 2]\n"))

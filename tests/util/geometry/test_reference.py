"""Reference poses: what a file may hold, what is refused, and what is known between samples."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rangesfm.errors import InputError
from rangesfm.util.geometry.moments import ByPhoto, ByTime, Moments
from rangesfm.util.geometry.reference import Reference, read_reference, write_reference
from rangesfm.util.geometry.trajectory import Trajectory


def path_at(times: list[float] | None = None, names: tuple[str, ...] | None = None) -> Trajectory:
    num = len(times or names or ())
    return Trajectory(
        frame_ids=np.arange(num),
        image_names=names or tuple(f"{i}.jpg" for i in range(num)),
        timestamps_s=None if times is None else np.array(times),
        centers=np.zeros((num, 3)),
        world_from_cam=np.tile(np.eye(3), (num, 1, 1)),
    )


def write(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def test_photos_are_found_by_name_and_others_are_unknown(tmp_path: Path) -> None:
    file = write(tmp_path / "reference.csv", "image_name,x_m,y_m,z_m\nb.jpg,1,2,3\na.jpg,4,5,6\n")
    positions, rotations = read_reference(file).positions_at(path_at(names=("a.jpg", "b.jpg", "c.jpg")))
    np.testing.assert_array_equal(positions, [[4, 5, 6], [1, 2, 3], [np.nan] * 3])
    assert rotations is None


def test_orientations_are_world_from_camera_with_the_scalar_last(tmp_path: Path) -> None:
    text = "image_name,x_m,y_m,z_m,qx,qy,qz,qw\na.jpg,0,0,0,0,0,0.70710678,0.70710678\n"
    _, rotations = read_reference(write(tmp_path / "r.csv", text)).positions_at(path_at(names=("a.jpg", "b.jpg")))
    assert rotations is not None
    np.testing.assert_allclose(rotations[0] @ [1, 0, 0], [0, 1, 0], atol=1e-8)
    assert np.isnan(rotations[1]).all()


def test_times_in_any_order_are_sorted(tmp_path: Path) -> None:
    reference = read_reference(write(tmp_path / "r.csv", "timestamp_s,x_m,y_m,z_m\n2,20,0,0\n1,10,0,0\n"))
    np.testing.assert_array_equal(reference.moments.timestamp_s, [1, 2])
    np.testing.assert_array_equal(reference.positions_m[:, 0], [10, 20])


def test_the_first_pose_of_each_time_counts(tmp_path: Path) -> None:
    reference = read_reference(write(tmp_path / "r.csv", "timestamp_s,x_m,y_m,z_m\n2,20,0,0\n1,10,0,0\n2.0,21,0,0\n"))
    np.testing.assert_array_equal(reference.positions_m[:, 0], [10, 20])
    assert reference.notes == ("r.csv: 1 of 3 poses have the time of an earlier one and are left out",)


def test_nanoseconds_in_a_tum_file_are_seconds(tmp_path: Path) -> None:
    reference = read_reference(write(tmp_path / "r.txt", "1403636579763555584.000000 1 2 3 0 0 0 1\n"))
    assert reference.moments.timestamp_s[0] == pytest.approx(1403636579.763555584, abs=1e-6)


@pytest.mark.parametrize("name", ["truth.tum", "truth.txt"])
def test_a_tum_file_is_recognised_with_and_without_its_suffix(tmp_path: Path, name: str) -> None:
    reference = read_reference(write(tmp_path / name, "# timestamp tx ty tz qx qy qz qw\n5.5 1 2 3 0 0 0 1\n"))
    assert reference.world_from_cam is not None
    assert reference.moments.timestamp_s[0] == 5.5
    np.testing.assert_array_equal(reference.positions_m, [[1, 2, 3]])
    np.testing.assert_array_equal(reference.world_from_cam[0], np.eye(3))


def test_poses_between_samples_are_interpolated() -> None:
    quarter_turn = Rotation.from_rotvec([[0, 0, 0], [0, 0, np.pi / 2]]).as_matrix()
    reference = Reference(
        np.array([[0.0, 0, 0], [4, 8, 0]]), ByTime(np.array([10.0, 10.04])), world_from_cam=quarter_turn
    )
    positions, rotations = reference.positions_at(path_at([10.03]))
    np.testing.assert_allclose(positions, [[3, 6, 0]])
    assert rotations is not None
    np.testing.assert_allclose(Rotation.from_matrix(rotations[0]).as_rotvec(), [0, 0, 0.75 * np.pi / 2])


def test_nothing_is_interpolated_across_a_gap() -> None:
    reference = Reference(np.array([[0.0, 0, 0], [1, 0, 0]]), ByTime(np.array([0.0, 0.06])))
    trajectory = path_at([0.004, 0.03, 0.058])
    positions, _ = reference.positions_at(trajectory)
    np.testing.assert_array_equal(positions[:, 0], [0, np.nan, 1])
    np.testing.assert_allclose(reference.positions_at(trajectory, max_gap_s=0.1)[0][1, 0], 0.5)


def test_outside_its_samples_a_reference_knows_nothing() -> None:
    reference = Reference(np.array([[0.0, 0, 0], [1, 0, 0]]), ByTime(np.array([0.0, 0.02])))
    positions, _ = reference.positions_at(path_at([-1.0, -0.005, 0.025, 1.0]))
    np.testing.assert_array_equal(positions[:, 0], [np.nan, 0, 1, np.nan])


def test_a_single_sample_is_enough() -> None:
    positions, _ = Reference(np.array([[7.0, 0, 0]]), ByTime(np.array([3.0]))).positions_at(path_at([3.0, 4.0]))
    np.testing.assert_array_equal(positions[:, 0], [7, np.nan])


def test_a_reference_by_time_needs_photos_with_times() -> None:
    reference = Reference(np.zeros((1, 3)), ByTime(np.array([0.0])))
    with pytest.raises(InputError, match="photos have no times"):
        reference.positions_at(path_at(names=("a.jpg",)))


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("r.csv", "", "empty"),
        ("r.csv", "image_name,x_m,y_m,z_m\n", "only its header row"),
        ("r.csv", "name,x_m,y_m,z_m\na,1,2,3\n", "no column image_name or timestamp_s; found name"),
        ("r.csv", "image_name,x_m,y_m\na,1,2\n", "no column z_m"),
        ("r.csv", "image_name,x_m,y_m,z_m\na,1,2,3\nb,1,nan,3\n", r"r\.csv:3: y_m is nan"),
        ("r.csv", "image_name,x_m,y_m,z_m\na,1,2,3\na,1,2,3\n", r"r\.csv:3: image_name is 'a'"),
        ("r.csv", "image_name,x_m,y_m,z_m,qx,qy,qz\na,1,2,3,0,0,0\n", "no column qw"),
        ("r.csv", "image_name,x_m,y_m,z_m,qx,qy,qz,qw\na,1,2,3,0,0,0,0\n", r"r\.csv:2: the quaternion .* length 0"),
        ("r.tum", "# nothing\n", "holds no row"),
        ("r.tum", "1 2 3 4 0 0 0 1\n\n2 2 3 4\n", r"r\.tum:3: has 4 cells, expected timestamp_s x_m"),
        ("r.tum", "1 2 x 4 0 0 0 1\n", r"r\.tum:1: y_m is 'x'"),
    ],
)
def test_what_is_wrong_is_named_with_its_line(tmp_path: Path, name: str, text: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        read_reference(write(tmp_path / name, text))


def test_a_missing_file_is_an_input_error(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        read_reference(tmp_path / "reference.csv")


@pytest.mark.parametrize(
    "moments",
    [ByPhoto(("a,b.jpg", 'say "c".jpg', "d e.jpg", "f.jpg")), ByTime(np.array([1.0, 2.5, 3.25, 1e9]))],
)
def test_what_is_written_is_read_back(tmp_path: Path, moments: Moments) -> None:
    rng = np.random.default_rng(1)
    written = Reference(
        rng.normal(size=(4, 3)),
        moments,
        Rotation.random(4, random_state=1).as_matrix(),
    )
    read = read_reference(write_reference(written, tmp_path / "reference.csv"))
    assert read.moments.image_name == moments.image_name
    np.testing.assert_array_equal(read.moments.timestamp_s, moments.timestamp_s)
    np.testing.assert_allclose(read.positions_m, written.positions_m, atol=1e-9)
    assert read.world_from_cam is not None
    assert written.world_from_cam is not None
    np.testing.assert_allclose(read.world_from_cam, written.world_from_cam, atol=1e-8)


def test_numbers_too_large_to_be_squared_are_refused_without_a_warning(tmp_path: Path) -> None:
    path = tmp_path / "truth.tum"
    path.write_text("1 0 0 0 0 0 0 1e308\n2 0 0 0 1e308 1e308 0 0\n")
    with pytest.raises(InputError, match=r"truth\.tum:2: qx is 1e308, expected a number, at most 1e\+100"):
        read_reference(path)


def test_a_gap_of_the_limit_is_none_whatever_the_date() -> None:
    """Seconds since 1970 have steps of 2.4e-7 s, so samples every 0.1 s are sometimes slightly further apart."""
    times = 1.7e9 + 0.1 * np.arange(20, dtype=np.float64)
    assert np.ptp(np.diff(times)) > 0
    reference = Reference(np.arange(60.0).reshape(20, 3), ByTime(times))
    positions, _ = reference.poses(ByTime(times[:-1] + 0.05), max_gap_s=0.1)
    np.testing.assert_allclose(positions, np.arange(57.0).reshape(19, 3) + 1.5, atol=1e-4)

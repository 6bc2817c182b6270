"""The example programs run, and the survey files among them are valid."""

from __future__ import annotations

import io
import json
import math
import re
import runpy
import subprocess
import sys
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pycolmap
import pytest
from PIL import Image
from tests.conftest import TAG_IN_CAM_M, TIME_OFFSET_S

from rangesfm.measurements.ranges.anchors.anchor_file import read_anchors
from rangesfm.measurements.ranges.readers import read_ranges
from rangesfm.sfm.image_times import read_image_times_csv
from rangesfm.survey.survey_reader import parse_toml, read_survey
from rangesfm.util.geometry.reference import read_reference

if TYPE_CHECKING:
    from tests.conftest import PhotoRun, WalkedSurvey

EXAMPLES = Path(__file__).parents[1] / "examples"


def run_process(name: str, *arguments: str, cwd: Path) -> str:
    """Run an example that sets its own import order, as a process of its own, and return its output."""
    command = [sys.executable, str(EXAMPLES / name), *arguments]
    done = subprocess.run(command, cwd=cwd, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    return done.stdout


def run_example(name: str, *arguments: str, cwd: Path) -> str:
    """Run an example in this process, which saves the imports, and return its output."""
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(io.StringIO()) as out:
        patch.chdir(cwd)
        patch.setattr(sys, "argv", [name, *arguments])
        with redirect_stderr(io.StringIO()) as err:
            runpy.run_path(str(EXAMPLES / name), run_name="__main__")
    assert err.getvalue() == ""
    return out.getvalue()


def test_every_program_is_tested_here() -> None:
    assert {path.name for path in EXAMPLES.glob("*.py")} == {
        "compare_two_surveys.py",
        "floor_plan.py",
        "gaussian_splatting.py",
        "keys.py",
        "own_problem.py",
        "public_data.py",
        "scale_existing_model.py",
        "split_survey.py",
    }


def test_the_reference_of_keys_is_up_to_date() -> None:
    assert run_example("keys.py", cwd=EXAMPLES) == (EXAMPLES / "keys.md").read_text(encoding="utf-8")


def test_own_problem_converges_on_a_model_that_fits_its_ranges(walked_survey: WalkedSurvey) -> None:
    printed = run_process("own_problem.py", "sparse/0", cwd=walked_survey.folder)
    assert "CONVERGENCE" in printed
    initial, final = (float(re.search(rf"{name} cost: ([\d.e+-]+)", printed)[1]) for name in ("Initial", "Final"))  # type: ignore[index]
    assert 0 < final <= initial


def test_scale_existing_model_takes_it_to_metres(dense_survey: WalkedSurvey, tmp_path: Path) -> None:
    files = ("sparse/0", "images.csv", "uwb.csv", str(tmp_path / "metric" / "0"))
    arm = map(str, TAG_IN_CAM_M)
    printed = run_process("scale_existing_model.py", *files, "--tag_in_cam", *arm, cwd=dense_survey.folder)
    offset, scale, _ = printed.splitlines()
    assert float(offset.split()[2]) == pytest.approx(TIME_OFFSET_S, abs=0.05)
    assert float(scale.split()[0]) == pytest.approx(dense_survey.site_from_sfm.scale, rel=0.02)
    images = sorted(pycolmap.Reconstruction(tmp_path / "metric" / "0").images.values(), key=lambda image: image.name)
    centers = np.array([image.projection_center() for image in images])
    length_m, true_m = (
        np.linalg.norm(np.diff(path, axis=0), axis=1).sum() for path in (centers, dense_survey.centers_m)
    )
    assert length_m == pytest.approx(true_m, rel=0.02)


def test_input_for_gaussian_splatting_is_undistorted_and_metric(photo_run: PhotoRun, tmp_path: Path) -> None:
    printed = run_example("gaussian_splatting.py", str(photo_run.output_path), str(tmp_path), cwd=tmp_path)
    model = pycolmap.Reconstruction(tmp_path / "undistorted" / "sparse" / "0")
    assert printed.startswith(f"{model.num_reg_images()} photos")
    centers = np.array([image.projection_center() for image in model.images.values()])
    refined = pycolmap.Reconstruction(photo_run.output_path / "sparse_metric" / "0")
    expected = np.array([image.projection_center() for image in refined.images.values()])
    assert np.ptp(centers, axis=0).max() == pytest.approx(np.ptp(expected, axis=0).max(), rel=0.2)


def test_floor_plan_is_drawn_with_its_extent(photo_run: PhotoRun, tmp_path: Path) -> None:
    printed = run_example("floor_plan.py", str(photo_run.output_path), "plan.png", cwd=tmp_path)
    width, depth = (float(number) for number in re.findall(r"([\d.]+) m", printed)[:2])
    assert 2 < width < 60
    assert 2 < depth < 60
    with Image.open(tmp_path / "plan.png") as plan:
        assert min(plan.size) > 500


def test_a_survey_compared_with_itself_has_not_changed(photo_run: PhotoRun, tmp_path: Path) -> None:
    folder = str(photo_run.output_path)
    printed = run_example("compare_two_surveys.py", folder, folder, "changes.ply", cwd=tmp_path)
    assert "explain: 0 (0.0 %)" in printed
    assert (tmp_path / "changes.ply").is_file()


def test_the_parts_of_a_split_survey_have_its_photos_in_order_and_its_settings(
    photo_run: PhotoRun, tmp_path: Path
) -> None:
    whole = photo_run.survey.folder / "survey.toml"
    printed = run_example("split_survey.py", str(whole), "2", "parts", cwd=tmp_path)
    assert printed.splitlines() == ["part_1: 7 photos", "part_2: 7 photos"]
    expected = read_survey(whole)
    parts = [read_survey(tmp_path / "parts" / f"part_{k}" / "survey.toml") for k in (1, 2)]
    photos = [path for part in parts for path in sorted(part.photos_path.iterdir())]
    assert [path.resolve() for path in photos] == sorted(expected.photos_path.resolve().iterdir())
    for part in parts:
        assert part.changed({"output.path": expected.output.path}).model_copy(update={"images": expected.images}) == (
            expected
        )
        assert part.images.times is not None
        assert read_image_times_csv(part.images.times, [path.name for path in part.photos_path.iterdir()])


# Raw text in the form of the public repositories, with invented numbers, by the file's path in a clone.
INROL = {
    "config/parameter.yaml": """camera: {fx: 400.0, fy: 401.0, cx: 32.0, cy: 24.0, k1: 0.1, k2: 0.2, p1: 0.3, p2: 0.4}
extrinsics:
  T_mocap_tag: [[1, 0, 0, 0.5], [0, 1, 0, 0], [0, 0, 1, 0.2], [0, 0, 0, 1]]
  T_mocap_cam: [[0, 0, 1, 0.1], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]]
  T_mocap_anchor: [[0, 0, 1, 0], [0, -1, 0, 0], [1, 0, 0, 0.25], [0, 0, 0, 1]]
  T_cam_imu: [[0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0.25], [0, 0, 0, 1]]
""",
    "anchor_self_calibration1/parsed_dataset/uwb.txt": "# index timestamp anchor_id r\n0 0.1 7 2.83\n1 0.2 8 0.0\n",
    "anchor_self_calibration1/parsed_dataset/anchor.txt": "# anchor_id tx ty tz qx qy qz qw\n7 1.25 -2.5 0.5 1 0 0 1\n",
    "anchor_self_calibration1/parsed_dataset/cam_pose.txt": "# timestamp tx ty tz qx qy qz qw\n0.5 1 2 3 0 0 0 1\n",
    "anchor_self_calibration1/parsed_dataset/images.txt": "# index timestamp image_name\n0 0.25 img/a00.png \n",
    "anchor_self_calibration1/parsed_dataset/img/a00.png": "a photo",
    "filtering_state_estimation2/parsed_dataset/uwb.txt": "# index timestamp anchor_id r\n0 0.1 7 2.83\n",
    "filtering_state_estimation2/parsed_dataset/anchor.txt": "# anchor_id tx ty tz qx qy qz qw\n7 1 2 3 0 0 0 1\n",
    "filtering_state_estimation2/parsed_dataset/imu_pose.txt": "# timestamp\n0.5 1 2 3 0 0 0 1\n0.6 1 2 3 0 0 1 0\n",
}


def make_clone(folder: Path, files: dict[str, str]) -> Path:
    for name, text in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text, encoding="utf-8")
    return folder


def rows_of(path: Path) -> list[list[str]]:
    return [line.split(",") for line in path.read_text(encoding="utf-8").splitlines()[1:]]


def test_a_public_room_becomes_what_its_survey_file_names(tmp_path: Path) -> None:
    clone = make_clone(tmp_path / "clone", {f"example/{name}": text for name, text in INROL.items()})
    printed = run_example("public_data.py", "clone", "data", cwd=tmp_path)
    assert printed.split() == [str(Path("data") / name) for name in ("room_env1", "room_filtering2")]
    room = tmp_path / "data" / "room_env1"
    tables, _ = parse_toml(EXAMPLES / "handheld_room.toml")
    assert all((room / tables[table][key]).is_file() for table, keys in FILES_OF.items() for key in keys)
    assert read_ranges(room / "uwb.csv").range_m.tolist() == [2.83]  # the zero is no measurement
    (anchor,) = read_anchors(room / "anchors_antennas.csv")
    assert anchor.anchor_id == "7"
    # The body is turned by a right angle about x: its z, along which the antenna is 0.25 m away, is the site's -y.
    assert anchor.position_m is not None
    np.testing.assert_allclose(anchor.position_m, [1.25, -2.75, 0.5], atol=1e-8)
    assert rows_of(room / "images.csv") == [["a00.png", "0.25"]]
    assert (room / "images" / "a00.png").read_text() == (
        clone / "example" / "anchor_self_calibration1" / "parsed_dataset" / "img" / "a00.png"
    ).read_text()
    camera = json.loads((room / "camera.json").read_text())
    # The camera looks along the body's x, and its y points down: the tag is 0.4 m ahead and 0.2 m above.
    assert camera["tag_in_cam_m"] == [0.0, -0.2, 0.4]
    assert camera["params"] == [400.0, 401.0, 32.0, 24.0, 0.1, 0.2, 0.3, 0.4]


def test_truth_of_an_imu_becomes_that_of_the_camera(tmp_path: Path) -> None:
    make_clone(tmp_path / "clone", {f"example/{name}": text for name, text in INROL.items()})
    run_example("public_data.py", "clone", "data", cwd=tmp_path)
    truth = read_reference(tmp_path / "data" / "room_filtering2" / "groundtruth.csv")
    # The camera is 0.25 m behind the IMU, which at 0.6 s is turned by half a turn about the vertical.
    np.testing.assert_allclose(truth.positions_m, [[0.75, 2, 3], [1.25, 2, 3]], atol=1e-9)
    assert truth.world_from_cam is not None
    np.testing.assert_allclose(truth.world_from_cam[0][:, 2], [1, 0, 0], atol=1e-9)  # it looks along the IMU's x


def test_public_logs_become_ranges_anchors_and_truth(tmp_path: Path) -> None:
    log = "time_s,range,from_id,to_id,x,y,z,w,rot_x,rot_y,rot_z,tag_pos_x,tag_pos_y,tag_pos_z,gt_range\n"
    log += "".join(f"{0.01 * i},3.1,1,4,{i},0,0,1,0,0,0,{i},0,1,{math.hypot(4 - i, 2)!r}\n" for i in range(6))
    make_clone(
        tmp_path / "starloc",
        {
            "dataset_params.json": '[{"name": "eight_s2", "landmarks": "v1"}]',
            "mocap/uwb_markers_v1.csv": ",x,y,z\n4,9,9,9\n12,4,2,1\n",
            "data/eight_s2/uwb.csv": log,
        },
    )
    head = "Time,Position X,Position Y,Position Z,Orientation X,Orientation Y,Orientation Z,Orientation W\n"
    make_clone(
        tmp_path / "rcv",
        {
            "sequence2/anchor.yaml": "anchor1:\n  - position:\n      data: [1.0, 2.0, 0.5]\n",
            "sequence2/anchor_1.csv": "Time,Address,Range\n1970-01-01 00:01:00.5,81,1.5\n1970-01-01 00:00:59,81,0\n",
            "sequence2/gt.csv": head + "1970-01-01 00:01:00,1,2,3,0,0,0,1\n1970-01-01 00:01:00.04,1,2,3,0,0,0,1\n",
        },
    )
    values = ",".join(str(100 + i) for i in range(23))
    make_clone(
        tmp_path / "lias",
        {
            "Dynamic/README.md": "| Anchor 0 | -3.5 | 3.0 | 1.0 |\n",
            "Dynamic/UWB_dynamic_exp_mid.csv": f"1970-01-01 0:00:07.039,,{values}\n" * 6,
            "Dynamic/motion_capture_dynamic_exp_mid.csv": "time,x\n1970-01-01 0:00:07.0,1,2,3,0.5,0.1,0.2,0.3\n",
        },
    )
    for name in ("starloc", "rcv", "lias"):
        run_example("public_data.py", name, "data", cwd=tmp_path)
    starloc, rcv, lias = (
        tmp_path / "data" / "radios" / name for name in ("starloc_eight_s2", "rcv_sequence2", "lias_mid")
    )
    assert rows_of(starloc / "anchors.csv") == [["4", "4", "2", "1"]]  # by its distances, not by its marker's name
    assert [row[0] for row in rows_of(starloc / "truth.csv")] == ["0.0", "0.05"]
    assert read_ranges(starloc / "uwb.csv").tag_ids == ("1",)
    assert rows_of(rcv / "uwb.csv") == [["60.500000", "81", "1.5"]]
    assert rows_of(rcv / "anchors.csv") == [["81", "1.0", "2.0", "0.5"]]
    assert [row[:2] for row in rows_of(rcv / "truth.csv")] == [["60.000000", "1"]]
    ranges = rows_of(lias / "uwb.csv")
    assert len(ranges) == 2 * 23  # of rows 0 and 5; the first range is missing
    assert ranges[0] == ["7.039000", "0", "100", "T1"]
    assert ranges[22] == ["7.039000", "7", "122", "T2"]
    assert rows_of(lias / "truth.csv") == [["7.000000", "1", "2", "3", "0.1", "0.2", "0.3", "0.5"]]


def test_a_folder_without_public_data_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SystemExit, match="none of the repositories"):
        run_example("public_data.py", ".", "data", cwd=tmp_path)


SURVEYS = sorted(set(EXAMPLES.glob("*.toml")) - {EXAMPLES / "plan.toml"})


@pytest.mark.parametrize("path", SURVEYS, ids=lambda path: path.name)
def test_survey_file_is_one_for_a_folder_with_its_files(path: Path, tmp_path: Path) -> None:
    tables, _ = parse_toml(path)
    given = {
        f"{table}.{key}": name
        for table, keys in FILES_OF.items()
        for key in keys
        if (name := tables.get(table, {}).get(key))
    }
    for name in given.values():
        (tmp_path / name).touch()
    survey = read_survey(path, base_folder=tmp_path)
    assert survey.images.path == tmp_path / tables["images"]["path"]
    assert survey.ranges.path == tmp_path / tables["ranges"]["path"]
    assert survey.output.path == tmp_path / tables.get("output", {}).get("path", "out")


FILES_OF = {"images": ["times"], "ranges": ["path"], "anchors": ["path"], "report": ["reference"]}

"""One file of each kind is taken; where it is not clear which, the user is asked."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from tests.measurements.imu.test_formats import android
from tests.simulated.phone_survey import write_anchors, write_log, write_photos
from tests.simulated.small_demo import make_small_demo

from rangesfm.errors import InputError
from rangesfm.survey.discovery.understood import understand
from rangesfm.survey.survey_reader import read_survey, survey_from_tables

CAMERA = {"camera_model": "PINHOLE", "width": 96, "height": 64, "params": [90, 90, 48, 32], "tag_in_cam_m": [0, 0.1, 0]}


def test_a_whole_folder_is_a_survey(tmp_path: Path) -> None:
    write_photos(tmp_path / "images", 3)
    write_log(tmp_path / "uwb.csv", 0.0)
    write_anchors(tmp_path / "anchors_surveyed.csv")
    (tmp_path / "camera.json").write_text(json.dumps(CAMERA))
    values, _ = understand([tmp_path], {})
    assert values == {
        "images.path": tmp_path / "images",
        "ranges.path": tmp_path / "uwb.csv",
        "anchors.path": tmp_path / "anchors_surveyed.csv",
        "camera.model": "PINHOLE",
        "camera.params": (90, 90, 48, 32),
        "tag.tag_in_cam_m": (0, 0.1, 0),
    }
    survey = survey_from_tables({}, tmp_path, values)
    assert survey.camera.params == (90, 90, 48, 32)
    assert survey.tag.tag_in_cam_m == (0, 0.1, 0)


def test_a_phones_recording_and_a_calibration_of_both_are_the_inertial_sensor(tmp_path: Path) -> None:
    write_photos(tmp_path / "images", 3)
    write_log(tmp_path / "uwb.csv", 0.0)
    android(tmp_path)
    rows = [[0, -1, 0, 0.1], [0, 0, -1, 0], [1, 0, 0, -0.02], [0, 0, 0, 1]]
    camera = "camera_model: pinhole, intrinsics: [90, 90, 48, 32], resolution: [96, 64]"
    (tmp_path / "camchain-imucam.yaml").write_text(f"cam0: {{{camera}, T_cam_imu: {rows}}}\n")
    values, _ = understand([tmp_path], {})
    assert values["imu.path"] == tmp_path / "2026-09-22_10-00-00"
    assert values["imu.rotation_imu_to_cam_xyzw"] == [0.5, -0.5, 0.5, 0.5]
    assert values["imu.imu_in_cam_m"] == [0.1, 0.0, -0.02]


def test_the_usual_name_is_meant_and_the_others_are_told(tmp_path: Path) -> None:
    tmp_path = tmp_path / "photos" / "monday"  # names of the folders above do not matter
    write_photos(tmp_path / "images" / "left", 2)
    write_photos(tmp_path / "images" / "right", 2)
    write_photos(tmp_path / "images_small", 2)
    write_log(tmp_path / "uwb.csv", 0.0)
    write_log(tmp_path / "uwb_old.csv", 0.0)
    values, notes = understand([tmp_path], {})
    assert values == {"images.path": tmp_path / "images", "ranges.path": tmp_path / "uwb.csv"}
    assert notes == ["images is used; left out: images_small", "uwb.csv is used; left out: uwb_old.csv"]


def test_what_nothing_tells_is_asked_for_all_at_once_with_the_flags(tmp_path: Path) -> None:
    write_photos(tmp_path / "a", 2)
    write_photos(tmp_path / "b", 2)
    write_log(tmp_path / "run_1.csv", 0.0)
    write_log(tmp_path / "run_2.csv", 0.0)
    with pytest.raises(InputError) as caught:
        understand([tmp_path], {})
    assert caught.value.advice == (
        "a, b: any of them may be [images] path; say which by --images PATH",
        "run_1.csv, run_2.csv: any of them may be [ranges] path; say which by --ranges PATH",
    )
    given = {"images.path": str(tmp_path / "b"), "ranges.path": tmp_path / "run_2.csv"}
    assert understand([tmp_path], given)[0] == {
        "images.path": tmp_path / "b",
        "ranges.path": tmp_path / "run_2.csv",
    }


def test_files_of_one_anchor_each_are_one_log(tmp_path: Path) -> None:
    for anchor in ("A1", "A2"):
        write_log(tmp_path / f"run_{anchor}.csv", 0.0, anchors=(anchor,))
    assert understand([tmp_path], {})[0] == {"ranges.path": tmp_path / "run_A*.csv"}


def test_a_folder_of_nothing_is_refused_with_what_is_there(tmp_path: Path) -> None:
    (tmp_path / "walk.insv").touch()
    with pytest.raises(InputError, match="found no photos, no COLMAP model") as caught:
        understand([tmp_path], {})
    assert "not used: walk.insv (extract plain photos" in caught.value.advice[0]


def test_of_several_cameras_that_of_the_photos_size_is_taken(tmp_path: Path) -> None:
    write_photos(tmp_path / "images", 3)
    cameras = tmp_path / "cameras.txt"
    cameras.write_text("1 PINHOLE 640 480 500 501 320 240\n2 PINHOLE 96 64 90 91 48 32\n")
    values = understand([tmp_path], {})[0]
    assert (values["camera.model"], values["camera.params"]) == ("PINHOLE", (90, 91, 48, 32))


def test_a_camera_of_another_size_is_left_out_but_its_lever_arm_holds(tmp_path: Path) -> None:
    write_photos(tmp_path / "images", 3)
    (tmp_path / "camera.json").write_text(json.dumps({**CAMERA, "width": 192, "height": 128}))
    values, notes = understand([tmp_path], {})
    assert values == {"images.path": tmp_path / "images", "tag.tag_in_cam_m": (0, 0.1, 0)}
    assert "0 of its cameras (192 x 128 pixels) fit the photos, so none is used" in notes[-1]


def test_a_video_is_the_photos_also_in_a_folder_of_the_usual_name(tmp_path: Path) -> None:
    (tmp_path / "images").mkdir()
    (tmp_path / "images" / "walk.MOV").touch()
    write_log(tmp_path / "uwb.csv", 0.0)
    values, _ = understand([tmp_path], {})
    assert values == {"images.path": tmp_path / "images" / "walk.MOV", "ranges.path": tmp_path / "uwb.csv"}


def test_what_the_user_says_goes_before_what_is_found(tmp_path: Path) -> None:
    write_photos(tmp_path / "images", 3)
    (tmp_path / "camera.json").write_text(json.dumps(CAMERA))
    given = {"tag.lever_arms_m": {"T1": (0, 0, 1)}, "camera.model": "SIMPLE_RADIAL"}
    assert understand([tmp_path], given)[0] == {"images.path": tmp_path / "images", **given}


def test_the_demos_own_files_are_understood(tmp_path: Path) -> None:
    made = make_small_demo(tmp_path / "demo", num_photos=10)
    told = read_survey(made.survey_path)
    made.survey_path.unlink()
    survey = survey_from_tables({}, tmp_path, understand([made.folder], {})[0])
    for table, key in (("images", "path"), ("ranges", "path"), ("anchors", "path"), ("report", "reference")):
        assert getattr(getattr(survey, table), key) == getattr(getattr(told, table), key)


def test_points_whose_columns_have_unknown_names_stop_with_a_whole_command_where_anchors_are_wanted(
    tmp_path: Path,
) -> None:
    (tmp_path / "releve.csv").write_text("Foo;Bar;Baz;Qux\nA1;1.5;2.5;0.5\nA2;8.5;2.25;1.5\nA3;8.25;9.5;2.5\n")
    write_photos(tmp_path / "images", 3)
    assert understand([tmp_path], {})[0] == {"images.path": tmp_path / "images"}  # nobody asks for anchors
    write_log(tmp_path / "uwb.csv", 0.0)
    with pytest.raises(InputError, match=r"releve\.csv: a table of anchors whose columns are not known") as caught:
        understand([tmp_path], {})
    assert any("--anchor_columns anchor_id=Foo,x=Bar,y=Baz,z=Qux" in line for line in caught.value.advice)
    write_anchors(tmp_path / "anchors.csv")
    assert understand([tmp_path], {})[0]["anchors.path"] == tmp_path / "anchors.csv"


@pytest.mark.parametrize("name", ["anchors.xlsx", "my_anchors.txt", "Ancres.dxf"])
def test_a_file_about_anchors_by_its_name_that_is_not_understood_stops(tmp_path: Path, name: str) -> None:
    write_photos(tmp_path / "images", 3)
    write_log(tmp_path / "uwb.csv", 0.0)
    (tmp_path / name).write_text("They stand in the corners.\n")
    (tmp_path / "anchors.png").touch()  # a sketch is no list
    with pytest.raises(InputError, match="is about anchors by its name and is not understood") as caught:
        understand([tmp_path], {})
    assert caught.value.path == tmp_path / name
    write_anchors(tmp_path / "corners.csv")
    understand([tmp_path], {})
    (tmp_path / "corners.csv").unlink()
    (tmp_path / name).unlink()
    understand([tmp_path], {})


def test_a_list_of_points_is_of_control_points_where_there_is_no_radio_or_the_photos_have_marks_of_them(
    tmp_path: Path,
) -> None:
    write_photos(tmp_path / "images", 3)
    points = tmp_path / "punkte.csv"
    points.write_text("Punktnr;Rechtswert;Hochwert;Höhe\nP1;464000,1;5432000,2;400\nP2;464010;5432001;401\n")
    assert understand([tmp_path], {})[0] == {"images.path": tmp_path / "images", "points.path": points}
    write_log(tmp_path / "uwb.csv", 0.0)
    assert understand([tmp_path], {})[0]["anchors.path"] == points
    (tmp_path / "marks.csv").write_text("photo,point,x,y\nIMG_0.jpg,P1,10,20\nIMG_1.jpg,P1,11,21\n")
    values, _ = understand([tmp_path], {})
    assert (values["points.path"], values["scale.markers"]) == (points, tmp_path / "marks.csv")
    assert "anchors.path" not in values


@pytest.mark.parametrize(
    "text",
    [
        "SourceFile,GPSLatitude,GPSLongitude,GPSAltitude\n./IMG_{k}.jpg,49.1{k},8.2,400.5\n",
        "Label,X/Easting,Y/Northing,Z/Altitude\nIMG_{k},46400{k},5432000,400.5\n",
    ],
)
def test_a_list_of_photos_with_places_is_of_positions(text: str, tmp_path: Path) -> None:
    write_photos(tmp_path / "images", 3)
    header, row = text.split("\n")[:2]
    path = tmp_path / "geotags.csv"
    path.write_text("\n".join([header, *(row.format(k=k) for k in range(3))]))
    assert understand([tmp_path], {})[0] == {"images.path": tmp_path / "images", "positions.path": path}


def test_the_keyframes_of_a_slam_program_are_the_model_where_there_are_no_photos(tmp_path: Path) -> None:
    for name in ("KeyFrameTrajectory.txt", "groundtruth.txt"):
        (tmp_path / name).write_text("".join(f"{1e9 + k:.6f} {k} 1 2 0 0 0 1\n" for k in range(30)))
    write_log(tmp_path / "uwb.csv", 0.0)
    values, _ = understand([tmp_path], {})
    assert values["images.model"] == tmp_path / "KeyFrameTrajectory.txt"
    assert values["report.reference"] == tmp_path / "groundtruth.txt"
    write_photos(tmp_path / "images", 3)
    values, notes = understand([tmp_path], {})
    assert "images.model" not in values
    assert any("KeyFrameTrajectory.txt is a trajectory: rangesfm scale" in note for note in notes)


def test_ranges_beside_positions_are_no_true_positions(tmp_path: Path) -> None:
    write_photos(tmp_path / "images", 3)
    rows = (
        f'{{"t": {k / 4}, "A1": {3 + k / 9:.3f}, "position": {{"x": 1.5, "y": {k / 8}, "z": 2}}}}' for k in range(40)
    )
    (tmp_path / "run.txt").write_text("\n".join(rows))
    values, notes = understand([tmp_path], {})
    assert values == {"images.path": tmp_path / "images"}
    assert any("if it is the radio's log, rangesfm ranges" in note for note in notes)

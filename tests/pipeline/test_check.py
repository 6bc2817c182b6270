"""A check reports what a run would work with, and everything that would stop it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from PIL import Image
from tests.simulated.files import write_rows
from tests.simulated.phone_survey import write_anchors, write_log, write_photos
from tests.simulated.surveys import model_of_poses

from rangesfm.pipeline.check import check_survey
from rangesfm.survey.settings import Survey
from rangesfm.survey.survey_reader import survey_from_tables
from rangesfm.util.geometry.trajectory import Trajectory

PHONE_START_S = 1777888800.0  # 2026-05-04 10:00:00 UTC
AXES_OF_SENSORS = {"gyro": ("x_rad_s", "y_rad_s", "z_rad_s"), "accel": ("x_m_s2", "y_m_s2", "z_m_s2")}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_photos(tmp_path / "images", 20, num_upright=3)
    write_log(tmp_path / "uwb.csv", PHONE_START_S + 5)
    write_anchors(tmp_path / "anchors.csv")
    return tmp_path


def write_model(folder: Path, names: Sequence[str]) -> None:
    """Write a model of poses of 20 photos."""
    at = np.arange(20.0)
    centers_m = np.column_stack([at, np.sin(at), np.zeros(20)])
    folder.mkdir()
    model_of_poses(Trajectory(np.arange(1, 21), tuple(names), at, centers_m, np.tile(np.eye(3), (20, 1, 1)))).write(
        folder
    )


def survey_of(folder: Path, **keys: object) -> Survey:
    values = {key.replace("__", "."): value for key, value in keys.items()}
    paths = {"images.path": folder / "images", "ranges.path": folder / "uwb.csv", "output.path": folder / "out"}
    return survey_from_tables({}, folder, {**paths, **values})


def test_a_good_survey_is_told_with_its_counts_times_and_what_is_assumed(folder: Path) -> None:
    checked = check_survey(survey_of(folder, anchors__path=folder / "anchors.csv"))
    assert checked.faults == []
    assert checked.exit_status == 0
    assert checked.facts == [
        "photos in images: 17 of 96 x 64 pixels, 3 of 64 x 96 pixels",
        "ranges: 60 of 1 tag (tag) to 4 anchors (A1, A2, A3, A4) in uwb.csv (canonical)",
        "anchors: 4 of 4 have positions in anchors.csv (frame site)",
        "times: 20 keyframes from 2026-05-04 10:00:00.000 to 10:00:19.000 UTC (exif), "
        "ranges from 2026-05-04 10:00:05.000 to 10:00:34.500 UTC",
    ]
    camera, upright, clocks = checked.assumed
    assert camera == "camera SIMPLE_RADIAL for 17 photos, f 115 pixels, guessed from the size of the photos"
    assert upright.startswith("camera SIMPLE_RADIAL for 3 photos")
    assert "without any, the ranges cover 14.0 of the 19.0 s of the photos" in clocks
    assert any(warning.startswith("the tag's place on the camera is not given") for warning in checked.warnings)
    assert any(warning.startswith("image times are whole seconds") for warning in checked.warnings)
    assert not (folder / "out").exists()


def test_a_given_lever_arm_offset_and_camera_are_facts_and_unknown_anchors_assumed(folder: Path) -> None:
    given = {"tag__tag_in_cam_m": (0, -0.1, 0), "ranges__time_offset": 3.0}
    camera = {"camera__model": "PINHOLE", "camera__params": (90, 90, 48, 32)}
    checked = check_survey(survey_of(folder, **given, **camera))
    assert "camera: PINHOLE for 17 photos, f 90 pixels, as given" in checked.facts
    assert "lever arm: the tag is at 0, -0.1, 0 m in the camera frame (right, down, forward)" in checked.facts
    assert "clocks: with the time offset of 3 s, the ranges cover 11.0 of the 19.0 s of the photos" in checked.facts
    assert checked.assumed == [
        "camera PINHOLE for 3 photos, f 115 pixels, guessed from the size of the photos",
        "no position of an anchor is known: all are estimated, and the map is in the first camera's frame",
    ]


def test_faults_of_photos_and_of_the_radio_are_both_told(folder: Path) -> None:
    (folder / "uwb.csv").write_text("timestamp_s,anchor_id,range_m\n0.1,A1,far\n")
    checked = check_survey(survey_of(folder, camera__model="PINHOLE", camera__params=(90, 90, 480, 32)))
    assert checked.exit_status == 2
    camera, radio = map(str, checked.faults)
    assert "do they belong to another image size?" in camera
    assert "uwb.csv:2: range_m is 'far'" in radio


def test_clocks_that_share_no_time_photos_without_times_and_missing_parts_are_faults(folder: Path) -> None:
    (nothing_shared,) = check_survey(survey_of(folder, ranges__time_offset=1e4)).faults
    assert "uwb.csv" in str(nothing_shared)
    write_photos(folder / "timeless", 5, has_times=False)
    (no_times,) = check_survey(survey_of(folder, images__path=folder / "timeless")).faults
    assert "no time for IMG_0.jpg: expected a CSV file" in str(no_times)
    without_photos = check_survey(survey_from_tables({}, folder, {"ranges.path": folder / "uwb.csv"}))
    assert [str(fault)[:9] for fault in without_photos.faults] == ["no photos"]
    assert without_photos.facts[0].startswith("ranges: 60 of 1 tag")
    faults = check_survey(survey_from_tables({}, folder)).faults
    assert [str(fault)[:9] for fault in faults] == ["no photos", "no ranges"]


@pytest.mark.parametrize("with_model", [False, True])
@pytest.mark.parametrize("kind", ["ranges", "positions", "imu"])
def test_a_log_of_any_kind_that_shares_no_time_with_the_photos_is_a_fault(
    kind: str, folder: Path, with_model: bool
) -> None:
    times_s = np.round(PHONE_START_S + np.arange(0.0, 20.0, 0.01), 2)
    turns = [(time_s, 0.1, 0, 0, 0, 0, 9.8) for time_s in times_s.tolist()]
    header = ",".join(
        ["timestamp_s", *(f"gyro_{axis}_rad_s" for axis in "xyz"), *(f"accel_{axis}_m_s2" for axis in "xyz")]
    )
    write_rows(folder / "imu.csv", header, turns)
    write_rows(
        folder / "gps.csv", "timestamp_s,x_m,y_m,z_m", [(PHONE_START_S + k, 2.0 * k, 0.1 * k, 0) for k in range(20)]
    )
    path = {"ranges": folder / "uwb.csv", "positions": folder / "gps.csv", "imu": folder / "imu.csv"}[kind]
    given = {"images__path": folder / "images", "ranges__path": None, f"{kind}__path": path}
    if with_model:
        write_model(folder / "sparse", [f"IMG_{k}.jpg" for k in range(20)])
        given |= {"images__model": folder / "sparse"}
    assert check_survey(survey_of(folder, **given, **{f"{kind}__time_offset": 0.0})).faults == []
    (apart,) = check_survey(survey_of(folder, **given, **{f"{kind}__time_offset": -3600.0})).faults
    assert apart.exit_status == 2
    assert str(apart).startswith(f"{path}: the log's times (2026-05-04 10:00:0")
    assert "plus an offset of -3600 s) do not overlap the photos' (2026-05-04 10:00:00.000 to 10:00:19.000 UTC)" in str(
        apart
    )


def test_what_alone_determines_the_scale_is_told(folder: Path) -> None:
    rows = [(PHONE_START_S + k, 2.0 * k, np.sin(k), 0.1 * k) for k in range(20)]
    write_rows(folder / "gps.csv", "timestamp_s,x_m,y_m,z_m", rows)
    given, said = {"positions__path": folder / "gps.csv"}, "positions: 20 in gps.csv (table)"
    assert said in check_survey(survey_of(folder, **given)).facts
    alone = check_survey(survey_of(folder, **given, ranges__path=None)).facts
    assert f"{said}, which alone determine the scale (no ranges)" in alone


def test_the_times_of_a_model_are_those_of_its_photos(folder: Path) -> None:
    at = np.arange(20.0)
    names = tuple(f"{k}.jpg" for k in range(20))
    write_model(folder / "sparse", names)
    timed = [*zip(names[:15], at + PHONE_START_S), ("of another walk.jpg", PHONE_START_S + 1000)]
    write_rows(folder / "times.csv", "image_name,timestamp_s", timed)
    model = {"images.model": folder / "sparse", "images.times": folder / "times.csv", "ranges.path": folder / "uwb.csv"}
    checked = check_survey(survey_from_tables({}, folder, model))
    assert any("15 of 20 keyframes from 2026-05-04 10:00:00.000 to 10:00:14.000" in fact for fact in checked.facts)
    write_rows(folder / "times.csv", "image_name,timestamp_s", timed[15:])
    (fault,) = check_survey(survey_from_tables({}, folder, model)).faults
    assert "none of the photos has a time, the first is 0.jpg" in str(fault)


def test_masks_a_database_and_options_of_colmap_are_looked_at(folder: Path) -> None:
    names = [path.name for path in sorted((folder / "images").iterdir())]
    for name in names:
        with Image.open(folder / "images" / name) as photo:
            size = photo.size
        (folder / "masks").mkdir(exist_ok=True)
        Image.new("L", size, 255).save(folder / "masks" / f"{name}.png")
    masked = check_survey(survey_of(folder, mapper__mask_path=folder / "masks"))
    assert f"masks: of {len(names)} photos" in masked.facts
    assert masked.faults == []
    (folder / "masks" / f"{names[3]}.png").unlink()
    (missing,) = check_survey(survey_of(folder, mapper__mask_path=folder / "masks")).faults
    assert f"1 of {len(names)} photos have no mask in this folder, the first is {names[3]}" in str(missing)
    with pycolmap.Database.open(folder / "empty.db"):
        pass
    (poor,) = check_survey(survey_of(folder, mapper__database_path=folder / "empty.db")).faults
    assert f"empty.db: has features of 0 of {len(names)} photos" in str(poor)
    (unknown,) = check_survey(survey_of(folder, mapper__features={"max_features": 3})).faults
    assert "max_features" in str(unknown)
    assert not (folder / "out").exists()


@pytest.mark.parametrize(
    ("ends", "marks", "said"),
    [
        ("A1,A9", "", "taped.csv:2: an end is 'A9', expected a photo that is in the model, a marker or an anchor"),
        ("A1,{first}", "", "expected two anchors, or two ends that are not anchors"),
        ("{first},door", "", "taped.csv:2: an end is 'door', expected a photo that is in the model, a marker"),
        ("{first},door", "door,{first},1,2\ndoor,gone.jpg,1,2\n", "marker 'door' is marked in 1 photos of the survey"),
        ("{first},tag7.0", "", "an end is 'tag7.0'"),
        ("{first},{last}", "", ""),
    ],
)
def test_an_end_of_a_taped_distance_that_does_not_exist_is_a_fault(
    ends: str, marks: str, said: str, folder: Path
) -> None:
    names = sorted(path.name for path in (folder / "images").iterdir())
    photos = {"first": names[0], "last": names[-1]}
    (folder / "taped.csv").write_text(f"from,to,distance_m\n{ends.format(**photos)},2.5\n")
    (folder / "marks.csv").write_text(f"marker,image_name,x_px,y_px\n{marks.format(**photos)}")
    tape = {"scale__distances": folder / "taped.csv", **({"scale__markers": folder / "marks.csv"} if marks else {})}
    checked = check_survey(survey_of(folder, anchors__path=folder / "anchors.csv", **tape))
    assert [said in str(fault) for fault in checked.faults] == ([True] if said else [])
    if "tag" in ends:
        assert not check_survey(survey_of(folder, **tape, markers__dictionary="APRILTAG_36h11")).faults

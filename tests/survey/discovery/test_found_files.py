"""Each file is recognized by its content, whatever its name."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from tests.measurements.ranges.readers.test_readers_ros import message, write_bag1
from tests.simulated.phone_survey import write_photos
from tests.survey.sources.recorded import raw, write_bag

from rangesfm.colmap.model_files import read_model
from rangesfm.errors import InputError, ReconstructionError
from rangesfm.measurements.ranges.readers import read_ranges
from rangesfm.sfm.photo_files import usable_photos
from rangesfm.survey.discovery.found_files import Found, look_into

CONTENTS = {
    "ranges.path": "t;node;dist\n0.1;7;2.5\n0.2;8;2.6\n0.3;7;2.5\n",
    "anchors.path": "id,x,y,z\nA1,1,2,3\n",
    "images.times": "filename,timestamp\na.jpg,0.1\n",
    "report.reference": "timestamp_s,x_m,y_m,z_m,qx,qy,qz,qw\n0.1,1,2,3,0,0,0,1\n",
    "scale.distances": "from,to,distance_m\na,b,1.5\n",
    "scale.markers": "marker,image_name,x_px,y_px\na,a.jpg,1,2\n",
    "ranges.error_curve": "distance_m,error_m,stddev_m,noise_stddev_m\n1,0.1,0.01,0.1\n2,0.1,0.01,0.1\n",
}


def paths(found: Found) -> dict[str, list[str]]:
    return {key: [path.name for path in those] for key, those in found.paths.items()}


@pytest.mark.parametrize("key", CONTENTS)
def test_a_table_is_known_by_its_header(key: str, tmp_path: Path) -> None:
    (tmp_path / "anything.txt").write_text(CONTENTS[key])
    found = look_into([tmp_path])
    assert paths(found) == {key: ["anything.txt"]}
    assert found.notes == ()


def test_distances_between_photos_are_no_log(tmp_path: Path) -> None:
    rows = [f"IMG_{k}.jpg,IMG_{k + 1}.jpg,{1 + 0.1 * k:.2f},0.01" for k in range(8)]
    (tmp_path / "lengths.csv").write_text("\n".join(["from,to,distance_m,stddev_m", *rows]))
    assert paths(look_into([tmp_path])) == {"scale.distances": ["lengths.csv"]}


def test_a_tum_trajectory_is_a_reference(tmp_path: Path) -> None:
    (tmp_path / "path.txt").write_text("# time x y z qx qy qz qw\n0.1 1 2 3 0 0 0 1\n0.2 1 2 3 0 0 1 0\n")
    assert paths(look_into([tmp_path])) == {"report.reference": ["path.txt"]}


def test_ranges_with_the_true_position_beside_each_are_ranges(tmp_path: Path) -> None:
    (tmp_path / "log.csv").write_text("timestamp_s,anchor_id,range_m,x_m,y_m,z_m\n0.1,7,2.5,1,2,3\n0.2,8,2.6,1,2,3\n")
    assert paths(look_into([tmp_path])) == {"ranges.path": ["log.csv"]}


def test_photos_are_found_in_the_folder_that_holds_them_also_behind_a_link(tmp_path: Path) -> None:
    write_photos(tmp_path / "elsewhere", 3)
    survey = tmp_path / "survey"
    survey.mkdir()
    (survey / "images").symlink_to(tmp_path / "elsewhere")
    (survey / "again").symlink_to(survey)
    assert look_into([survey]).paths == {"images.path": [survey / "images"]}


def test_what_is_not_used_is_listed_with_the_reason_without_results_of_runs_and_hidden_files(tmp_path: Path) -> None:
    write_photos(tmp_path / "out" / "images", 2)
    (tmp_path / "out" / "result.json").write_text("{}")
    (tmp_path / "out" / "images.csv").write_text(CONTENTS["images.times"])
    (tmp_path / ".images.csv").write_text(CONTENTS["images.times"])
    (tmp_path / "README.md").write_text("# What this is, and when\n")
    (tmp_path / "empty.csv").touch()
    (tmp_path / "database.db").write_bytes(b"SQLite format 3\0\0\0")
    write_photos(tmp_path, 1)
    found = look_into([tmp_path])
    assert found.paths == {}
    assert found.notes == (
        "not used: IMG_0.jpg (a folder of photos has 2 or more)",
        "not used: README.md, database.db, empty.csv (no input that is known)",
    )
    for k in range(200):
        (tmp_path / f"depth_{k}.npy").touch()
    (note,) = (note for note in look_into([tmp_path]).notes if "known" in note)
    assert note.startswith("not used: README.md, database.db, depth_0.npy, depth_1.npy and 199 more (.csv, .npy)")


def test_what_cannot_be_used_is_said(tmp_path: Path) -> None:
    for name in ("walk.INSV", "walk2.insv", "IMG_1.HEIC"):
        (tmp_path / name).touch()
    (tmp_path / "sparse").mkdir()
    for name in ("cameras.txt", "images.txt", "points3D.txt"):
        (tmp_path / "sparse" / name).touch()
    found = look_into([tmp_path])
    assert found.paths == {}
    photos, videos = found.notes
    assert found.models == (tmp_path / "sparse",)
    assert photos == "not used: IMG_1.HEIC (convert them to JPEG)"
    assert videos.startswith("not used: walk.INSV, walk2.insv (extract plain photos")


def test_a_bag_is_a_log_if_it_has_ranges(tmp_path: Path) -> None:
    name = "uwb_ros/msg/RangeStamped"
    bag = write_bag1(tmp_path, [(name, message(1, name, range=2.5, from_id=1, to_id=3, covariance=0.04))])
    found = look_into([tmp_path])
    assert paths(found) == {"ranges.path": ["log.bag"]}
    assert found.notes == ()
    bag.unlink()
    node = "nlink_parser/msg/LinktrackNode2"
    write_bag1(tmp_path, [(node, message(1, node, role=1, id=1, dis=1.0, fp_rssi=0.0, rx_rssi=0.0))])
    found = look_into([tmp_path])
    assert found.paths == {}
    assert "no ranges in this bag" in found.notes[0]


def test_a_bag_with_images_is_photos_and_what_a_run_took_out_of_it_is_not(tmp_path: Path) -> None:
    stamped = ("/uwb", "uwb_ros/msg/RangeStamped", 1.0, {"range": 2.5, "from_id": 1, "to_id": 3, "covariance": 0.04})
    image = ("/image", "sensor_msgs/msg/Image", 1.0, raw(np.zeros((2, 2, 1), np.uint8), "mono8"))
    write_bag(tmp_path / "walk", [stamped, image])
    write_photos(tmp_path / "out" / "photos", 3)
    (tmp_path / "out" / "photos" / "photos.json").touch()
    assert look_into([tmp_path]).paths == {"images.path": [tmp_path / "walk"], "ranges.path": [tmp_path / "walk"]}


def test_a_track_of_a_phone_is_positions(tmp_path: Path) -> None:
    (tmp_path / "walk.gpx").write_text('<gpx><trk><trkseg><trkpt lat="47" lon="9"><ele>4</ele></trkpt></trkseg></trk>')
    assert paths(look_into([tmp_path])) == {"positions.path": ["walk.gpx"]}


def test_positions_of_a_radio_are_positions_unless_ranges_are_beside_them(tmp_path: Path) -> None:
    position = "POS,4.07,-2.85,0.59,74\n"
    (tmp_path / "lep.log").write_text("".join(f"{1.7e9 + k:.3f} {position}" for k in range(30)))
    (tmp_path / "lec.log").write_text(f"{1.7e9:.3f} DIST,1,AN0,022E,7.94,8.03,0.00,3.44,{position}")
    assert paths(look_into([tmp_path])) == {"positions.path": ["lep.log"], "ranges.path": ["lec.log"]}


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("version https://git-lfs.github.com/spec/v1\noid sha256:4d7a2146\nsize 12345\n", "is a pointer of Git LFS"),
        ("<!DOCTYPE html>\n<html><body>Sign in, 1, 2, 3</body></html>\n", "is an HTML page"),
    ],
)
def test_what_stands_in_place_of_a_file_is_said(content: str, said: str, tmp_path: Path) -> None:
    (tmp_path / "uwb.csv").write_text(content)
    assert [said in note for note in look_into([tmp_path]).notes] == [True]
    with pytest.raises(InputError, match=f"uwb.csv: {said} in place of the file itself"):
        read_ranges(tmp_path / "uwb.csv")
    for name in ("cameras.bin", "images.bin", "points3D.bin", "a.jpg", "b.jpg"):
        (tmp_path / name).write_text(content)
    with pytest.raises(InputError, match=f"cameras.bin: {said}"):
        read_model(tmp_path)
    with pytest.raises(ReconstructionError, match=f"; a.jpg {said}"):
        usable_photos(tmp_path, ["a.jpg", "b.jpg"])


def test_a_table_that_may_be_a_log_is_told_unless_there_is_one(tmp_path: Path) -> None:
    (tmp_path / "my log.csv").write_text("a,b,c\n0.1,2.5,3.5\n0.2,2.6,3.7\n0.3,2.7,3.8\n")
    (note,) = look_into([tmp_path]).notes
    assert "not known for sure" in note
    assert f"rangesfm ranges '{tmp_path / 'my log.csv'}' says what is missing" in note
    (tmp_path / "uwb.csv").write_text(CONTENTS["ranges.path"])
    assert look_into([tmp_path]).notes == ("not used: my log.csv (a table whose columns are not known for sure)",)


def test_what_is_no_folder_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such folder"):
        look_into([tmp_path / "none"])

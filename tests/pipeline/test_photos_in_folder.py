"""A survey of a bag becomes a survey of photos, with their times and their camera, when it is run."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from tests.conftest import Command, PhotoRun
from tests.known import known
from tests.outputs import paths_below
from tests.result_document import result_document
from tests.simulated.phone_survey import write_log
from tests.survey.sources.recorded import Message, camera_info, compressed, raw, write_bag

from rangesfm.demo.survey import TIME_OFFSET_S, DemoSurvey
from rangesfm.errors import InputError
from rangesfm.options import CameraOptions
from rangesfm.pipeline.check import check_survey
from rangesfm.pipeline.map_photos import with_photos_in_folder
from rangesfm.progress import Journal, Progress
from rangesfm.result.result_folder import read_result_folder
from rangesfm.survey.settings import Survey
from rangesfm.survey.survey_reader import survey_from_tables
from rangesfm.util.geometry.moments import ByTime
from rangesfm.util.geometry.reference import Reference, write_reference

IMAGE = raw(np.arange(48, dtype=np.uint8).reshape(6, 8, 1), "mono8")
INFO = camera_info((8, 6), (9, 9, 4, 3), ())


@pytest.fixture
def survey(tmp_path: Path) -> Survey:
    messages: list[Message] = [("/image", "sensor_msgs/msg/Image", 100 + 0.5 * k, IMAGE) for k in range(8)]
    bag = write_bag(tmp_path / "walk", [*messages, ("/camera_info", "sensor_msgs/msg/CameraInfo", 100.0, INFO)])
    write_log(tmp_path / "uwb.csv", 100.0)
    paths = {"images.path": bag, "ranges.path": tmp_path / "uwb.csv", "output.path": tmp_path / "out"}
    return survey_from_tables({}, tmp_path, paths)


def test_photos_times_and_camera_take_the_bags_place(survey: Survey) -> None:
    journal = Journal(Progress())
    changed = with_photos_in_folder(survey, journal)
    folder = survey.output.path / "photos"
    assert (changed.images.path, changed.images.times) == (folder, folder / "images.csv")
    assert (changed.camera.model, changed.camera.params) == ("PINHOLE", (9.0, 9.0, 4.5, 3.5))
    assert len([*folder.glob("*.png")]) == 8
    assert journal.warnings == []
    assert journal.notes == [
        "the photos are the sharpest of each 0.5 s of walk; their times are the stamps of their headers",
        "the camera is that of /camera_info, unless one is given",
    ]
    assert with_photos_in_folder(changed, journal) == changed


def test_a_camera_that_is_given_stays(survey: Survey) -> None:
    by_folder = CameraOptions(others=(CameraOptions(images="left"),))
    for given in (survey.changed({"camera.model": "SIMPLE_RADIAL"}), survey.model_copy(update={"camera": by_folder})):
        assert with_photos_in_folder(given, Journal(Progress())).camera == given.camera


def test_other_times_beside_those_of_a_bag_are_refused(survey: Survey) -> None:
    with pytest.raises(InputError, match="walk: its images have their own times"):
        with_photos_in_folder(survey.changed({"images.times": survey.ranges.path}), Journal(Progress()))


def test_a_check_tells_of_a_bag_and_takes_nothing_out(survey: Survey) -> None:
    checked = check_survey(survey)
    assert checked.faults == []
    assert checked.facts[0].startswith("photos of walk: 8 images of /image, 8 x 6 pixels; about 8 photos at 2 Hz")
    assert "the photos' times are the stamps of their headers" in checked.assumed
    assert not survey.output.path.exists()


def write_demo_as_bag(demo: DemoSurvey, folder: Path) -> None:
    """Write a bag with camera and radio, anchors named by the radio's numbers, and the truth by time."""
    folder.mkdir()
    log = demo.ranges
    messages: list[Message] = []
    for time_s, anchor_id, range_m in zip(
        log.timestamp_s.tolist(), log.end_ids()[1], log.range_m.tolist(), strict=True
    ):
        range_ = {"range": range_m, "from_id": 100, "to_id": int(anchor_id[1:]), "covariance": 0.0}
        messages.append(("/uwb", "uwb_ros/msg/RangeStamped", time_s, range_))
    for name, time_s in zip(demo.image_names, demo.timestamps_s.tolist(), strict=True):
        content = compressed((demo.folder / "images" / name).read_bytes())
        messages.append(("/cam/image/compressed", "sensor_msgs/msg/CompressedImage", time_s, content))
    with Image.open(demo.folder / "images" / demo.image_names[0]) as photo:
        size = photo.size
    k = np.array([748.8, 748.8, 480, 320]) * size[0] / 960 - (0, 0, 0.5, 0.5)
    info = camera_info(size, k.tolist(), (-0.04, 0, 0, 0, 0))
    messages.append(("/cam/camera_info", "sensor_msgs/msg/CameraInfo", messages[0][2], info))
    write_bag(folder / "walk", sorted(messages, key=lambda message: message[2]))
    anchors = (demo.folder / "anchors.csv").read_text(encoding="utf-8")
    (folder / "anchors.csv").write_text(anchors.replace("\nA", "\n"), encoding="utf-8")
    write_reference(Reference(demo.centers_m, ByTime(demo.timestamps_s)), folder / "truth.csv")


def test_a_folder_with_one_bag_of_camera_and_radio_is_a_whole_survey(
    photo_run: PhotoRun, rangesfm_command: Command, tmp_path: Path
) -> None:
    folder = tmp_path / "robot"
    write_demo_as_bag(photo_run.survey, folder)
    flags = (
        "--ranges_time_offset",
        str(TIME_OFFSET_S),
        "--reproducible",
        "--features",
        "sift.max_num_features=2000",
    )
    written = rangesfm_command("init", "robot", "--tag_in_cam", "0.03,-0.12,-0.05", cwd=tmp_path)
    assert written.stdout.splitlines()[-1].startswith("next: rangesfm run")
    rangesfm_command("run", "robot", *flags, "--features", "sift.max_num_features=2000", cwd=tmp_path)
    of_bag, of_photos = (read_result_folder(path).summary for path in (folder / "out", photo_run.output_path))
    assert {"walk.mcap", "photos"} <= {Path(item["path"]).name for item in of_bag.to_json()["inputs"]}
    assert of_bag.map.num_photos == of_photos.map.num_photos == 14
    assert of_bag.scale.relative_stddev.formal == pytest.approx(of_photos.scale.relative_stddev.formal, rel=0.1)
    bag, photos = of_bag.comparison[-1], of_photos.comparison[-1]
    assert (bag.name, photos.name) == ("refined", "refined")
    noise_percent = 100 * known(of_photos.scale.relative_stddev.formal)
    assert bag.scale_error_percent == pytest.approx(photos.scale_error_percent, abs=noise_percent)
    assert of_photos.place is not None
    assert bag.rmse_m == pytest.approx(photos.rmse_m, abs=float(np.linalg.norm(of_photos.place.stddev_m)))


def test_photos_of_a_result_stay_until_there_is_another_one(survey: Survey) -> None:
    first = with_photos_in_folder(survey, Journal(Progress()))
    settings = {"images": {"path": str(first.images.path)}}
    (survey.output.path / "result.json").write_text(json.dumps(result_document(settings=settings)))
    before = {path: path.read_bytes() for path in paths_below(survey.output.path) if path.is_file()}
    slower = with_photos_in_folder(survey.changed({"images.rate_hz": 1.0}), Journal(Progress()))
    assert slower.images.path == survey.output.path / "photos_2"
    assert {path: path.read_bytes() for path in before} == before
    assert with_photos_in_folder(survey, Journal(Progress())) == first

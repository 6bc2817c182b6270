"""The demo's survey is complete, gives the times of its photos, and comes with the truth."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from datetime import datetime
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from PIL import Image
from PIL.ExifTags import IFD, Base
from tests.outputs import paths_below

from rangesfm.demo.survey import (
    ANCHOR_STDDEV_M,
    ANCHORS_M,
    CAMERA_PARAMS,
    PHOTOS,
    TIME_OFFSET_S,
    DemoSurvey,
    make_demo_survey,
)
from rangesfm.errors import InputError
from rangesfm.measurements.ranges.anchors.anchor_file import read_anchors
from rangesfm.measurements.ranges.readers import read_ranges
from rangesfm.survey.survey_reader import read_survey
from rangesfm.util.files.atomic import write_text
from rangesfm.util.files.output_folder import sole_writer
from rangesfm.util.geometry.moments import ByPhoto
from rangesfm.util.geometry.reference import read_reference

NUM_PHOTOS = 4


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> DemoSurvey:
    return _make(tmp_path_factory.mktemp("demo") / "survey")


def _make(folder: Path, seed: int = 5) -> DemoSurvey:
    return make_demo_survey(folder, num_photos=NUM_PHOTOS, seed=seed)


def _files(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in paths_below(folder) if path.is_file()}


def test_folder_holds_the_survey_and_nothing_half_written(made: DemoSurvey) -> None:
    photos = {f"images/{name}" for name in made.image_names}
    assert _files(made.folder).keys() == photos | {"survey.toml", "uwb.csv", "anchors.csv", "reference.csv"}


def test_survey_file_is_valid_and_names_the_camera_that_took_the_photos(made: DemoSurvey) -> None:
    survey = read_survey(made.survey_path, {})
    assert survey.camera.model == "SIMPLE_RADIAL"
    assert survey.camera.params == pytest.approx(CAMERA_PARAMS)
    assert survey.anchors.frame == "site"
    assert survey.ranges.time_offset_s is None
    assert survey.report.reference == made.folder / "reference.csv"


def test_exif_tells_the_time_of_each_photo_to_the_millisecond(made: DemoSurvey) -> None:
    for name, timestamp_s in zip(made.image_names, made.timestamps_s, strict=True):
        with Image.open(made.folder / "images" / name) as photo:
            exif = photo.getexif().get_ifd(IFD.Exif)
        text = f"{exif[Base.DateTimeOriginal]}.{exif[Base.SubsecTimeOriginal]}{exif[Base.OffsetTimeOriginal]}"
        taken = datetime.strptime(text, "%Y:%m:%d %H:%M:%S.%f%z")
        assert taken.timestamp() == pytest.approx(timestamp_s, abs=1e-6)


def test_colmap_guesses_the_focal_length_from_exif_within_two_percent(made: DemoSurvey) -> None:
    guess = pycolmap.infer_camera_from_image(made.folder / "images" / made.image_names[0])
    assert guess.has_prior_focal_length
    assert guess.focal_length == pytest.approx(CAMERA_PARAMS[0], rel=0.02)


def test_log_is_on_the_radios_clock_and_covers_all_photos(made: DemoSurvey) -> None:
    log = read_ranges(made.folder / "uwb.csv")
    assert set(log.anchor_ids) == set(ANCHORS_M)
    np.testing.assert_array_equal(log.range_m, made.ranges.range_m)
    times = np.asarray(log.timestamp_s) + TIME_OFFSET_S
    assert times.min() < made.timestamps_s[0] - 1
    assert times.max() > made.timestamps_s[-1] + 1
    assert abs(TIME_OFFSET_S) > 1


def test_surveyed_anchors_are_near_the_true_ones_and_not_in_one_plane(made: DemoSurvey) -> None:
    anchors = read_anchors(made.folder / "anchors.csv")
    assert len(anchors) >= 4
    surveyed = np.array([anchor.position_m for anchor in anchors])
    true = np.array([ANCHORS_M[anchor.anchor_id] for anchor in anchors])
    assert 0 < np.abs(surveyed - true).max() < 4 * ANCHOR_STDDEV_M
    assert all(anchor.position_stddev_m == ANCHOR_STDDEV_M for anchor in anchors)
    assert np.linalg.svd(surveyed - surveyed.mean(axis=0))[1][2] > 0.5


def test_reference_is_the_true_path(made: DemoSurvey) -> None:
    reference = read_reference(made.folder / "reference.csv")
    assert reference.moments == ByPhoto(made.image_names)
    np.testing.assert_allclose(reference.positions_m, made.centers_m, atol=1e-6)


def test_same_seed_makes_the_same_files(made: DemoSurvey, tmp_path: Path) -> None:
    assert _files(_make(tmp_path / "again").folder) == _files(made.folder)


def test_another_seed_is_another_radio_and_other_anchors_over_the_same_path(made: DemoSurvey, tmp_path: Path) -> None:
    before, after = _files(made.folder), _files(_make(tmp_path / "other", seed=6).folder)
    assert before.keys() == after.keys()
    assert {name for name in before if before[name] != after[name]} == {"survey.toml", "uwb.csv", "anchors.csv"}


def test_all_forty_photos_ship_and_a_short_survey_has_the_first_of_them(made: DemoSurvey, tmp_path: Path) -> None:
    whole = make_demo_survey(tmp_path / "whole")
    shipped = sorted(PHOTOS.glob("*.jpg"))
    assert [path.name for path in shipped] == list(whole.image_names)
    assert len(shipped) == 40
    assert made.image_names == whole.image_names[:NUM_PHOTOS]
    for path in shipped[:NUM_PHOTOS]:
        assert (made.folder / "images" / path.name).read_bytes() == path.read_bytes()
    np.testing.assert_array_equal(made.centers_m, whole.centers_m[:NUM_PHOTOS])
    assert sum(path.stat().st_size for path in shipped) < 4.5e6  # so that a wheel stays below 10 MB


@pytest.fixture
def no_photos(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let copying a photo raise KeyboardInterrupt."""

    def fail(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("shutil.copyfile", fail)


@pytest.mark.usefixtures("no_photos")
def test_survey_that_is_there_already_is_not_made_again(made: DemoSurvey) -> None:
    before = _files(made.folder)
    again = _make(made.folder)
    np.testing.assert_array_equal(again.centers_m, made.centers_m)
    assert _files(made.folder) == before


@pytest.mark.usefixtures("no_photos")
def test_folder_with_other_things_is_refused_and_left_alone(tmp_path: Path) -> None:
    (tmp_path / "holiday.txt").write_text("mine")
    with pytest.raises(InputError, match="empty folder"):
        _make(tmp_path)
    assert _files(tmp_path) == {"holiday.txt": b"mine"}


@pytest.mark.usefixtures("no_photos")
def test_interrupted_survey_leaves_no_photos(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        _make(tmp_path / "demo")
    assert _files(tmp_path) == {}


@pytest.mark.usefixtures("no_photos")
def test_one_at_a_time_makes_a_survey_in_a_folder(tmp_path: Path) -> None:
    with sole_writer(tmp_path), ThreadPoolExecutor(1) as other, pytest.raises(InputError, match="has been writing"):
        other.submit(_make, tmp_path).result()


@pytest.mark.usefixtures("no_photos")
def test_what_a_killed_one_left_is_not_in_the_way_and_goes(tmp_path: Path) -> None:
    with sole_writer(tmp_path):
        write_text("anchor_id\n", tmp_path / "anchors.csv")
    with pytest.raises(KeyboardInterrupt):
        _make(tmp_path)
    (tmp_path / "anchors.csv").write_text("mine\n")
    with pytest.raises(InputError, match="expected a new or an empty folder"):
        _make(tmp_path)
    assert _files(tmp_path) == {"anchors.csv": b"mine\n"}

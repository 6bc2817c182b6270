"""A database of COLMAP or hloc in place of features and matches."""

from __future__ import annotations

import shutil
import sqlite3
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pycolmap
import pytest
from tests.sfm.matches import content_of

from rangesfm.errors import InputError
from rangesfm.mapper_options import MapperOptions
from rangesfm.options import CameraOptions
from rangesfm.sfm.reconstruct import ReconstructionSummary, reconstruct
from rangesfm.util.files.contents import sha256_of

if TYPE_CHECKING:
    from tests.listener import Listener
    from tests.sfm.conftest import Room

FEATURES = {"sift": {"first_octave": 0, "max_num_features": 250}}


@pytest.fixture(scope="module")
def earlier(room: Room, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A database of the room, as COLMAP leaves it."""
    output = tmp_path_factory.mktemp("earlier")
    reconstruct(room.folder, room.names, output, camera=room.camera, mapper=MapperOptions(features=FEATURES))
    return output / "database.db"


@pytest.fixture
def given(earlier: Path, tmp_path: Path) -> Path:
    """A copy of the database that a test may change."""
    return Path(shutil.copy(earlier, tmp_path / "given.db"))


def reconstructed(room: Room, given: Path, listener: Listener, **others: Any) -> ReconstructionSummary:
    mapper = MapperOptions(database_path=given, **others)
    output = given.with_name("out")
    return reconstruct(room.folder, room.names, output, camera=CameraOptions(), mapper=mapper, progress=listener)


def test_its_features_matches_and_cameras_are_used_and_it_stays_as_it_is(
    room: Room, given: Path, earlier: Path, listener: Listener, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = sha256_of(given)
    monkeypatch.setattr(pycolmap, "extract_features", None)
    monkeypatch.setattr(pycolmap, "geometric_verification", None)
    monkeypatch.setattr("rangesfm.sfm.photo_matching.match_features", None)
    summary = reconstructed(room, given, listener)
    assert summary.num_registered == len(room.names)
    assert content_of(given.with_name("out") / "database.db") == content_of(earlier)
    assert [tuple(camera.params)[1:] for camera in summary.models[0].cameras.values()] == [
        tuple(room.camera.params or ())[1:]
    ]
    assert sha256_of(given) == before
    assert listener.messages == ["features of 6 photos and matches of 15 pairs are taken from given.db"]
    reconstructed(room, given, listener)
    assert [text for text in listener.messages if "earlier run" in text] == [
        f"{step}: taken over from an earlier run" for step in ("features", "matching", "mapping")
    ]


def test_without_matches_only_those_are_computed(
    room: Room, given: Path, earlier: Path, listener: Listener, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pycolmap.Database.open(given) as database:
        database.clear_matches()
        database.clear_two_view_geometries()
    monkeypatch.setattr(pycolmap, "extract_features", None)
    reconstructed(room, given, listener)
    assert content_of(given.with_name("out") / "database.db") == content_of(earlier)


def test_of_hloc_without_descriptors_and_two_view_geometries_the_matches_are_verified(
    room: Room, given: Path, listener: Listener
) -> None:
    with pycolmap.Database.open(given) as database:
        database.clear_descriptors()
        database.clear_two_view_geometries()
    assert reconstructed(room, given, listener).num_registered == len(room.names)
    with pycolmap.Database.open(given) as database:
        database.clear_matches()
    with pytest.raises(InputError, match=r"given.db: has neither matches nor descriptors to match photo000.png by"):
        reconstructed(room, given, listener)


def test_photos_that_only_one_side_has_are_told_in_one_line(room: Room, given: Path, listener: Listener) -> None:
    with pycolmap.Database.open(given) as database:
        image = database.read_image(3)
        image.name = "elsewhere/photo.png"
        database.update_image(image)
    summary = reconstructed(room, given, listener)
    assert summary.num_registered == len(room.names) - 1
    assert listener.messages == [
        "features of 5 photos and matches of 10 pairs are taken from given.db; 1 photos are not in it and are left out,"
        " the first is photo002.png; 1 of its photos are not keyframes, the first is elsewhere/photo.png"
    ]


def test_one_that_is_none_or_of_other_photos_is_refused(room: Room, given: Path, listener: Listener) -> None:
    with pycolmap.Database.open(given) as database:
        camera = database.read_camera(1)
        camera.width = 300
        database.update_camera(camera)
    with pytest.raises(InputError, match=r"photo000.png has 300 x 192 pixels here, expected 256 x 192 like its file"):
        reconstructed(room, given, listener)
    with pycolmap.Database.open(given) as database:
        database.clear_keypoints()
    with pytest.raises(InputError, match=r"given.db: has features of 0 of 6 photos, expected at least 2"):
        reconstructed(room, given, listener)
    given.write_text("no database")
    with pytest.raises(InputError, match=r"given.db: is not a database of COLMAP's"):
        reconstructed(room, given, listener)


def _not_a_number(rows: sqlite3.Connection) -> None:
    (data,) = rows.execute("SELECT data FROM keypoints WHERE image_id = 1").fetchone()
    rows.execute("UPDATE keypoints SET data = ? WHERE image_id = 1", (np.full(len(data) // 4, np.nan, "f4").tobytes(),))


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (
            "UPDATE keypoints SET data = substr(data, 1, 40) WHERE image_id = 1",
            "COLMAP cannot read a row .* and 40 differ",
        ),
        (
            "UPDATE descriptors SET data = substr(data, 1, 40) WHERE image_id = 1",
            "COLMAP cannot read a row .* and 40 differ",
        ),
        ("UPDATE matches SET data = substr(data, 1, 8)", "COLMAP cannot read a row of it"),
        ("UPDATE two_view_geometries SET F = substr(F, 1, 8) WHERE rows > 0", "COLMAP cannot read a row of it"),
        ("UPDATE keypoints SET cols = 1000000 WHERE image_id = 1", "COLMAP cannot read a row of it"),
        ("UPDATE keypoints SET rows = -5 WHERE image_id = 1", "COLMAP cannot read a row of it"),
        (
            "UPDATE descriptors SET rows = rows - 1, data = substr(data, 129)",
            "another number of descriptors than of features",
        ),
        (_not_a_number, "a feature of photo000.png has no finite position"),
        ("UPDATE matches SET rows = 1, data = x'FFFF0000FFFF0000'", "a match of .* is of a feature that is not there"),
        ("UPDATE cameras SET model = 77", "COLMAP cannot read a row of it"),
        ("UPDATE cameras SET params = x''", "COLMAP cannot read a row of it"),
        ("UPDATE cameras SET width = 0", "the camera of photo000.png has impossible parameters"),
    ],
)
def test_a_damaged_row_is_one_line(
    damage: str | Callable[[sqlite3.Connection], None], said: str, room: Room, given: Path, listener: Listener
) -> None:
    with closing(sqlite3.connect(given)) as rows, rows:
        rows.execute(damage) if isinstance(damage, str) else damage(rows)
    with pytest.raises(InputError, match=rf"given\.db: is damaged: .*{said}"):
        reconstructed(room, given, listener)
    assert not given.with_name("out").exists()


@pytest.mark.parametrize("num_bytes", [0, 100, 5000, 40_000])
def test_a_database_that_is_cut_off_is_one_line(num_bytes: int, room: Room, given: Path, listener: Listener) -> None:
    given.write_bytes(given.read_bytes()[:num_bytes])
    with pytest.raises(InputError, match=r"given\.db: (is not a database of COLMAP's|has features of 0 of 6 photos)"):
        reconstructed(room, given, listener)

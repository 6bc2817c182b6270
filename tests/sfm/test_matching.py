"""Pairs of photos are distributed among processes."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from tests.sfm.matches import content_of

from rangesfm.errors import ReconstructionError
from rangesfm.mapper_options import MapperOptions
from rangesfm.progress import Progress
from rangesfm.sfm import matching
from rangesfm.sfm.camera import cameras_of_photos
from rangesfm.sfm.database import create_database
from rangesfm.sfm.features import extract_features, feature_options
from rangesfm.sfm.matching import match_features, matching_options
from rangesfm.sfm.photo_files import Photos, usable_photos
from rangesfm.sfm.steps import Workspace

if TYPE_CHECKING:
    from tests.listener import Listener
    from tests.sfm.conftest import Room

NUM_PHOTOS, NUM_PAIRS = 9, 36


@pytest.fixture(scope="module")
def photos(render_room: Callable[..., Room], tmp_path_factory: pytest.TempPathFactory) -> Photos:
    """Photos, and a database with their features in the same folder."""
    room = render_room(tmp_path_factory.mktemp("walk"), NUM_PHOTOS)
    photos = usable_photos(room.folder, room.names)
    cameras = cameras_of_photos(room.camera, photos)
    create_database(room.folder / "database.db", room.names, cameras.cameras, cameras.of_photo)
    options = feature_options(MapperOptions(features={"sift": {"first_octave": 0, "max_num_features": 250}}))
    extract_features(Workspace(room.folder, Progress()), photos, options)
    return photos


@pytest.fixture
def database(photos: Photos, tmp_path: Path) -> Path:
    """A copy of the database to match in."""
    return Path(shutil.copy(photos.folder / "database.db", tmp_path))


@pytest.fixture
def small_shares(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let even a few pairs make several shares per process."""
    monkeypatch.setattr(matching, "_MIN_NUM_PAIRS", 1)
    monkeypatch.setattr(matching, "_MAX_NUM_PAIRS", 5)


def match(photos: Photos, database: Path, listener: Listener, num_processes: int) -> None:
    options = matching_options(MapperOptions(num_threads=num_processes), NUM_PHOTOS, seed=0)
    space = Workspace(database.parent, listener)
    with space.logged():
        match_features(space, photos, options)


@pytest.mark.usefixtures("small_shares")
def test_the_matches_are_the_same_row_for_row_whatever_the_number_of_processes(
    photos: Photos, tmp_path: Path, listener: Listener
) -> None:
    found = []
    for num_processes in (1, 3):
        (tmp_path / str(num_processes)).mkdir()
        database = Path(shutil.copy(photos.folder / "database.db", tmp_path / str(num_processes)))
        listener.stage(str(num_processes))
        match(photos, database, listener, num_processes)
        found.append(content_of(database))
        assert listener.updates[str(num_processes)][-1] == (NUM_PAIRS, NUM_PAIRS)
        assert sorted(os.listdir(database.parent)) == ["database.db", "mapper.log"]
    assert len([pair for pair in found[0] if isinstance(pair[0], int)]) == NUM_PAIRS
    assert found[1] == found[0]


@pytest.mark.usefixtures("small_shares")
def test_what_was_matched_before_an_interruption_is_kept_and_not_matched_again(
    photos: Photos, database: Path, listener: Listener, monkeypatch: pytest.MonkeyPatch
) -> None:
    class InterruptedError(Exception):
        pass

    class Impatient(type(listener)):  # type: ignore[misc]
        def update(self, num_done: int, num_total: int = 0) -> None:
            if num_done >= NUM_PAIRS // 3:
                raise InterruptedError

    impatient = Impatient()
    with pytest.raises(InterruptedError):
        match(photos, database, impatient, 2)
    num_kept = len(content_of(database)) - NUM_PHOTOS
    assert NUM_PAIRS // 3 <= num_kept < NUM_PAIRS
    asked: list[int] = []
    share_out = matching._shared_out

    def counted(pairs: list[tuple[int, int]], num_processes: int) -> Iterator[list[tuple[int, int]]]:
        asked.append(len(pairs))
        return share_out(pairs, num_processes)

    monkeypatch.setattr(matching, "_shared_out", counted)
    listener.stage("again")
    match(photos, database, listener, 2)
    assert sum(asked) == NUM_PAIRS - num_kept
    assert listener.updates["again"][0] == (num_kept, NUM_PAIRS)


def test_a_process_that_fails_is_told_of_and_ends_the_others(
    photos: Photos, database: Path, listener: Listener, monkeypatch: pytest.MonkeyPatch
) -> None:
    listener.stage("matching")
    monkeypatch.setattr(matching, "match_share", int)
    with pytest.raises(ReconstructionError, match="int\\(\\) takes at most 2 arguments"):
        match(photos, database, listener, 2)
    assert sorted(os.listdir(database.parent)) == ["database.db", "mapper.log"]

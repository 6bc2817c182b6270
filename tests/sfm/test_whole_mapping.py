"""COLMAP's mappers that process all photos at once."""

from __future__ import annotations

import shutil
import sqlite3
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import pycolmap
import pytest
from tests.outputs import unfinished

from rangesfm.errors import InputError, ReconstructionError
from rangesfm.mapper_options import MapperOptions
from rangesfm.sfm.reconstruct import ReconstructionSummary, reconstruct

if TYPE_CHECKING:
    from tests.listener import Listener
    from tests.sfm.conftest import Room

MAPPER = MapperOptions(features={"sift": {"first_octave": 0, "max_num_features": 250}}, num_threads=2)


@pytest.fixture(scope="module")
def done(room: Room, tmp_path_factory: pytest.TempPathFactory) -> ReconstructionSummary:
    """The room, mapped photo by photo."""
    return reconstruct(room.folder, room.names, tmp_path_factory.mktemp("out"), camera=room.camera, mapper=MAPPER)


@pytest.fixture
def output(done: ReconstructionSummary, tmp_path: Path) -> Path:
    """A copy of its output folder."""
    return Path(shutil.copytree(done.log_path.parent, tmp_path / "out"))


@pytest.mark.parametrize(
    ("method", "other"),
    [
        ("global", {"min_num_matches": 14}),
        ("hierarchical", {"incremental_options": {"min_num_matches": 14}}),
    ],
)
def test_holds_every_photo_at_its_place_says_so_and_comes_again(
    room: Room, done: ReconstructionSummary, output: Path, listener: Listener, method: str, other: dict[str, Any]
) -> None:
    before = dump(output / "database.db")
    # with so many threads, two runs would hardly ever end in the same order
    asked = MAPPER.changed(method=method, num_threads=16, reproducible=True)
    summaries = [
        reconstruct(room.folder, room.names, output, camera=room.camera, mapper=mapper, seed=0, progress=listener)
        for mapper in (asked, asked.changed(pipeline=other), asked)
    ]
    assert [list(summary.seconds) for summary in summaries] == [["mapping"]] * 3
    assert "mapping: this mapper shows no progress, and starts anew after an interruption" in listener.messages
    centers = [np.array([_center(summary.models[0], name) for name in room.names]) for summary in summaries]
    world_from_sfm = pycolmap.estimate_sim3d(centers[0], room.centers)
    assert world_from_sfm is not None
    errors = np.linalg.norm([world_from_sfm * center for center in centers[0]] - room.centers, axis=1)
    assert errors.max() < 0.02 * np.linalg.norm(np.ptp(room.centers, axis=0))
    assert np.array_equal(centers[2], centers[0])
    assert dump(output / "database.db") == before
    assert (output / "mapper.log").stat().st_size > (done.log_path).stat().st_size


def dump(database: Path) -> list[str]:
    """Return the database's content, because its bytes count how often it was opened."""
    with closing(sqlite3.connect(database)) as connection:
        return list(connection.iterdump())


def _center(model: pycolmap.Reconstruction, name: str) -> npt.NDArray[np.float64]:
    image = model.find_image_with_name(name)
    assert image is not None
    return np.asarray(image.projection_center())


def test_photos_that_give_no_model_are_told_of(room: Room, output: Path) -> None:
    mapper = MAPPER.changed(method="hierarchical", pipeline={"incremental_options": {"min_num_matches": 10_000}})
    with pytest.raises(ReconstructionError):
        reconstruct(room.folder, room.names, output, camera=room.camera, mapper=mapper)
    assert not (unfinished(output) / "sparse").exists()
    assert (output / "sparse").exists()  # from the run before


@pytest.mark.parametrize(
    ("mapper", "key"),
    [
        (MAPPER.changed(method="global", pipeline={"ba_local_num_images": 9}), "ba_local_num_images"),
        (MAPPER.changed(pipeline={"ranges_in_mapping": True}), "ranges_in_mapping"),
    ],
)
def test_options_that_the_mapper_does_not_have_are_refused(
    room: Room, tmp_path: Path, mapper: MapperOptions, key: str
) -> None:
    with pytest.raises(InputError, match=f"unknown key '{key}' in"):
        reconstruct(room.folder, room.names, tmp_path / "out", camera=room.camera, mapper=mapper)
    assert not (tmp_path / "out").exists()

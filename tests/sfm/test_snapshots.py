"""An interrupted mapping continues from its newest snapshot, and ends as an uninterrupted one."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pycolmap
import pytest
from tests.outputs import names_in, unfinished

from rangesfm.mapper_options import MapperOptions
from rangesfm.progress import SILENT, Progress
from rangesfm.sfm import incremental_mapping
from rangesfm.sfm.incremental_mapping import UnfinishedMapping, size_of, snapshots
from rangesfm.sfm.reconstruct import reconstruct

if TYPE_CHECKING:
    from tests.listener import Listener
    from tests.sfm.conftest import Room

# With several threads, COLMAP would start from whichever pair is ready first.
MAPPER = MapperOptions(features={"sift": {"first_octave": 0, "max_num_features": 250}}, reproducible=True)
NUM_PHOTOS = 13


class Mapping:
    """A room's photos with their matches, which can be mapped repeatedly."""

    def __init__(self, room: Room, output: Path):
        self.room = room
        self.output = output

    def run(self, listener: Progress = SILENT, **pipeline: Any) -> pycolmap.Reconstruction:
        mapper = MapperOptions(features=MAPPER.features, pipeline=pipeline, reproducible=True)
        names, camera = self.room.names, self.room.camera
        found = reconstruct(self.room.folder, names, self.output, camera=camera, mapper=mapper, progress=listener)
        return found.models[0]

    @property
    def snapshots(self) -> Path:
        return unfinished(self.output) / "mapping_snapshot"


@pytest.fixture(scope="module")
def undisturbed(render_room: Callable[..., Room], tmp_path_factory: pytest.TempPathFactory) -> Mapping:
    folder = tmp_path_factory.mktemp("mapping")
    mapping = Mapping(render_room(folder / "room", NUM_PHOTOS), folder / "out")
    mapping.run()
    return mapping


@pytest.fixture
def mapping(undisturbed: Mapping, tmp_path: Path) -> Mapping:
    """A copy that has matches and no model yet."""
    output = shutil.copytree(undisturbed.output, tmp_path / "out")
    shutil.rmtree(output / "sparse")
    return Mapping(undisturbed.room, output)


@pytest.fixture
def interrupted(mapping: Mapping, monkeypatch: pytest.MonkeyPatch) -> Callable[[int], Mapping]:
    """Return a function that interrupts a mapping after this number of photos, each with a snapshot."""

    def interrupt(num_snapshots: int) -> Mapping:
        kept: list[Path] = []

        def keep_and_interrupt(snapshot: Path, path: Path) -> None:
            if len(kept) < num_snapshots:
                keep(snapshot, path)
                kept.append(snapshot)
            if len(kept) == num_snapshots:
                raise RuntimeError("killed")

        keep = incremental_mapping._keep
        with monkeypatch.context() as patched:
            patched.setattr(incremental_mapping, "_keep", keep_and_interrupt)
            patched.setattr(incremental_mapping, "_MIN_INTERVAL_S", 0.0)
            patched.setattr(incremental_mapping, "_INTERVAL_OVER_DURATION", 0.0)
            with pytest.raises(Exception, match="killed"):
                mapping.run()
        return mapping

    return interrupt


def centers(model: pycolmap.Reconstruction) -> dict[str, Any]:
    return {image.name: image.projection_center() for image in model.images.values()}


def assert_as_undisturbed(model: pycolmap.Reconstruction, undisturbed: Mapping) -> None:
    whole = pycolmap.Reconstruction(undisturbed.output / "sparse" / "0")
    expected, found = centers(whole), centers(model)
    assert found.keys() == expected.keys()
    assert max(np.abs(found[name] - expected[name]).max() for name in expected) < 1e-9
    assert model.num_points3D() == whole.num_points3D()


@pytest.mark.parametrize("num_snapshots", [1, 8, 12])
def test_goes_on_from_the_photos_it_had_and_ends_as_if_nothing_had_been(
    num_snapshots: int, interrupted: Callable[[int], Mapping], undisturbed: Mapping, listener: Listener
) -> None:
    mapping = interrupted(num_snapshots)
    (snapshot,) = mapping.snapshots.iterdir()
    num_photos = pycolmap.Reconstruction(snapshot / "0").num_reg_images()
    assert num_photos == 1 + num_snapshots
    assert_as_undisturbed(mapping.run(listener), undisturbed)
    assert f"mapping: continues from {num_photos} photos of an earlier run" in listener.messages
    assert listener.updates["mapping"][-1] == (NUM_PHOTOS, NUM_PHOTOS)
    assert names_in(mapping.output) == ["database.db", "mapper.log", "reconstruct.json", "sparse"]


def test_with_other_options_begins_anew(interrupted: Callable[[int], Mapping], listener: Listener) -> None:
    mapping = interrupted(4)
    mapping.run(listener, min_model_size=4)
    assert listener.messages[-1] == "matching: taken over from an earlier run"
    assert not mapping.snapshots.exists()


def test_with_a_snapshot_that_is_cut_off_begins_anew(
    interrupted: Callable[[int], Mapping], undisturbed: Mapping, listener: Listener
) -> None:
    mapping = interrupted(4)
    (snapshot,) = mapping.snapshots.iterdir()
    points = snapshot / "0" / "points3D.bin"
    points.write_bytes(points.read_bytes()[:-10])
    assert_as_undisturbed(mapping.run(listener), undisturbed)
    assert listener.messages[-1] == "matching: taken over from an earlier run"


def test_a_mapping_that_is_killed_loses_seconds(
    undisturbed: Mapping, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """However slowly the model grows, what the newest snapshot lacks was done in seconds."""
    now_s = 0.0
    monkeypatch.setattr("time.monotonic", lambda: now_s)
    monkeypatch.setattr("time.time_ns", lambda: 1_700_000_000_000_000_000)  # all within one millisecond
    model = pycolmap.Reconstruction(undisturbed.output / "sparse" / "0")
    mapping = UnfinishedMapping((), model, size_of(model))
    (tmp_path / "scratch").mkdir()
    keep = snapshots(tmp_path / "kept", tmp_path / "scratch", min_model_size=10)
    names: list[str] = []
    for now_s in range(60):
        keep(mapping)
        assert not os.listdir(tmp_path / "scratch")
        kept = os.listdir(tmp_path / "kept") if (tmp_path / "kept").exists() else []
        assert len(kept) <= 1
        assert kept or now_s < 10
        names += [name for name in kept if name not in names]
    assert 6 <= len(names) <= 20
    assert names == sorted(names)


def test_snapshots_of_the_user_are_left_alone(mapping: Mapping, tmp_path: Path) -> None:
    theirs = tmp_path / "theirs"
    theirs.mkdir()
    mapping.run(snapshot_path=str(theirs), snapshot_frames_freq=5)
    assert len(os.listdir(theirs)) == 2
    assert not mapping.snapshots.exists()

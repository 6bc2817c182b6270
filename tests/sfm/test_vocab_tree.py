"""Similar photos found by a vocabulary tree, and features that need a neural network."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pycolmap
import pytest

from rangesfm.errors import InputError, OptionError
from rangesfm.mapper_options import MapperOptions
from rangesfm.progress import Progress
from rangesfm.sfm.camera import cameras_of_photos
from rangesfm.sfm.database import create_database
from rangesfm.sfm.features import extract_features, feature_options
from rangesfm.sfm.matching import matching_options
from rangesfm.sfm.pairs import pairing_options, pairs_to_match
from rangesfm.sfm.photo_files import usable_photos
from rangesfm.sfm.photos_alike import pairs_alike
from rangesfm.sfm.steps import Workspace

if TYPE_CHECKING:
    from tests.sfm.conftest import Room

NUM_PHOTOS = 3
DESCRIPTOR_SIZE, EMBEDDING_SIZE = 128, 64


@pytest.fixture(scope="module")
def room(render_room: Callable[..., Room], tmp_path_factory: pytest.TempPathFactory) -> Room:
    """Photos of two rooms, alternating."""
    folder = tmp_path_factory.mktemp("rooms")
    rooms = [render_room(folder, NUM_PHOTOS, seed=seed, prefix=f"room{seed}_") for seed in range(2)]
    return replace(rooms[0], names=tuple(name for pair in zip(*(r.names for r in rooms), strict=True) for name in pair))


@pytest.fixture(scope="module")
def database(room: Room) -> Path:
    """A database with features of the rooms' photos."""
    photos = usable_photos(room.folder, room.names)
    cameras = cameras_of_photos(room.camera, photos)
    path = room.folder / "database.db"
    create_database(path, room.names, cameras.cameras, cameras.of_photo)
    options = feature_options(MapperOptions(features={"sift": {"first_octave": 0, "max_num_features": 400}}))
    extract_features(Workspace(path.parent, Progress()), photos, options)
    return path


@pytest.fixture(scope="module")
def tree(database: Path) -> Path:
    """A vocabulary tree of these photos' features, built with a fixed seed."""
    pycolmap.set_random_seed(0)
    with pycolmap.Database.open(database) as opened:
        found = [opened.read_descriptors(id_).data for id_ in range(1, opened.num_images() + 1)]
    words = pycolmap.FeatureDescriptorsFloat()
    words.type = pycolmap.FeatureExtractorType.SIFT
    words.data = np.concatenate(found).astype(np.float32)
    index = pycolmap.VisualIndex.create(DESCRIPTOR_SIZE, EMBEDDING_SIZE)
    options = pycolmap.VisualIndex.BuildOptions()
    options.num_visual_words, options.num_threads = 1024, 1
    index.build(options, words)
    index.write(database.with_name("tree.bin"))
    return database.with_name("tree.bin")


def test_those_that_look_alike_are_matched(room: Room, database: Path, tree: Path) -> None:
    few = {"num_images": NUM_PHOTOS, "num_threads": 1}
    mapper = MapperOptions(matching="vocabtree", vocab_tree_path=tree, pairing=few)
    pairing = pairing_options(mapper, len(room.names))
    assert not matching_options(mapper, len(room.names), seed=0).is_by_place
    pairs = pairs_to_match(database, usable_photos(room.folder, room.names), pairing)
    ids = range(1, len(room.names) + 1)
    assert pairs == [(first, second) for first in ids for second in ids[first:] if (second - first) % 2 == 0]


def test_photos_of_different_groups_that_look_alike_are_found_by_their_own_words(database: Path) -> None:
    groups, log = [{1, 2}, {3, 4, 5, 6}], database.with_name("words.log")
    own = {photo: group for group in groups for photo in group}
    pairs = pairs_alike(database, own, log, max_num=1, seed=0)
    assert all(first in groups[0] and second in groups[1] for first, second in pairs)
    of_one_room = {(1, 3), (1, 5), (2, 4), (2, 6)}
    # All pairs that show the same are proposed. Which words the vocabulary has depends on the processor, and with some
    # of them one photo proposes a wrong pair; whether pairs match is tested later.
    assert of_one_room <= set(pairs)
    assert len(set(pairs) - of_one_room) <= 1
    assert pairs_alike(database, own, log, max_num=1, seed=0) == pairs


def test_a_file_that_is_no_tree_is_one_line(room: Room, database: Path, tmp_path: Path) -> None:
    (tmp_path / "tree.bin").write_text("no tree")
    pairing = pairing_options(MapperOptions(matching="vocabtree", vocab_tree_path=tmp_path / "tree.bin"), 6)
    with pytest.raises(InputError, match=r"tree.bin: is not a vocabulary tree"):
        pairs_to_match(database, usable_photos(room.folder, room.names), pairing)


@pytest.mark.parametrize("options", [{"matching": "vocabtree"}, {"pairing": {"loop_detection": True}}])
def test_without_a_tree_nothing_is_downloaded(options: dict[str, Any]) -> None:
    with pytest.raises(OptionError, match="vocab_tree_path is not given, expected COLMAP's vocabulary tree"):
        MapperOptions(**options)


@pytest.mark.skipif("aliked" in pycolmap.FeatureExtractionOptions().todict(), reason="this pycolmap has networks")
def test_learned_features_are_refused_where_pycolmap_runs_no_networks() -> None:
    with pytest.raises(OptionError, match=r"features\] type is 'ALIKED_N16ROT', expected SIFT: .* without ONNX"):
        feature_options(MapperOptions(features={"type": "ALIKED_N16ROT"}))
    with pytest.raises(OptionError, match=r"matcher\] type is 'SIFT_LIGHTGLUE', expected SIFT"):
        matching_options(MapperOptions(matcher={"type": "SIFT_LIGHTGLUE"}), 6, seed=0)

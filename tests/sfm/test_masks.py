"""Masks: features are found only where a mask is not black."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pycolmap
import pytest
from PIL import Image

from rangesfm.errors import InputError, OptionError
from rangesfm.mapper_options import MapperOptions
from rangesfm.options import CameraOptions
from rangesfm.progress import SILENT
from rangesfm.sfm.photo_matching import photo_matching
from rangesfm.sfm.rigs import NO_RIGS
from rangesfm.sfm.unpublished import UnpublishedReconstruction
from rangesfm.util.files.output_folder import sole_writer

if TYPE_CHECKING:
    from tests.sfm.conftest import Room

NUM_PHOTOS = 2


@pytest.fixture
def masks(room: Room, tmp_path: Path) -> Path:
    """Masks that keep the right half of each photo."""
    for name in room.names[:NUM_PHOTOS]:
        with Image.open(room.folder / name) as photo:
            white = np.full((photo.height, photo.width), 255, dtype=np.uint8)
        white[:, : white.shape[1] // 2] = 0
        path = tmp_path / "masks" / f"{name}.png"
        path.parent.mkdir(exist_ok=True)
        Image.fromarray(white).save(path)
    return tmp_path / "masks"


def leftmost_features(room: Room, masks: Path) -> list[float]:
    """Return the leftmost feature of each photo, as a share of its width."""
    mapper = MapperOptions(mask_path=masks)
    with (
        sole_writer(masks.with_name("out")) as output,
        UnpublishedReconstruction(output, SILENT, restart=True) as new,
        photo_matching(room.folder, room.names[:NUM_PHOTOS], CameraOptions(), mapper, NO_RIGS, 0, new) as matching,
    ):
        space = new.begin(matching.plan, with_loops_closed=False)
        with space.logged():
            matching.fill(space)
        with pycolmap.Database.open(space.database) as database:
            return [float(database.read_keypoints(id_)[:, 0].min() / 256) for id_ in range(1, NUM_PHOTOS + 1)]


def test_no_feature_is_where_a_mask_is_black_and_other_masks_give_others(room: Room, masks: Path) -> None:
    assert min(leftmost_features(room, masks)) > 0.5
    white = masks / f"{room.names[0]}.png"
    Image.new("L", (256, 192), 255).save(masks / room.names[0])  # COLMAP accepts this name in place of x.png.png
    white.unlink()
    first, second = leftmost_features(room, masks)
    assert first < 0.2
    assert second > 0.5


def test_a_missing_mask_or_one_of_another_size_is_one_line(room: Room, masks: Path) -> None:
    first, second = (masks / f"{name}.png" for name in room.names[:NUM_PHOTOS])
    Image.new("L", (128, 96)).save(first)
    with pytest.raises(InputError, match=r"photo000.png.png: has 128 x 96 pixels, expected 256 x 192 like the photo"):
        leftmost_features(room, masks)
    first.write_text("no image")
    with pytest.raises(InputError, match=r"photo000.png.png: cannot be read as an image, expected 256 x 192"):
        leftmost_features(room, masks)
    second.unlink()
    with pytest.raises(
        InputError, match=r"1 of 2 photos have no mask in this folder, .* photo001.png: expected photo001.png.png"
    ):
        leftmost_features(room, masks)
    shutil.rmtree(masks)
    with pytest.raises(InputError, match=r"masks: no such folder, expected a folder of masks"):
        leftmost_features(room, masks)
    assert not masks.with_name("out").exists()


def test_masks_have_no_say_in_features_of_a_database() -> None:
    with pytest.raises(OptionError, match="mask_path is given beside database_path"):
        MapperOptions(mask_path=Path("masks"), database_path=Path("database.db"))

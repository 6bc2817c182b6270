"""The pairs of photos that are matched."""

from __future__ import annotations

from pathlib import Path

import pycolmap
import pytest
from PIL import Image
from tests.outputs import unfinished

from rangesfm.errors import InputError, ReconstructionError
from rangesfm.mapper_options import MapperOptions
from rangesfm.options import CameraOptions
from rangesfm.sfm.pairs import pairing_options, pairs_to_match, read_pairs
from rangesfm.sfm.photo_files import Photos
from rangesfm.sfm.reconstruct import reconstruct

NAMES = tuple(f"{index}.png" for index in range(4))
PHOTOS = Photos(Path(), NAMES, ((64, 48),) * 4, {})
_GPS = 0x8825


def listed(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "pairs.txt"
    path.write_text(text)
    return path


def test_a_list_names_them_in_any_order_and_may_name_photos_that_are_no_keyframes(tmp_path: Path) -> None:
    path = listed(tmp_path, "# first second\n2.png 0.png\n\n0.png\t2.png\n1.png 3.png\n1.png other.png\n")
    pairing = pairing_options(MapperOptions(pairs=path), len(NAMES))
    assert pairs_to_match(tmp_path / "no database", PHOTOS, pairing) == [(1, 3), (2, 4)]


def test_names_with_blanks_have_a_tab_between_them(tmp_path: Path) -> None:
    assert read_pairs(listed(tmp_path, "my 1.png\tmy 2.png\n")) == (("my 1.png", "my 2.png"),)


@pytest.mark.parametrize("line", ["a.png", "a.png b.png c.png", "a.png a.png"])
def test_a_line_that_is_no_pair_is_named(tmp_path: Path, line: str) -> None:
    with pytest.raises(InputError, match=f"pairs.txt:2: '{line}', expected the names of two photos"):
        read_pairs(listed(tmp_path, f"a.png b.png\n{line}\n"))


def test_a_list_of_no_keyframes_and_one_that_cannot_be_read_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ReconstructionError, match=r"none of 1 pairs names two keyframes, .* such as 0\.png"):
        pairs_to_match(tmp_path / "no database", PHOTOS, (("a.png", "b.png"),))
    with pytest.raises(InputError, match=r"pairs\.txt: no such file"):
        read_pairs(tmp_path / "pairs.txt")


def test_neighbours_by_exif_position_are_those_within_reach(tmp_path: Path) -> None:
    for index, name in enumerate(f"{index}.jpg" for index in range(4)):
        exif = Image.Exif()
        metres_north = (0, 40, 500, 530)[index]
        seconds = metres_north / 1852 * 60
        exif[_GPS] = {1: "N", 2: (47.0, 0.0, seconds), 3: "E", 4: (8.0, 0.0, 0.0), 5: b"\0", 6: 400.0}
        Image.effect_noise((256, 192), 120).save(tmp_path / name, exif=exif)
    names = [f"{index}.jpg" for index in range(4)]
    mapper = MapperOptions(matching="spatial", pairing={"max_distance": 100.0})
    with pytest.raises(ReconstructionError, match="no two of 4 photos match"):
        reconstruct(tmp_path, names, tmp_path / "out", camera=CameraOptions(), mapper=mapper)
    with pycolmap.Database.open(unfinished(tmp_path / "out") / "database.db") as database:
        pairs = [(first, second) for first in range(1, 5) for second in range(first + 1, 5)]
        assert [pair for pair in pairs if database.exists_two_view_geometry(*pair)] == [(1, 2), (3, 4)]

"""Positions in the EXIF data of photos are read with what these say of their accuracy."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from rangesfm.errors import InputError
from rangesfm.sfm.exif_positions import read_exif_positions
from rangesfm.survey.discovery.understood import understand
from rangesfm.util.geometry.moments import ByPhoto

GPS = 0x8825
PLACE = {1: "N", 2: (47.0, 30.0, 36.0), 3: "W", 4: (8.0, 0.0, 0.0), 5: b"\0", 6: 400.0}


def write_photo(path: Path, tags: dict[int, Any], **data: Any) -> None:
    exif = Image.Exif()
    exif[GPS] = tags
    path.parent.mkdir(exist_ok=True)
    Image.new("L", (16, 12)).save(path, exif=exif, **data)


@pytest.mark.parametrize(
    ("more", "xmp", "stddev_m"),
    [
        ({}, b"", (3.0, 3.0, 4.5)),
        ({11: 2.0}, b"", (6.0, 6.0, 9.0)),
        ({11: 2.0, 31: 1.51}, b"", (1.0, 1.0, 1.5)),
        ({11: 0.0, 31: 0.0}, b"", (3.0, 3.0, 4.5)),
        (
            {31: 1.51},
            b'<x drone-dji:RtkStdLon="0.01" drone-dji:RtkStdLat="0.02" drone-dji:RtkStdHgt="0.03"/>',
            (0.01, 0.02, 0.03),
        ),
    ],
)
def test_the_accuracy_is_that_of_rtk_or_the_stated_error_or_by_the_dilution(
    tmp_path: Path, more: dict[int, Any], xmp: bytes, stddev_m: tuple[float, ...]
) -> None:
    write_photo(tmp_path / "photos" / "a.jpg", PLACE | more, **({"xmp": xmp} if xmp else {}))
    found = read_exif_positions(tmp_path / "photos")
    assert (found.moments, found.crs) == (ByPhoto(("a.jpg",)), "EPSG:4979")
    np.testing.assert_allclose(found.position_m, [[-8.0, 47.51, 400.0]])
    np.testing.assert_allclose(np.sqrt(np.diag(found.covariance_m2[0])), stddev_m)


def test_photos_without_a_fix_or_an_altitude_are_left_out(tmp_path: Path) -> None:
    photos = tmp_path / "photos"
    for name, tags in {
        "a.jpg": PLACE,
        "flat.jpg": {tag: value for tag, value in PLACE.items() if tag < 5},
        "nowhere.jpg": PLACE | {2: (0.0, 0.0, 0.0), 4: (0.0, 0.0, 0.0)},
        "void.jpg": PLACE | {9: "V"},
        "without.jpg": {},
    }.items():
        write_photo(photos / name, tags)
    found = read_exif_positions(photos)
    assert found.moments.image_name == ("a.jpg",)
    assert found.notes == ("photos: 1 of 2 EXIF positions have no altitude and are left out",)
    (photos / "a.jpg").unlink()
    with pytest.raises(InputError, match="no photo in it has an EXIF position with an altitude"):
        read_exif_positions(photos)


def test_they_are_taken_where_nothing_else_is_in_metres(tmp_path: Path) -> None:
    photos = tmp_path / "photos"
    for k in range(3):
        write_photo(photos / f"{k}.jpg", PLACE)
    values, notes = understand([tmp_path], {})
    assert values["positions.path"] == photos
    assert "the positions are those in the EXIF data of 3 photos" in notes
    (tmp_path / "distances.csv").write_text("from,to,distance_m\na,b,1.5\n")
    values, notes = understand([tmp_path], {})
    assert "positions.path" not in values
    assert f"3 photos have positions in their EXIF data: --positions {photos} uses them, too" in notes

"""Photos of any size and file format are used, or left out with a reason."""

from __future__ import annotations

import os
import struct
import warnings
import zlib
from pathlib import Path

import pytest
from PIL import Image

from rangesfm.sfm.photo_files import MAX_PIXELS, exif_position, exif_tags, image_size, usable_photos

SIZE = (20_000, 10_000)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Two photos of 200 megapixels whose pixels are all black."""
    photo = Image.new("1", SIZE)
    for name in ("a.png", "b.png"):
        photo.save(tmp_path / name)
    return tmp_path


def write_claim(path: Path, width: int, height: int) -> None:
    """Write a PNG file that only claims its size."""
    header = b"IHDR" + struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    chunk = struct.pack(">I", 13) + header + struct.pack(">I", zlib.crc32(header))
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + chunk + struct.pack(">I", 0) + b"IDAT")


def test_photos_of_200_megapixels_are_used_and_the_limit_of_other_users_of_pillow_stays(folder: Path) -> None:
    limit = Image.MAX_IMAGE_PIXELS
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        photos = usable_photos(folder, ["a.png", "b.png"])
        assert exif_tags(folder / "a.png") == {}
        assert exif_position(folder / "a.png") is None
    assert (photos.names, photos.sizes, photos.left_out) == (("a.png", "b.png"), (SIZE, SIZE), {})
    assert limit == Image.MAX_IMAGE_PIXELS


def test_a_photo_that_claims_more_pixels_than_can_be_used_is_left_out_with_the_reason(folder: Path) -> None:
    write_claim(folder / "c.png", 60_000, 60_000)
    write_claim(folder / "d.png", MAX_PIXELS // 10_000, 10_000)
    photos = usable_photos(folder, ["a.png", "c.png", "d.png"])
    assert photos.names == ("a.png", "d.png")
    assert photos.left_out == {"c.png": "has 3600 megapixels, expected at most 1000"}
    assert image_size(folder / "c.png") is None


def test_a_photo_of_a_phone_that_is_not_what_its_name_says_is_left_out_with_the_reason(folder: Path) -> None:
    (folder / "IMG_7.jpg").write_bytes(b"\0\0\0\x18ftypheic\0\0\0\0mif1heic" + bytes(200))
    photos = usable_photos(folder, ["a.png", "b.png", "IMG_7.jpg"])
    assert photos.left_out == {"IMG_7.jpg": "is a HEIC photo, whatever its name says: convert it to JPEG"}


def test_a_photo_that_is_a_fifo_is_left_out_and_waited_for_by_nobody(folder: Path) -> None:
    os.mkfifo(folder / "c.png")
    photos = usable_photos(folder, ["a.png", "b.png", "c.png"])
    assert photos.left_out == {"c.png": "cannot be read as an image"}
    assert exif_tags(folder / "c.png") == {}
    assert exif_position(folder / "c.png") is None

"""Names in files mean photos by other folders, endings and capitals, and never a photo that they may not mean."""

from __future__ import annotations

import pytest

from rangesfm.util.files.photo_names import photos_meant, rows_of_photos, told_unknown

PHOTOS = ["DJI_0200.JPG", "DJI_0201.JPG"]


@pytest.mark.parametrize(
    ("listed", "photos"),
    [
        (["DJI_0200.JPG", "DJI_0201.JPG"], PHOTOS),
        (["dji_0200.jpg", "Dji_0201.JPG"], PHOTOS),
        (["DJI_0200", "dji_0201"], PHOTOS),
        (["DJI_0200.DNG", "dji_0201.tif"], PHOTOS),
        (["images/DJI_0200.JPG", "images/DJI_0201.JPG"], PHOTOS),
        (["C:\\flight\\dji_0200.jpg", "C:\\flight\\dji_0201.jpg"], PHOTOS),
        (["DJI_0200.JPG", "DJI_0201.JPG"], ["100MEDIA/DJI_0200.JPG", "101MEDIA/DJI_0201.JPG"]),
        (["flight/100MEDIA/DJI_0200", "flight/101MEDIA/DJI_0201"], ["100MEDIA/DJI_0200.JPG", "101MEDIA/DJI_0201.JPG"]),
        (["1773086760.263", "1773086761.263"], ["1773086760.263.jpg", "1773086761.263.jpg"]),
    ],
)
def test_name_means_the_photo_by_other_folders_endings_and_capitals(listed: list[str], photos: list[str]) -> None:
    assert photos_meant(listed, photos) == photos
    assert rows_of_photos(listed, photos).tolist() == [0, 1]


def test_one_photo_may_be_spelt_in_two_ways() -> None:
    assert photos_meant(["dji_0200.jpg", "DJI_0200.JPG"], PHOTOS) == ["DJI_0200.JPG", "DJI_0200.JPG"]


@pytest.mark.parametrize(
    ("listed", "photos"),
    [
        (["0001.jpg", "0002.jpg"], ["left/0001.jpg", "right/0001.jpg", "left/0002.jpg"]),  # which camera?
        (["left/0001.jpg", "right/0001.jpg"], ["0001.jpg"]),
        (["right/0001.jpg"], ["left/0001.jpg"]),
        (["img_1.jpg"], ["IMG_1.jpg", "Img_1.jpg"]),
        (["1.5"], ["1.6.jpg"]),
        (["IMG_1"], ["IMG_1.jpg", "IMG_1.png"]),
        (["", "images/"], PHOTOS),
    ],
)
def test_name_that_may_be_another_photo_means_none(listed: list[str], photos: list[str]) -> None:
    assert photos_meant(listed, photos) == listed
    assert set(rows_of_photos(listed, photos).tolist()) == {-1}


def test_raw_photo_beside_its_jpeg_means_none() -> None:
    assert photos_meant(["IMG_1.DNG", "IMG_1.JPG"], ["IMG_1.JPG"]) == ["IMG_1.DNG", "IMG_1.JPG"]


def test_user_is_told_of_names_of_no_photo() -> None:
    listed = ["dji_0200.jpg", "dji_0223.jpg", "dji_0224.jpg"]
    assert [*told_unknown("marks in m.csv", listed, PHOTOS, "the map")] == [
        "2 of 3 marks in m.csv are of photos that are not in the map, such as dji_0223.jpg; the map has DJI_0200.JPG"
    ]
    assert not [*told_unknown("marks in m.csv", listed[:1], PHOTOS, "the map")]

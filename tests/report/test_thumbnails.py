"""Small copies of photos for a page that is handed on."""

from __future__ import annotations

from pathlib import Path

from PIL import Image

from rangesfm.report.scene import thumbnails


def test_a_name_from_a_file_fetches_nothing_from_outside_the_folder(tmp_path: Path) -> None:
    folder = tmp_path / "photos"
    (folder / "cam0").mkdir(parents=True)
    for path in (tmp_path / "private.png", folder / "cam0" / "in.png"):
        Image.new("L", (64, 48)).save(path)
    names = ["cam0/in.png", "../private.png", str(tmp_path / "private.png"), "cam0/../../private.png"]
    assert list(thumbnails(folder, names)) == ["cam0/in.png"]


def test_what_is_no_photo_is_left_out(tmp_path: Path) -> None:
    (tmp_path / "a.jpg").write_bytes(b"\xff\xd8\xff\xe0 no photo")
    assert thumbnails(tmp_path, ["a.jpg", "missing.jpg"]) == {}

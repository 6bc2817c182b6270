"""Hashes of what a result was made from."""

from __future__ import annotations

from pathlib import Path

from rangesfm.config import Survey
from rangesfm.input_hashes import input_hashes


def photos(folder: Path, **sizes: int) -> Path:
    folder.mkdir()
    for name, size in sizes.items():
        (folder / f"{name}.jpg").write_bytes(b"x" * size)
    return folder


def test_a_folder_of_photos_is_known_by_names_and_sizes(tmp_path: Path) -> None:
    folders = [
        photos(tmp_path / "one", a=3, b=5),
        photos(tmp_path / "same", a=3, b=5),
        photos(tmp_path / "renamed", a=3, c=5),
        photos(tmp_path / "grown", a=3, b=6),
    ]
    one, same, renamed, grown = (input_hashes(Survey(images_path=folder))[0] for folder in folders)
    assert one["sha256"] == same["sha256"]
    assert len({entry["sha256"] for entry in (one, renamed, grown)}) == 3
    assert one["hashed"] == "names and sizes of 2 files"
    assert one["bytes"] == 8


def test_what_is_not_there_is_not_named(tmp_path: Path) -> None:
    assert input_hashes(Survey(images_path=tmp_path / "gone", anchors_path=tmp_path / "gone.csv")) == []

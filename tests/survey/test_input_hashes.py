"""Hashes of the inputs from which a result was made."""

from __future__ import annotations

import hashlib
from pathlib import Path

from rangesfm.options import AnchorOptions, ImageOptions, RangesOptions, ReportOptions, ScaleOptions
from rangesfm.survey.settings import Survey
from rangesfm.survey.survey_reader import input_hashes


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
    one, same, renamed, grown = (input_hashes(Survey(images=ImageOptions(path=folder)))[0] for folder in folders)
    assert one["sha256"] == same["sha256"]
    assert len({entry["sha256"] for entry in (one, renamed, grown)}) == 3
    assert one["hashed"] == "names and sizes of 2 files"
    assert one["bytes"] == 8


def test_every_file_that_a_survey_names_is_listed(tmp_path: Path) -> None:
    names = ("uwb.csv", "curve.csv", "anchors.csv", "images.csv", "taped.csv", "marks.csv", "truth.csv")
    for name in names:
        (tmp_path / name).write_text(name)
    ranges, curve, anchors, times, distances, markers, reference = (tmp_path / name for name in names)
    survey = Survey(
        ranges=RangesOptions(path=ranges, error_curve=curve),
        anchors=AnchorOptions(path=anchors),
        images=ImageOptions(times=times),
        scale=ScaleOptions(distances=distances, markers=markers),
        report=ReportOptions(reference=reference),
    )
    listed = {entry["path"]: entry["sha256"] for entry in input_hashes(survey)}
    assert listed == {str(tmp_path / name): hashlib.sha256(name.encode()).hexdigest() for name in names}


def test_what_is_not_there_is_not_named(tmp_path: Path) -> None:
    gone = Survey(images=ImageOptions(path=tmp_path / "gone"), anchors=AnchorOptions(path=tmp_path / "gone.csv"))
    assert input_hashes(gone) == []

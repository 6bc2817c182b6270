"""Paths that a result stores, and which of them are trusted on another machine."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from rangesfm.result.places import input_beside, is_within, path_in, recorded_path
from rangesfm.result.result_folder import read_result_folder

if TYPE_CHECKING:
    from tests.conftest import Command, PhotoRun, WalkedSurvey


@pytest.mark.parametrize(
    ("path", "folder", "recorded"),
    [
        ("/home/me/site/images", "/home/me/site/out", "../images"),
        ("/home/me/photos", "/home/me/site/results/monday", "../../../photos"),
        ("/home/me/site/out", "/home/me/site/out", "."),
        ("/home/me/site/out/photos", "/home/me/site/out/", "photos"),
        ("/media/disk/photos", "/home/me/out", "/media/disk/photos"),
    ],
)
def test_paths_are_relative_to_the_result_while_both_are_in_one_folder(path: str, folder: str, recorded: str) -> None:
    assert recorded_path(Path(path), Path(folder)) == recorded
    assert path_in(Path(folder), recorded) == Path(path)


def test_whole_paths_of_earlier_versions_are_read(tmp_path: Path) -> None:
    assert path_in(tmp_path / "out", str(tmp_path / "uwb.csv")) == tmp_path / "uwb.csv"


@pytest.fixture
def site(tmp_path: Path) -> Path:
    """A folder with a result, photos beside it and in it, and links to photos elsewhere."""
    for name in ("site/out/photos", "site/images", "private"):
        (tmp_path / name).mkdir(parents=True)
    (tmp_path / "site" / "linked").symlink_to(tmp_path / "private")
    (tmp_path / "site" / "circle").symlink_to(tmp_path / "site" / "circle")
    return tmp_path / "site"


@pytest.mark.parametrize("recorded", ["../images", "photos", "..", "."])
def test_inputs_beside_the_result_are_its_own(recorded: str, site: Path) -> None:
    assert input_beside(site / "out", recorded) == path_in(site / "out", recorded)
    whole = str(path_in(site / "out", recorded))
    assert input_beside(site / "out", whole) == Path(whole)


@pytest.mark.parametrize(
    "recorded", ["../../private", "../linked", "../circle", "../..", "/", "../images/../../private"]
)
def test_photos_elsewhere_are_not(recorded: str, site: Path) -> None:
    assert input_beside(site / "out", recorded) is None
    assert input_beside(site / "out", str(path_in(site / "out", recorded))) is None


def test_a_home_folder_is_no_survey(site: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(site))
    assert input_beside(site / "out", "../images") is None
    assert input_beside(site / "out", "photos") == site / "out" / "photos"


def test_links_lead_out_and_names_that_no_file_has_lead_nowhere(site: Path) -> None:
    assert is_within(site / "images" / "a.jpg", site / "images")
    assert not is_within(site / "linked" / "a.jpg", site)
    assert not is_within(site / "a\0.jpg", site)


def test_neither_a_result_nor_its_page_says_where_they_were_made(
    own_survey: WalkedSurvey, rangesfm_command: Command
) -> None:
    folder = own_survey.folder
    flags = (*own_survey.flags, "--anchors", "anchors.csv", "--max_relative_stddev", "0.1", "--output_path", "out")
    rangesfm_command("scale", *flags, "--reference", "reference.csv", cwd=folder)
    for path in (folder / "out").rglob("*"):
        if path.is_file():
            assert bytes(folder.parent) not in path.read_bytes(), path
    result = read_result_folder(folder / "out")
    settings = result.summary.settings.to_json()
    assert (settings["images"]["model"], settings["ranges"]["path"]) == ("../sparse/0", "../uwb.csv")
    assert result.anchors_path == folder / "anchors.csv"
    assert {"../uwb.csv", "../anchors.csv", "../reference.csv"} <= {entry.path for entry in result.summary.inputs}


def test_nor_do_those_of_a_run_on_photos(photo_run: PhotoRun) -> None:
    names = ("result.json", "report.html", "ranges.csv", "reconstruct.json", "mapper.log")
    for name in names:
        assert bytes(photo_run.survey.folder.parent) not in (photo_run.output_path / name).read_bytes(), name

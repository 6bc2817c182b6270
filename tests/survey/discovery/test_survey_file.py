"""A survey file that was written reads back as the same survey."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from rangesfm.errors import InputError
from rangesfm.survey.discovery.survey_file import survey_text
from rangesfm.survey.settings import SURVEY_TABLES
from rangesfm.survey.survey_reader import read_survey, survey_from_tables


def read_back(values: dict[str, Any], folder: Path) -> None:
    path = folder / "survey.toml"
    path.write_text(survey_text({**values, "output.path": folder / "out"}, folder), encoding="utf-8")
    assert read_survey(path) == survey_from_tables({}, folder, {**values, "output.path": folder / "out"})


def test_every_kind_of_value_is_read_back(tmp_path: Path) -> None:
    folder = tmp_path / 'a "quoted" \\ näme'
    folder.mkdir()
    (folder / "uwb.csv").touch()
    (tmp_path / "anchors.csv").touch()
    values = {
        "images.path": folder,
        "images.every_nth": 3,
        "camera.params": (377.25, 1e-7, 3),
        "camera.refine_intrinsics": False,
        "ranges.path": folder / "uwb.csv",
        "ranges.columns": {"range:A 1": 'd"1', "timestamp": "t"},
        "anchors.path": tmp_path / "anchors.csv",
        "anchors.use": ["1", "ä"],
        "tag.lever_arms_m": {"0xA": (0.0, 0.1, -0.2)},
        "mapper.features": {"max_image_size": 1200, "sift": {"num_octaves": 3}},
    }
    read_back(values, folder)


def test_what_is_not_known_stands_there_as_a_comment(tmp_path: Path) -> None:
    text = survey_text({"images.path": tmp_path / "images"}, tmp_path)
    assert '\npath = "images"\n' in text
    assert '\n# path = "uwb.csv"\n' in text
    assert "\n# tag_in_cam_m = [0.0, 0.0, 0.0]\n" in text
    read_back({}, tmp_path)


def test_each_key_is_explained_by_its_own_meaning(tmp_path: Path) -> None:
    text = survey_text({"ranges.check_share": 0.1}, tmp_path)
    meaning = SURVEY_TABLES["ranges"].keys()["check_share"].meaning
    assert meaning in " ".join(text.replace("\n# ", " ").split())


def test_a_name_that_no_such_file_can_hold_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="rename it"):
        survey_text({"ranges.path": tmp_path / "uwb\udcff.csv"}, tmp_path)

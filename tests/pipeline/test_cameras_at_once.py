"""Surveys of several cameras that took photos at the same times."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

if TYPE_CHECKING:
    from tests.conftest import Command, WalkedSurvey


@pytest.fixture(scope="module")
def joined(walked_survey: WalkedSurvey, rangesfm_command: Command, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with two results, and ``site``, in which they are joined by anchors, one of which is a metre off."""
    folder = tmp_path_factory.mktemp("cameras")
    flags = (*walked_survey.flags, "--anchors", "anchors.csv", "--max_relative_stddev", "0.1", "--quiet")
    rangesfm_command("scale", *flags, "--output_path", folder / "left", cwd=walked_survey.folder)
    shutil.copytree(folder / "left", folder / "right")
    header, *rows = (folder / "right" / "ranges.csv").read_text().splitlines()
    column, rng = header.split(",").index("range_m"), np.random.default_rng(7)
    of_its_own_tag = [row.split(",") for row in rows]
    for row, noise_m in zip(of_its_own_tag, rng.normal(0, 0.02, len(rows)), strict=True):
        row[column] = f"{float(row[column]) + noise_m:.6f}"
    (folder / "right" / "ranges.csv").write_text("\n".join([header, *map(",".join, of_its_own_tag)]) + "\n")
    anchors = (walked_survey.folder / "anchors.csv").read_text()
    assert "A1,1006.0," in anchors
    (folder / "anchors.csv").write_text(anchors.replace("A1,1006.0,", "A1,1007.0,"))
    rangesfm_command("join", "left", "right", "--anchors", "anchors.csv", "--output_path", "site", cwd=folder)
    return folder


def test_cameras_with_equal_times_are_joined_also_where_the_scale_is_doubtful(joined: Path) -> None:
    result = json.loads((joined / "site" / "result.json").read_text())
    assert result["scale"]["verdict"] == "doubtful"
    assert [model["joined"] for model in result["models"]] == [True, True]
    assert (joined / "site" / "report.html").is_file()


@pytest.mark.parametrize("command", [("plan", "--from", "site"), ("join", "site", "left", "--output_path", "more")])
def test_what_takes_a_map_for_one_path_says_that_it_is_not(
    command: tuple[str, ...], joined: Path, rangesfm_command: Command
) -> None:
    said = rangesfm_command(*command, cwd=joined, status=2).stderr
    line = "rangesfm: error: site: two of its photos have the same time, as in a map of several cameras, expected "
    assert said.splitlines()[-1].startswith(line)
    assert not (joined / "more").exists()

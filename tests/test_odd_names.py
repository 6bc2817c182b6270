"""Photos and anchors of any name pass through all commands: names like comments, formulas, markup and templates."""

from __future__ import annotations

import csv
import dataclasses
import json
import shutil
from pathlib import Path
from typing import TYPE_CHECKING

import pycolmap
import pytest

from rangesfm.result.result_tables import CenterCovariances, PhotoTimes, RangesAsUsed
from rangesfm.util.files.text_tables import write_table

if TYPE_CHECKING:
    from tests.conftest import Command, WalkedSurvey

ODD = ("#", "# ", "=1+1 ", "-@", "'", "<b>&amp;", '"q"', "{{7*7}}", "\N{LEFT-TO-RIGHT MARK}a", "${HOME}", "%s")


@pytest.fixture(params=[ODD, ("#",)], ids=["all kinds", "all as comments"])
def odd_survey(request: pytest.FixtureRequest, own_survey: WalkedSurvey) -> WalkedSurvey:
    """The survey with other names for its photos and for its first anchor."""
    prefixes = request.param
    name_of = {name: f"{prefixes[k % len(prefixes)]}{name}" for k, name in enumerate(own_survey.image_names)}
    folder = own_survey.folder
    model = pycolmap.Reconstruction(folder / "sparse" / "0")
    for image in model.images.values():
        image.name = name_of[image.name]
    model.write(folder / "sparse" / "0")
    with (folder / "images.csv").open(newline="") as file:
        rows = [(name_of[row["image_name"]], row["timestamp_s"]) for row in csv.DictReader(file)]
    (folder / "images.csv").unlink()  # the tool replaces no file that it did not write
    write_table(folder / "images.csv", ("image_name", "timestamp_s"), rows)
    for name in ("uwb.csv", "anchors.csv"):
        with (folder / name).open(newline="") as file:
            header, *table = csv.reader(file)
        renamed = [[f"{prefixes[0]}A1" if cell == "A1" else cell for cell in row] for row in table]
        (folder / name).unlink()
        write_table(folder / name, header, renamed)
    return dataclasses.replace(own_survey, image_names=tuple(name_of.values()))


def test_every_command_finds_photos_and_anchors_of_any_name(
    odd_survey: WalkedSurvey, rangesfm_command: Command
) -> None:
    folder, names = odd_survey.folder, odd_survey.image_names
    out = folder / "out"
    (folder / "quick.toml").write_text("[scale]\nmax_relative_stddev = 0.1\n")
    flags = ("quick.toml", *odd_survey.flags, "--anchors", "anchors.csv", "--output_path", "out")
    rangesfm_command("refine", *flags, cwd=folder)
    times, covariances, ranges = PhotoTimes.read(out), CenterCovariances.read(out), RangesAsUsed.read(out)
    assert times is not None
    assert covariances is not None
    assert ranges is not None
    assert times.image_name == names
    assert set(covariances.image_name) == set(names)
    assert set(ranges.keyframe_before) - {""} <= set(names)
    assert set(ranges.anchor_id) == set(json.loads((out / "result.json").read_text())["anchors"])
    rangesfm_command("export", "out", "--formats", "tum", "--output_path", "exported", cwd=folder)
    poses = [line for line in (folder / "exported" / "trajectory.tum").read_text().splitlines() if line[0] != "#"]
    assert len(poses) == len(names)
    rangesfm_command("report", "out", cwd=folder)
    rangesfm_command("compare", "out", cwd=folder)
    rangesfm_command("plan", "--from", "out", "--output_path", "planned", cwd=folder)
    again = shutil.copytree(out, folder / "again")
    rangesfm_command("compare", "out", again, cwd=folder)


@pytest.mark.parametrize(
    "command",
    [("report", "out"), ("export", "out", "--formats", "tum"), ("plan", "--from", "out"), ("compare", "out", "again")],
)
def test_a_result_whose_times_are_of_no_photo_is_refused(
    command: tuple[str, ...], scaled_result: Path, rangesfm_command: Command
) -> None:
    said = rangesfm_command(*command, cwd=scaled_result, status=2).stderr
    assert said.endswith("out: none of the model's photos has a time in images.csv\n")


@pytest.fixture(scope="module")
def scaled_result(
    walked_survey: WalkedSurvey, rangesfm_command: Command, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """A folder with two copies of a result; in one of them, rows of images.csv are comments."""
    folder = tmp_path_factory.mktemp("comments")
    flags = ("--max_relative_stddev", "0.1", *walked_survey.flags, "--anchors", "anchors.csv")
    rangesfm_command("scale", *flags, "--output_path", folder / "out", "--quiet", cwd=walked_survey.folder)
    shutil.copytree(folder / "out", folder / "again")
    times = folder / "out" / "images.csv"
    times.write_text(times.read_text().replace("\n", "\n#"))
    return folder

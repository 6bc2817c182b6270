"""A first survey: written, checked and run from an unprepared folder."""

from __future__ import annotations

import os
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING

import pytest
from tests.conftest import TAG_IN_CAM_M
from tests.simulated.phone_survey import write_anchors, write_log, write_photos

from rangesfm.cli import main
from rangesfm.survey.settings import Survey
from rangesfm.survey.survey_reader import read_survey

if TYPE_CHECKING:
    from tests.conftest import Command, WalkedSurvey

PHONE_START_S = 1777888800.0  # 2026-05-04 10:00:00 UTC


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    folder = tmp_path / "my survey"
    write_photos(folder / "DCIM", 12, num_upright=3)
    write_log(folder / "uwb.csv", PHONE_START_S)
    write_anchors(folder / "anchors.csv")
    monkeypatch.chdir(tmp_path)
    return folder


def test_init_writes_what_it_says_and_check_says_the_same(folder: Path, rangesfm_process: Command) -> None:
    done = rangesfm_process("init", folder.name, "--tag-in-cam", "0,-0.1,0", cwd=folder.parent, status=0)
    first, *told, last = done.stdout.splitlines()
    assert first == f"wrote {folder.name}/survey.toml"
    assert last == f"next: rangesfm run '{folder.name}/survey.toml'"
    assert "photos in DCIM: 9 of 96 x 64 pixels, 3 of 64 x 96 pixels" in told
    assert "anchors: 4 of 4 have positions in anchors.csv (frame site)" in told
    assert "lever arm: the tag is at 0, -0.1, 0 m in the camera frame (right, down, forward)" in told
    survey = read_survey(folder / "survey.toml")
    assert survey.images.path == folder / "DCIM"
    assert survey.tag.tag_in_cam_m == (0, -0.1, 0)
    assert survey.output.path == folder / "out"
    for target in (folder.name, f"{folder.name}/survey.toml"):
        checked = rangesfm_process("check", target, cwd=folder.parent, status=0)
        assert checked.stdout.splitlines() == told


def test_init_never_overwrites(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    written = folder / "survey.toml"
    written.write_text("# mine\n")
    assert main(["init", str(folder)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "survey.toml: is there already and is left as it is" in line
    assert written.read_text() == "# mine\n"
    assert main(["init", str(folder), "--output_path", str(folder.parent / "new")]) == 0
    other = read_survey(folder.parent / "new" / "survey.toml")
    assert other.ranges.path == folder / "uwb.csv"
    assert other.output.path == folder.parent / "new" / "out"


def test_init_says_what_is_missing_and_assumed(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "uwb.csv").unlink()
    assert main(["init", str(folder)]) == 0
    told = capsys.readouterr().out
    assert "\nmissing: no ranges and no lengths: give a radio's log (--ranges), control points (--points)" in told
    assert "\nnext: write down what is missing (a flag is a key of the same name), then " in told
    assert told.endswith(f"rangesfm check '{folder}/survey.toml'\n")
    assert main(["check", str(folder)]) == 2
    assert "\nerror: no ranges and no lengths: " in capsys.readouterr().out


def test_lengths_do_without_a_radio(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "uwb.csv").unlink()
    (folder / "anchors.csv").unlink()
    (folder / "tape.csv").write_text("from,to,distance_m\nIMG_0.jpg,IMG_9.jpg,4.2\ndoor,window,2.5\n")
    (folder / "marks.csv").write_text("marker,image_name,x_px,y_px\ndoor,IMG_1.jpg,5,6\ndoor,IMG_2.jpg,5,7\n")
    with (folder / "marks.csv").open("a") as marks:
        marks.write("window,IMG_1.jpg,8,6\nwindow,IMG_2.jpg,8,7\n")
    assert main(["init", str(folder)]) == 0
    told = capsys.readouterr().out
    assert "\ntaped distances: 2, which alone determine the scale (no ranges)\n" in told
    assert told.endswith(f"\nnext: rangesfm run '{folder}/survey.toml'\n")
    survey = read_survey(folder / "survey.toml")
    assert (survey.scale.distances, survey.scale.markers) == (folder / "tape.csv", folder / "marks.csv")


def test_from_a_model_and_a_log_goes_on_what_init_says(
    own_survey: WalkedSurvey, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(own_survey.folder)
    Path("reference.csv").unlink()
    Path("anchors_first_camera.csv").unlink()
    assert main(["init", ".", "--tag_in_cam", ",".join(map(str, TAG_IN_CAM_M))]) == 0
    *_, command = capsys.readouterr().out.splitlines()
    assert command == "next: rangesfm run survey.toml"
    assert read_survey("survey.toml").images.model == own_survey.folder / "sparse" / "0"
    assert main(["check", "survey.toml"]) == 0
    assert "\nmodel: " in f"\n{capsys.readouterr().out}"
    assert main(["scale", "survey.toml"]) == 0


def test_an_ambiguous_folder_is_asked_about_and_nothing_is_written(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "anchors.csv").rename(folder / "anchors_1.csv")
    write_anchors(folder / "anchors_2.csv")
    for command in ("init", "run", "check"):
        assert main([command, str(folder)]) == 2
        assert "anchors_1.csv, anchors_2.csv: any of them may be [anchors] path; say which by --anchors PATH" in (
            capsys.readouterr().err
        )
    assert sorted(os.listdir(folder)) == ["DCIM", "anchors_1.csv", "anchors_2.csv", "uwb.csv"]


def test_a_folder_runs_without_a_file_and_says_first_what_it_is(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[Survey] = []

    def run(survey: Survey, **options: object) -> SimpleNamespace:
        asked.append(survey)
        return SimpleNamespace(lines=["done"])

    monkeypatch.setattr("rangesfm.pipeline.run.run_survey", run)
    assert main(["run", str(folder), "--every_nth", "2"]) == 0
    told = capsys.readouterr().err.splitlines()
    assert "photos in DCIM: 9 of 96 x 64 pixels, 3 of 64 x 96 pixels" in told
    assert any(line.startswith("assumed: camera SIMPLE_RADIAL for 9 photos") for line in told)
    (survey,) = asked
    assert survey.output.path == folder / "out"
    assert survey.images.every_nth == 2
    assert not (folder / "survey.toml").exists()


def test_photos_and_log_may_lie_in_folders_of_their_own(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    radio = folder.parent / "radio"
    radio.mkdir()
    for name in ("uwb.csv", "anchors.csv"):
        (folder / name).rename(radio / name)
    assert main(["init", str(folder), str(radio)]) == 0
    assert "missing" not in capsys.readouterr().out
    survey = read_survey(folder / "survey.toml")
    assert (survey.images.path, survey.ranges.path) == (folder / "DCIM", radio / "uwb.csv")

"""Commands do not change files that they did not write, and keep a result until the new one is complete."""

from __future__ import annotations

import errno
import os
import re
import resource
import shutil
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from tests.outputs import names_in, paths_below

from rangesfm.pipeline import run_results

if TYPE_CHECKING:
    from tests.conftest import Command, PhotoRun, WalkedSurvey


# What places the anchors with the least work: in the first camera's frame the map need not find its place.
ANCHORS = ("--anchors", "anchors_first_camera.csv", "--anchor_frame", "first_camera")


@pytest.fixture(scope="module")
def result(walked_survey: WalkedSurvey, rangesfm_command: Command, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The results of scaling the survey. Tests must not write to them."""
    folder = tmp_path_factory.mktemp("own_files") / "out"
    flags = (*walked_survey.flags, *ANCHORS, "--output_path", str(folder))
    rangesfm_command("scale", *flags, cwd=walked_survey.folder)
    return folder


def bytes_in(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in paths_below(folder) if path.is_file()}


def refusal(command: Command, *arguments: str, cwd: Path) -> str:
    """Run a command that must refuse, check that every file is unchanged, and return its message."""
    before = bytes_in(cwd)
    done = command(*arguments, "--quiet", cwd=cwd, status=2)
    assert bytes_in(cwd) == before
    (line,) = done.stderr.splitlines()
    return line


@pytest.mark.parametrize("name", ["photos/walk.mp4", "sparse/walk.mp4", "photos_2/walk.mp4", "mapper.log/walk.mp4"])
def test_a_video_in_the_place_of_a_result_stays(name: str, tmp_path: Path, rangesfm_command: Command) -> None:
    (tmp_path / name).parent.mkdir()
    (tmp_path / name).write_bytes(b"a film")
    shutil.copyfile(__file__, tmp_path / "uwb.csv")
    flags = ("--images", name, "--ranges", "uwb.csv", "--output_path", ".")
    for command in (("run", *flags), ("reconstruct", "--images", name, "--output_path", ".")):
        assert "would overwrite this input" in refusal(rangesfm_command, *command, cwd=tmp_path)


def test_a_model_of_the_results_is_not_replaced_by_the_results_of_scaling_it(
    own_survey: WalkedSurvey, result: Path, rangesfm_command: Command
) -> None:
    shutil.copytree(result, own_survey.folder / "out")
    flags = [*own_survey.flags, *ANCHORS, "--output_path", "out"]
    flags[flags.index("sparse/0")] = "out/sparse_scaled/0"
    assert "would overwrite this input" in refusal(rangesfm_command, "scale", *flags, cwd=own_survey.folder)
    flags[flags.index("out/sparse_scaled/0")] = "out/sparse_scaled"
    assert "would overwrite this input" in refusal(rangesfm_command, "scale", *flags, cwd=own_survey.folder)


class TestProjectOfColmap:
    """Photos, database and models as COLMAP's own commands leave them."""

    @pytest.fixture
    def project(self, photo_run: PhotoRun, tmp_path: Path) -> Path:
        folder = tmp_path / "project"
        shutil.copytree(photo_run.survey.folder / "images", folder / "images")
        shutil.copytree(photo_run.output_path / "sparse", folder / "sparse")
        shutil.copyfile(photo_run.output_path / "database.db", folder / "database.db")
        return folder

    def test_is_refused_as_an_output(self, project: Path, rangesfm_command: Command) -> None:
        flags = ("--images", "images", "--output_path", ".")
        assert "database.db: is not a file that rangesfm wrote" in refusal(
            rangesfm_command, "reconstruct", *flags, cwd=project
        )

    def test_in_the_folder_out_is_left_to_a_folder_beside_it(
        self, project: Path, photo_run: PhotoRun, rangesfm_command: Command
    ) -> None:
        survey = project.parent
        for name in ("uwb.csv", "anchors.csv"):
            shutil.copyfile(photo_run.survey.folder / name, survey / name)
        project.rename(survey / "out")
        rangesfm_command("init", str(survey), "--images", str(survey / "out" / "images"), cwd=survey)
        text = (survey / "survey.toml").read_text()
        assert 'path = "rangesfm_out"' in text
        (survey / "survey.toml").write_text(text.replace("rangesfm_out", "out"))
        assert "is not a file that rangesfm wrote" in refusal(rangesfm_command, "run", "survey.toml", cwd=survey)

    def test_with_its_photos_among_the_models_is_refused(self, project: Path, rangesfm_command: Command) -> None:
        (project / "images").rename(project / "sparse" / "images")
        flags = ("--images", "sparse/images", "--output_path", ".")
        assert "would overwrite this input" in refusal(rangesfm_command, "reconstruct", *flags, cwd=project)


def test_a_dense_cloud_in_an_exported_folder_stays(
    photo_run: PhotoRun, rangesfm_command: Command, tmp_path: Path
) -> None:
    flags = ("export", str(photo_run.output_path), "--formats", "undistorted,ply", "--output_path", "exported")
    images = ("--images", str(photo_run.survey.folder / "images"))
    rangesfm_command(*flags, *images, cwd=tmp_path)
    rangesfm_command(*flags, *images, cwd=tmp_path)
    (tmp_path / "exported" / "undistorted" / "dense").mkdir()
    (tmp_path / "exported" / "undistorted" / "dense" / "fused.ply").write_text("hours of work")
    before = bytes_in(tmp_path / "exported" / "undistorted")
    done = rangesfm_command(*flags, *images, cwd=tmp_path, status=2)
    assert "undistorted/dense/fused.ply: is not a file that rangesfm wrote" in done.stderr
    assert bytes_in(tmp_path / "exported" / "undistorted") == before


@pytest.mark.parametrize(
    ("command", "output"),
    [
        *(("ranges uwb.csv --anchors anchors.csv", name) for name in ("uwb.csv", "anchors.csv")),
        *(
            ("ranges calibrate uwb.csv --anchors anchors.csv --positions reference.csv", name)
            for name in ("uwb.csv", "anchors.csv", "reference.csv")
        ),
        *(("trilaterate uwb.csv --positions reference.csv", name) for name in ("uwb.csv", "reference.csv")),
    ],
)
def test_a_log_is_not_overwritten_by_what_is_made_of_it(
    command: str, output: str, own_survey: WalkedSurvey, rangesfm_command: Command
) -> None:
    line = refusal(rangesfm_command, *command.split(), "--output_path", output, cwd=own_survey.folder)
    assert f"{output}: the result would overwrite this input" in line


def test_a_result_is_not_joined_into_itself(result: Path, rangesfm_command: Command, tmp_path: Path) -> None:
    for name in ("a", "b"):
        shutil.copytree(result, tmp_path / name)
    for output in ("a", "b", "a/sparse", "b/new"):
        line = refusal(rangesfm_command, "join", "a", "b", "--output_path", output, cwd=tmp_path)
        assert "would overwrite this input" in line


@pytest.mark.parametrize("output", ["sparse/0", "copy", "copy/new"])
def test_nothing_is_written_into_a_model_that_is_compared(
    output: str, own_survey: WalkedSurvey, rangesfm_command: Command
) -> None:
    shutil.copytree(own_survey.folder / "sparse" / "0", own_survey.folder / "copy")
    line = refusal(rangesfm_command, "compare", "sparse/0", "copy", "--output_path", output, cwd=own_survey.folder)
    assert "would overwrite this input" in line


@pytest.mark.parametrize("moment", ["write_model", "export_map"])
def test_a_full_disk_costs_no_earlier_result(
    moment: str,
    own_survey: WalkedSurvey,
    result: Path,
    rangesfm_command: Command,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "points.ply")

    shutil.copytree(result, own_survey.folder / "out")
    flags = ("scale", *own_survey.flags, *ANCHORS, "--output_path", "out")
    before = bytes_in(own_survey.folder / "out")
    with monkeypatch.context() as patched:
        patched.setattr(run_results, moment, full)
        done = rangesfm_command(*flags, "--check_share", "0.2", cwd=own_survey.folder, status=None)
    assert done.returncode in (2, 4)
    assert "No space left on device" in done.stderr
    assert bytes_in(own_survey.folder / "out") == before


@pytest.mark.parametrize("max_kilobytes", [10, 1500])
def test_photos_that_find_no_room_for_their_features_end_in_one_line(
    max_kilobytes: int, photo_run: PhotoRun, tmp_path: Path
) -> None:
    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (1000 * max_kilobytes, 1000 * max_kilobytes))

    flags = ("--images", str(photo_run.survey.folder / "images"), "--output_path", "out", "--quiet")
    command = [sys.executable, "-m", "rangesfm", "reconstruct", *flags]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False, preexec_fn=limit)
    assert done.returncode == 4
    assert re.fullmatch(r"rangesfm: error: .*(room on the disk|File too large|ended \(SIGABRT\)).*\n", done.stderr)
    assert names_in(tmp_path / "out") == []


@pytest.mark.parametrize("is_first", [True, False], ids=["first", "again"])
def test_files_of_other_names_stay_beside_a_result(
    is_first: bool, own_survey: WalkedSurvey, result: Path, rangesfm_command: Command
) -> None:
    out = own_survey.folder / "out"
    if is_first:
        out.mkdir()
    else:
        shutil.copytree(result, out)
    mine = ("notes.txt", ".bashrc.20240101.old", "markers.csv.bak")
    for name in mine:
        (out / name).write_text("mine")
    flags = ("scale", *own_survey.flags, *ANCHORS, "--output_path", "out")
    rangesfm_command(*flags, cwd=own_survey.folder)
    assert {name: (out / name).read_text() for name in mine} == dict.fromkeys(mine, "mine")
    assert "result.json" in names_in(out)


@pytest.mark.parametrize("name", ["markers.csv", "reference.csv", "trajectory.tum", "sparse_metric/0/notes.txt"])
def test_files_of_somebody_else_with_our_names_are_refused_before_the_work(
    name: str, own_survey: WalkedSurvey, rangesfm_command: Command
) -> None:
    path = own_survey.folder / "out" / name
    path.parent.mkdir(parents=True)
    path.write_text("mine")
    flags = ("scale", *own_survey.flags, *ANCHORS, "--output_path", "out")
    assert f"{name}: is not a file that rangesfm wrote" in refusal(rangesfm_command, *flags, cwd=own_survey.folder)

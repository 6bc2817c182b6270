"""The command as users meet it: help, results, and one line for each error."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import rangesfm
from rangesfm.cli import main
from rangesfm.cli.arguments import Commands
from rangesfm.errors import GeometryError, SolverError

LOG = "timestamp_s,anchor_id,range_m\n0,a,1\n0.5,b,0\n1,a,2\n"


def run(*command: str, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    package_folder = str(Path(rangesfm.__path__[-1]).parent)
    path = os.pathsep.join([package_folder, os.environ.get("PYTHONPATH", "")]).rstrip(os.pathsep)
    env = {**os.environ, "PYTHONPATH": path}
    return subprocess.run(command, capture_output=True, text=True, cwd=cwd, env=env, check=False)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "uwb.csv").write_text(LOG)
    (tmp_path / "model").mkdir()
    (tmp_path / "photos").mkdir()
    monkeypatch.chdir(tmp_path)
    return tmp_path


def error_line(capsys: pytest.CaptureFixture[str]) -> str:
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith("rangesfm: error: ")
    assert captured.err.count("\n") == 1
    return captured.err


def raise_in_ranges(monkeypatch: pytest.MonkeyPatch, error: BaseException) -> None:
    def fail(*_: object) -> None:
        raise error

    monkeypatch.setattr("rangesfm.cli.ranges._ranges", fail)


@pytest.mark.parametrize("command", Commands().by_name)
def test_help_of_each_command_shows_an_example(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*command.split(), "--help"]) == 0
    text = capsys.readouterr().out
    assert f"example:\n  rangesfm {command}" in text
    assert main([*command.split(), "-h"]) == 0
    short = capsys.readouterr().out
    assert f"example:\n  rangesfm {command}" in short
    assert f"everything:\n  rangesfm {command} --help" in short
    assert set(re.findall(r"--\w+", short)) <= set(re.findall(r"--\w+", text))


@pytest.mark.parametrize("num_columns", [80, 100])
def test_help_is_wrapped_to_the_width_of_the_terminal(
    num_columns: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", str(num_columns))
    for command in ("", *Commands().by_name):
        for flag in ("-h", "--help"):
            assert main([*command.split(), flag]) == 0
    widths = [len(line) for line in capsys.readouterr().out.splitlines()]
    assert num_columns - 5 < max(widths) <= num_columns


def test_short_help_is_a_page_of_what_most_people_need(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", "-h"]) == 0
    short = capsys.readouterr().out
    assert main(["run", "--help"]) == 0
    full = capsys.readouterr().out
    assert len(short.splitlines()) < 60 < len(full.splitlines())
    for flag, is_common in {"--images": True, "--ranges": True, "--tag_in_cam": True, "--stamp_bits": False}.items():
        assert f"\n  {flag} " in full
        assert (f"\n  {flag} " in short) == is_common


def test_first_list_has_the_commands_most_people_need_and_the_full_help_all(capsys: pytest.CaptureFixture[str]) -> None:
    listed = []
    for flag in ("-h", "--help"):
        assert main([flag]) == 0
        text = capsys.readouterr().out.partition("example:")[0]
        listed.append([name for name in Commands().by_name if re.search(f"\n  {name}  ", text)])
    assert listed[0] == ["init", "check", "plan", "run", "demo", "measure", "export", "report"]
    assert listed[1] == list(Commands().by_name)


@pytest.mark.parametrize(
    ("argv", "heavy"),
    [(["refine", "--help"], ["numpy", "scipy", "pycolmap"]), (["--help"], ["numpy", "pydantic", "pycolmap"])],
)
def test_help_is_quick_and_needs_none_of_the_heavy_packages(argv: list[str], heavy: list[str]) -> None:
    """The definitions of the survey keys are imported only by the command that needs them."""
    code = f"import sys; from rangesfm.cli import main; main({argv}); sys.exit(bool(set({heavy}) & set(sys.modules)))"
    assert run(sys.executable, "-c", code).returncode == 0


def test_version_is_printed(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--version"]) == 0
    assert capsys.readouterr().out.startswith("rangesfm 0.")


def test_ranges_prints_what_is_in_a_log(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["ranges", "uwb.csv"]) == 0
    text = capsys.readouterr().out
    assert "ranges  2, and 1 records without a measurement" in text
    assert "0.000 to 1.000 s, 1.000 s long, 1.0 ranges a second, largest gap 1.000 s" in text
    assert text.splitlines()[-1].split() == ["a", "2", "1.000", "1.500", "2.000", "1.000"]


def test_ranges_writes_the_canonical_csv_from_mapped_columns(folder: Path) -> None:
    (folder / "odd.tsv").write_text("node\tt\td\nA\t1500\t232\n")
    columns = "timestamp=t,anchor_id=node,range=d"
    argv = ["ranges", "odd.tsv", "--columns", columns, "--timestamp-unit", "ms", "--range_unit", "cm"]
    assert main([*argv, "--output-path", "ranges.csv"]) == 0
    assert (folder / "ranges.csv").read_text() == "timestamp_s,anchor_id,range_m\n1.5,A,2.32\n"


@pytest.mark.parametrize(
    ("argv", "said"),
    [
        (["rum"], "rum"),
        (["run"], "no photos"),
        (["run", "--images", "none"], "no such folder of photos"),
        (["run", "--images", "photos"], "no ranges"),
        (["run", "--images", "photos", "--ranges", "none.csv"], "there is no file"),
        (["run", "none.toml"], "none.toml: no such file"),
        (["reconstruct", "--ranges", "uwb.csv"], "unknown option --ranges"),
        (["scale", "--ranges", "uwb.csv"], "no model"),
        (
            ["refine", "--ranges", "uwb.csv", "--input_path", "none"],
            "no such folder of a COLMAP model, or file of a trajectory",
        ),
        (["refine", "--input_path", "model"], "no ranges"),
        (["ranges", "none.csv"], "none.csv: no such file"),
        (["ranges", "uwb.csv", "--output_path", "none/ranges.csv"], "cannot be written"),
        (["ranges", "photos"], "no file there, expected the files of a log"),
        (["report", "photos"], "photos"),
        (["compare", "photos"], "photos"),
        (["export", "photos"], "photos"),
        (["export", "photos", "--formats", "tum,dxf"], "dxf"),
        (["export", "a", "--input_path", "b"], "two result folders"),
        (["demo", "--num_photos", "19"], "--num_photos is 19, expected 20 to 40"),
        (["demo", "--num_photos", "41"], "--num_photos is 41, expected 20 to 40"),
        (["demo", "--scene", "corridor", "--num_photos", "97"], "--num_photos is 97, expected 20 to 96"),
        (["demo", "--seed", "-2"], "--seed is -2"),
    ],
)
@pytest.mark.usefixtures("folder")
def test_bad_usage_and_bad_input_are_one_line_and_status_2(
    argv: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(argv) == 2
    assert said in error_line(capsys)


def test_output_that_cannot_be_written_leaves_nothing_behind(folder: Path) -> None:
    (folder / "taken").mkdir()
    assert main(["ranges", "uwb.csv", "--output_path", "taken"]) == 2
    assert sorted(path.name for path in folder.iterdir()) == ["model", "photos", "taken", "uwb.csv"]


@pytest.mark.parametrize(
    ("error", "status", "said"),
    [
        (GeometryError("the path is straight"), 3, "the path is straight"),
        (SolverError("diverged\nsomewhere"), 4, "diverged somewhere"),
        (KeyboardInterrupt(), 130, "interrupted"),
        (OSError(28, "No space left on device", "out/x"), 4, "out/x: No space left on device"),
        (PermissionError(13, "Permission denied", "out/x"), 2, "out/x: Permission denied"),
        (MemoryError(), 4, "out of memory"),
        (RuntimeError("odd"), 1, "internal error, please report it (RANGESFM_DEBUG=1 shows where): RuntimeError: odd"),
    ],
)
@pytest.mark.usefixtures("folder")
def test_every_error_ends_as_one_line(
    error: BaseException,
    status: int,
    said: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    raise_in_ranges(monkeypatch, error)
    monkeypatch.delenv("RANGESFM_DEBUG", raising=False)
    assert main(["ranges", "uwb.csv"]) == status
    assert said in error_line(capsys)


@pytest.mark.usefixtures("folder")
def test_traceback_is_shown_to_those_who_ask(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    raise_in_ranges(monkeypatch, RuntimeError("odd"))
    monkeypatch.setenv("RANGESFM_DEBUG", "1")
    assert main(["ranges", "uwb.csv"]) == 1
    assert "Traceback" in capsys.readouterr().err


def test_reader_that_goes_away_is_no_error(folder: Path) -> None:
    script = f'"{sys.executable}" -m rangesfm ranges uwb.csv | true; echo "${{PIPESTATUS[0]}}"'
    done = run("bash", "-c", script, cwd=folder)
    assert done.stderr == ""
    assert done.stdout.strip() in ("0", "141")

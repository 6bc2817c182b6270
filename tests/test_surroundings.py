"""Commands in unusual surroundings: names, locales, terminals, disks and clocks."""

from __future__ import annotations

import os
import resource
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from tests.outputs import paths_below
from tests.traps import set_traps

from rangesfm.cli import main

if TYPE_CHECKING:
    from tests.conftest import WalkedSurvey

ODD_NAME = "Über das 測量 <b>'x' \"y\" & $z\\foo$ %s"
MAX_FILE_BYTES = 20_000
NOT_TEXT = os.fsdecode(b"caf\xe9")


def contents(folder: Path) -> dict[str, bytes]:
    """Return the contents of all files under a folder, including hidden ones."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in paths_below(folder) if path.is_file()}


def quick_flags(survey: WalkedSurvey) -> tuple[str, ...]:
    """Return flags with which ``rangesfm scale`` takes the least time, because the map need not find its place."""
    return (*survey.flags, "--anchors", "anchors_first_camera.csv", "--anchor_frame", "first_camera")


@pytest.mark.parametrize("name", [ODD_NAME, NOT_TEXT], ids=["odd", "not text"])
def test_a_folder_of_any_name_is_written_to_and_nothing_else(
    name: str, walked_survey: WalkedSurvey, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / name
    shutil.copytree(walked_survey.folder, folder)
    home, temporary = tmp_path / "home", tmp_path / "tmp"
    home.mkdir()
    temporary.mkdir()
    for variable in ("HOME", "XDG_CONFIG_HOME", "XDG_CACHE_HOME", "XDG_DATA_HOME", "MPLCONFIGDIR"):
        monkeypatch.setenv(variable, str(home))
    monkeypatch.setenv("TMPDIR", str(temporary))
    monkeypatch.setattr("tempfile.tempdir", None)
    monkeypatch.chdir(folder)
    flags = quick_flags(walked_survey)
    before = contents(tmp_path)
    out = f"{name} out"
    assert main(["scale", *flags, "--output_path", out, "--quiet"]) == 0
    assert main(["report", out, "--quiet"]) == 0
    assert main(["export", out, "--formats", "tum,ply,nerfstudio", "--quiet"]) == 0
    after = contents(tmp_path)
    new = [path for path in after if path not in before]
    assert all(path.startswith(f"{name}/{out}/") for path in new), new
    assert {f"{name}/{out}/result.json", f"{name}/{out}/report.html"} <= set(new)
    assert {path: after[path] for path in before} == before


@pytest.fixture
def command(own_survey: WalkedSurvey) -> Callable[..., subprocess.CompletedProcess[bytes]]:
    """Return a function that runs ``rangesfm`` in given surroundings, on a survey whose anchor A1 has an odd name."""
    folder = own_survey.folder
    for name in ("uwb.csv", "anchors_first_camera.csv"):
        text = (folder / name).read_text(encoding="utf-8").replace("A1", "Tür-測")
        (folder / name).write_text(text, encoding="utf-8")

    def run(*arguments: str, **surroundings: object) -> subprocess.CompletedProcess[bytes]:
        given: dict[str, object] = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "stdin": subprocess.DEVNULL}
        command = [sys.executable, "-m", "rangesfm", *arguments]
        return subprocess.run(command, cwd=folder, check=False, **(given | surroundings))  # type: ignore[call-overload,no-any-return]

    return run


@pytest.mark.parametrize(
    "locale",
    [
        {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"},
        {"PYTHONIOENCODING": "ascii"},
        {"LC_ALL": "tr_TR.ISO-8859-9", "PYTHONUTF8": "0", "PYTHONIOENCODING": "iso-8859-9", "COLUMNS": "0"},
    ],
    ids=["C", "ascii", "Turkish"],
)
def test_any_locale_will_do(
    locale: dict[str, str], command: Callable[..., subprocess.CompletedProcess[bytes]], own_survey: WalkedSurvey
) -> None:
    flags = ("ranges", "uwb.csv", "--output_path", "ränges.csv")
    done = command(*flags, env={**os.environ, **locale})
    assert (done.returncode, done.stderr) == (0, b"")
    assert b"T\\xfcr-\\u6e2c" in done.stdout or "Tür".encode("iso-8859-9") in done.stdout
    assert "Tür-測" in (own_survey.folder / "ränges.csv").read_text(encoding="utf-8")


def test_closed_streams_do_no_harm_and_nothing_is_in_the_encoding_of_the_locale(
    command: Callable[..., subprocess.CompletedProcess[bytes]], own_survey: WalkedSurvey
) -> None:
    def close_all() -> None:
        for descriptor in range(3):
            os.close(descriptor)

    flags = ("scale", *quick_flags(own_survey), "--output_path", "out")
    strict = {**os.environ, "PYTHONWARNDEFAULTENCODING": "1", "PYTHONWARNINGS": "error::EncodingWarning"}
    done = command(*flags, preexec_fn=close_all, stdin=None, stdout=None, stderr=None, env=strict)
    assert done.returncode == 0
    assert (own_survey.folder / "out" / "result.json").is_file()


def test_full_disk_is_one_line_and_leaves_nothing_half_written(
    command: Callable[..., subprocess.CompletedProcess[bytes]], own_survey: WalkedSurvey
) -> None:
    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (MAX_FILE_BYTES, MAX_FILE_BYTES))

    flags = ("scale", *quick_flags(own_survey), "--output_path", "out", "--quiet")
    done = command(*flags, preexec_fn=limit)
    assert done.returncode == 4, done.stderr
    assert done.stderr.startswith(b"rangesfm: error: ")
    assert done.stderr.count(b"\n") == 1
    assert b"internal error" not in done.stderr
    assert b"/out/" in done.stderr  # the path that it could not write
    left = (
        [path.name for path in (own_survey.folder / "out").rglob("*")] if (own_survey.folder / "out").exists() else []
    )
    assert "result.json" not in left
    assert "points3D.bin" not in left  # COLMAP would leave the part that fitted
    assert not [name for name in left if name.startswith(".")]


def test_what_colmap_logs_goes_neither_to_the_terminal_nor_to_files_of_its_own(tmp_path: Path) -> None:
    log = "from rangesfm.cli import main; main(['--version']); import pycolmap; pycolmap.logging.error('it failed')"
    environment = {name: value for name, value in os.environ.items() if not name.startswith("GLOG_")}
    surroundings = {**environment, "TMPDIR": str(tmp_path)}
    done = subprocess.run([sys.executable, "-c", log], cwd=tmp_path, env=surroundings, capture_output=True, check=True)
    assert done.stderr == b""
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("argv", [("ranges", "uwb.csv"), ("--help",), ("--version",)])
def test_full_device_for_a_file_is_one_line(
    argv: tuple[str, ...], command: Callable[..., subprocess.CompletedProcess[bytes]]
) -> None:
    with open("/dev/full", "wb") as full:
        done = command(*argv, stdout=full)
    assert done.returncode == 4
    assert done.stderr == b"rangesfm: error: standard output: No space left on device\n"


@pytest.mark.parametrize(("stdout_is_full", "status"), [(False, 0), (True, 4)])
def test_full_device_for_progress_and_messages_ends_no_run_and_loses_no_result(
    stdout_is_full: bool,
    status: int,
    command: Callable[..., subprocess.CompletedProcess[bytes]],
    own_survey: WalkedSurvey,
) -> None:
    with open("/dev/full", "wb") as full:
        flags = ("scale", *quick_flags(own_survey), "--output_path", "out")
        done = command(*flags, stderr=full, **({"stdout": full} if stdout_is_full else {}))
    assert done.returncode == status
    assert stdout_is_full or b"metric model:" in done.stdout
    assert (own_survey.folder / "out" / "result.json").is_file()


def test_full_device_for_messages_changes_no_exit_status(
    command: Callable[..., subprocess.CompletedProcess[bytes]],
) -> None:
    with open("/dev/full", "wb") as full:
        assert command("ranges", "none.csv", stderr=full).returncode == 2


def test_message_goes_nowhere_where_its_stream_is_closed(
    command: Callable[..., subprocess.CompletedProcess[bytes]],
) -> None:
    done = command("ranges", "none.csv", stderr=None, preexec_fn=lambda: os.close(2))
    assert (done.returncode, done.stdout) == (2, b"")


def test_no_file_takes_the_place_of_a_closed_stream(own_survey: WalkedSurvey) -> None:
    said = "import os, sys; from rangesfm.cli import main; main(['--version']); file = open('uwb.csv'); "
    program = said + "sys.exit(file.fileno())"
    done = subprocess.run([sys.executable, "-c", program], cwd=own_survey.folder, preexec_fn=lambda: os.close(2))
    assert done.returncode > 2


def test_output_that_cannot_be_written_to_is_one_line(
    command: Callable[..., subprocess.CompletedProcess[bytes]],
) -> None:
    with open(os.devnull, "rb") as readable:
        done = command("--version", stdout=readable)
    assert done.returncode == 4
    assert done.stderr == b"rangesfm: error: standard output: Bad file descriptor\n"


def test_working_folder_that_was_deleted_is_one_line(tmp_path: Path) -> None:
    gone = tmp_path / "gone"
    gone.mkdir()
    program = f'rmdir "$PWD"; exec "{sys.executable}" -m rangesfm ranges a'
    done = subprocess.run(["bash", "-c", program], cwd=gone, capture_output=True, check=False)
    assert done.returncode == 2
    assert done.stderr == b"rangesfm: error: the working folder has been deleted: change to one that exists\n"


def test_too_little_memory_to_begin_with_is_one_line(
    command: Callable[..., subprocess.CompletedProcess[bytes]], own_survey: WalkedSurvey
) -> None:
    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_AS, (300_000 << 10, 300_000 << 10))

    flags = ("scale", *quick_flags(own_survey), "--output_path", "out", "--quiet")
    done = command(*flags, preexec_fn=limit)
    assert (done.returncode, done.stderr) == (4, b"rangesfm: error: out of memory\n")


def test_too_little_address_space_to_draw_pictures_is_one_line(
    command: Callable[..., subprocess.CompletedProcess[bytes]], own_survey: WalkedSurvey
) -> None:
    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_AS, (8 << 30, 8 << 30))

    before = contents(own_survey.folder)
    done = command("ranges", "uwb.csv", "--plot", "ranges.png", preexec_fn=limit)
    lines = done.stderr.decode().splitlines()
    assert (done.returncode, len(lines)) == (4, 1)
    assert lines[0].startswith("rangesfm: error: the engine that draws pictures failed: its process was ended (SIG")
    assert lines[0].endswith("(it reserves 64 GB of address space; `ulimit -v` may allow less)")
    assert contents(own_survey.folder) == before


def test_root_of_the_file_system_is_no_output_folder(
    own_survey: WalkedSurvey, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(own_survey.folder)
    assert main(["scale", *quick_flags(own_survey), "--output_path", "/"]) == 2
    said = "rangesfm: error: /: is the root of the file system, expected a folder for the results\n"
    assert capfd.readouterr().err.endswith(said)


@pytest.mark.parametrize("name", ["rangesfm", "python -m rangesfm"])
def test_modules_in_the_working_folder_are_not_run(name: str, own_survey: WalkedSurvey) -> None:
    """Python looks there first if it is called with -m, so that way the command that imports most is tried."""
    sprung = set_traps(own_survey.folder)
    if name == "rangesfm":
        command = [str(Path(sys.executable).with_name("rangesfm")), "ranges", "uwb.csv", "--output_path", "log.csv"]
    else:
        flags = ("scale", *quick_flags(own_survey), "--output_path", "out")
        command = [sys.executable, "-m", "rangesfm", *flags]
    command.append("--quiet")
    done = subprocess.run(command, cwd=own_survey.folder, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert not sprung()


@pytest.mark.parametrize("path", ["/dev/zero", "fifo"])
def test_what_is_no_regular_file_is_not_read(
    path: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    os.mkfifo("fifo")
    assert main(["ranges", path]) == 2
    assert capfd.readouterr().err == f"rangesfm: error: {path}: cannot be read (is not a regular file)\n"


def test_clock_that_jumps_changes_nothing(
    own_survey: WalkedSurvey, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(own_survey.folder)
    jumps = iter([4e9, 0.0, -1e9, 2e9] * 1000)
    monkeypatch.setattr(time, "time", lambda: next(jumps))
    assert main(["scale", *quick_flags(own_survey), "--output_path", "out"]) == 0
    assert "scale: -" not in capfd.readouterr().err

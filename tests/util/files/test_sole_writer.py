"""Only one run at a time writes to a folder: seen from other processes, and after killed ones."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from tests.outputs import names_in
from tests.result_document import result_document

from rangesfm.cli import main
from rangesfm.errors import InputError
from rangesfm.util.files.output_folder import LOCK_NAME, PRIVATE_NAME, sole_writer

if TYPE_CHECKING:
    from tests.conftest import Command, WalkedSurvey

HOLD = """
import sys
from pathlib import Path
from rangesfm.util.files.output_folder import sole_writer
with sole_writer(Path(sys.argv[1])):
    print("held", flush=True)
    sys.stdin.readline()
"""


@pytest.fixture
def hold() -> Iterator[Callable[[Path], subprocess.Popen[str]]]:
    """Return a function that starts a process which holds a folder until it reads a line."""
    started: list[subprocess.Popen[str]] = []

    def start(folder: Path) -> subprocess.Popen[str]:
        process = subprocess.Popen(
            [sys.executable, "-c", HOLD, str(folder)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        started.append(process)
        assert process.stdout is not None
        assert process.stdout.readline() == "held\n"
        return process

    yield start
    for process in started:
        process.kill()
        process.communicate()


@pytest.mark.parametrize("command", ["report out", "report out --png", "export out", "export other --output_path out"])
def test_what_is_written_into_a_result_waits_for_its_run(
    command: str,
    hold: Callable[[Path], subprocess.Popen[str]],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("out", "other"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "result.json").write_text(json.dumps(result_document()))
    process = hold(tmp_path / "out")
    assert main(command.split()) == InputError.exit_status
    assert re.fullmatch(rf"rangesfm: error: out: .*process {process.pid}.*\n", capsys.readouterr().err)
    assert names_in(tmp_path / "out") == ["result.json"]


@pytest.mark.parametrize("command", ["refine", "scale", "run"])
def test_a_second_run_is_refused_and_told_of_the_first(
    command: str,
    hold: Callable[[Path], subprocess.Popen[str]],
    own_survey: WalkedSurvey,
    rangesfm_command: Command,
) -> None:
    out = own_survey.folder / "out"
    holder = hold(out)
    flags = (*command.split(), *own_survey.flags, "--anchors", "anchors.csv", "--output_path", "out")
    done = rangesfm_command(*flags, cwd=own_survey.folder, status=2)
    (line,) = [line for line in done.stderr.splitlines() if "rangesfm: error:" in line]
    assert f"out: process {holder.pid} (-c {out}) has been writing to this folder since 20" in line
    assert line.endswith(": wait for it to end, or give another output path")
    assert done.stdout == ""
    assert [path.relative_to(out).as_posix() for path in out.rglob("*")] == [PRIVATE_NAME, LOCK_NAME]


def test_a_reconstruction_is_refused_too(
    hold: Callable[[Path], subprocess.Popen[str]], rangesfm_command: Command, tmp_path: Path
) -> None:
    (tmp_path / "images").mkdir()
    for name in "abc":
        (tmp_path / "images" / f"{name}.jpg").touch()
    holder = hold(tmp_path / "out")
    done = rangesfm_command("reconstruct", "--images", "images", "--output_path", "out", cwd=tmp_path, status=2)
    assert f"process {holder.pid} " in done.stderr


def test_a_killed_process_leaves_no_lock(hold: Callable[[Path], subprocess.Popen[str]], tmp_path: Path) -> None:
    holder = hold(tmp_path)
    holder.send_signal(signal.SIGKILL)
    holder.wait()
    with sole_writer(tmp_path):
        assert f'"pid": {os.getpid()}' in (tmp_path / LOCK_NAME).read_text()
    assert os.listdir(tmp_path) == []


def test_an_ended_one_lets_the_next_in(hold: Callable[[Path], subprocess.Popen[str]], tmp_path: Path) -> None:
    holder = hold(tmp_path)
    with pytest.raises(InputError, match=f"process {holder.pid} "), sole_writer(tmp_path):
        pass
    holder.communicate("end\n")
    assert os.listdir(tmp_path) == []
    with sole_writer(tmp_path):
        pass


def test_a_thread_keeps_others_out_but_not_itself(tmp_path: Path) -> None:
    def enter() -> None:
        with sole_writer(tmp_path):
            pass

    with sole_writer(tmp_path):
        enter()
        with ThreadPoolExecutor(1) as executor, pytest.raises(InputError, match=f"process {os.getpid()} "):
            executor.submit(enter).result()
        assert (tmp_path / LOCK_NAME).exists()


def no_locks(*_: object) -> None:
    raise OSError(95, "Operation not supported")


def test_where_there_are_no_locks_it_goes_on_in_silence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fcntl.flock", no_locks)
    with sole_writer(tmp_path), sole_writer(tmp_path):
        assert names_in(tmp_path) == []
    assert os.listdir(tmp_path) == []


def test_interrupted_as_soon_as_it_has_the_lock_it_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupt() -> str:
        raise KeyboardInterrupt

    monkeypatch.setattr("socket.gethostname", interrupt)
    with pytest.raises(KeyboardInterrupt), sole_writer(tmp_path / "out"):
        pass
    assert os.listdir(tmp_path) == []


def test_a_folder_made_for_nothing_is_gone_again(tmp_path: Path) -> None:
    with sole_writer(tmp_path / "a" / "b"):
        pass
    assert os.listdir(tmp_path) == []
    with sole_writer(tmp_path / "a" / "b"):
        (tmp_path / "a" / "b" / "file").touch()
    assert (tmp_path / "a" / "b" / "file").exists()


KILLED = """
import os, signal, sys
from pathlib import Path
from rangesfm.util.files.atomic import new_file, new_folder
from rangesfm.util.files.output_folder import sole_writer
with sole_writer(Path()), new_folder(Path("models") / "0") as folder, new_file(Path("table.csv")) as file:
    (folder / "x").touch()
    file.touch()
    os.kill(os.getpid(), signal.SIGKILL)
"""


def test_what_a_killed_process_had_in_the_making_is_cleared_away(tmp_path: Path) -> None:
    (tmp_path / "models").mkdir()
    (tmp_path / ".mine.part").touch()
    subprocess.run([sys.executable, "-c", KILLED], cwd=tmp_path, check=False)
    parts = [path.name for path in (tmp_path / PRIVATE_NAME / "parts").iterdir()]
    assert len(parts) == 2
    assert names_in(tmp_path) == [".mine.part", "models"]
    with sole_writer(tmp_path):
        pass
    assert {path.name for path in tmp_path.rglob("*")} == {"models", ".mine.part"}


def test_where_there_are_no_locks_what_another_process_has_in_the_making_stays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fcntl.flock", no_locks)
    with sole_writer(tmp_path) as output:
        own = output.part("x")
        other = own.with_name(f"{os.getppid()}-0-points.ply")
        own.touch()
        other.touch()
    with sole_writer(tmp_path):
        assert list(own.parent.iterdir()) == [other]

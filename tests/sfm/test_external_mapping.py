"""An external mapper: a program that reads database.db and writes sparse/0."""

from __future__ import annotations

import os
import pickle
import shlex
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

import psutil
import pytest
from tests.outputs import unfinished

from rangesfm.errors import InputError, OptionError, ReconstructionError
from rangesfm.mapper_options import MapperOptions
from rangesfm.progress import SILENT, Progress
from rangesfm.sfm.reconstruct import ReconstructionSummary, reconstruct

if TYPE_CHECKING:
    from tests.listener import Listener
    from tests.sfm.conftest import Room

MAPPER = MapperOptions(features={"sift": {"first_octave": 0, "max_num_features": 250}}, num_threads=2)
PROGRAM = """
import os, pathlib, sys, pycolmap
assert pathlib.Path(sys.argv[1]).is_dir() and "OPENBLAS_NUM_THREADS" not in os.environ
with pycolmap.Database.open("database.db") as database:
    num = database.num_images()
print("mapping", num, "photos")
pycolmap.incremental_mapping("database.db", sys.argv[1], "sparse")
"""


def by_program(text: str, *words: str) -> MapperOptions:
    """Return the options of a mapper that is a Python program."""
    return MAPPER.changed(method="external", command=shlex.join([sys.executable, "-c", text, *words]))


@pytest.fixture(scope="module")
def matched(room: Room, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An output folder of the room, mapped by COLMAP."""
    summary = reconstruct(room.folder, room.names, tmp_path_factory.mktemp("out"), camera=room.camera, mapper=MAPPER)
    return summary.log_path.parent


@pytest.fixture
def output(matched: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(matched, tmp_path / "out"))


def mapped(room: Room, output: Path, mapper: MapperOptions, listener: Progress = SILENT) -> ReconstructionSummary:
    return reconstruct(room.folder, room.names, output, camera=room.camera, mapper=mapper, progress=listener)


def test_its_model_is_taken_and_what_is_done_is_not_done_again(
    room: Room, output: Path, listener: Listener, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("OPENBLAS_NUM_THREADS", raising=False)
    mapper = by_program(PROGRAM, "{images}")
    summary = mapped(room, output, mapper, listener)
    assert summary.num_registered == len(room.names)
    assert "mapping 6 photos" in (output / "mapper.log").read_text()
    assert list(summary.seconds) == ["mapping"]
    assert list(mapped(room, output, mapper).seconds) == []
    assert list(mapped(room, output, mapper.changed(command=f"{mapper.command} again")).seconds) == ["mapping"]


@pytest.mark.parametrize(
    ("program", "message"),
    [
        ("import sys; print('first'); sys.exit('no GPU')", "the external mapper .* ended with status 1: no GPU"),
        ("import os; os.kill(os.getpid(), 9)", "ended with SIGKILL"),
        ("", "ended without an error, but wrote no model to sparse/0"),
        ("import os; os.makedirs('sparse/0')", "wrote a model that cannot be used: .*not a COLMAP model"),
        (
            "import pycolmap; model = pycolmap.synthesize_dataset(pycolmap.SyntheticDatasetOptions()); "
            "import os; os.makedirs('sparse/0'); model.write('sparse/0')",
            "wrote a model with '.*' as image .*, expected the images of database.db",
        ),
    ],
    ids=["a failure", "a kill", "nothing", "an empty folder", "other photos"],
)
def test_what_it_does_wrong_is_told_and_leaves_the_models_as_they_were(
    room: Room, output: Path, program: str, message: str
) -> None:
    before = (output / "sparse" / "0" / "images.bin").read_bytes()
    with pytest.raises(ReconstructionError, match=message):
        mapped(room, output, by_program(program))
    assert (output / "sparse" / "0" / "images.bin").read_bytes() == before
    assert not (unfinished(output) / "sparse").exists()


@pytest.mark.parametrize("command", ["no_such_mapper --fast", "./mapper.sh", "", "'open"])
def test_a_command_without_a_program_is_refused_before_anything_is_computed(
    room: Room, tmp_path: Path, command: str
) -> None:
    with pytest.raises(InputError, match=r"\[mapper\] command"):
        mapped(room, tmp_path / "out", MAPPER.changed(method="external", command=command))
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    "values",
    [
        {"method": "external"},
        {"command": "glomap"},
        {"method": "external", "command": "glomap", "pipeline": {"min_num_matches": 9}},
    ],
)
def test_keys_that_do_not_belong_together_are_refused(values: dict[str, object]) -> None:
    with pytest.raises(OptionError, match=r"\[mapper\] (command|pipeline) is"):
        MapperOptions(**values)  # type: ignore[arg-type]


HANGS_AFTER_S = 300.0  # much longer than a loaded machine takes


@pytest.mark.skipif(sys.platform != "linux", reason="only there is it killed with its parent")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_it_ends_with_the_run_and_so_does_what_it_has_started(
    room: Room, output: Path, tmp_path: Path, number: signal.Signals
) -> None:
    program = (
        "import subprocess, sys, pathlib; inner = subprocess.Popen(['sleep', '1000']); "
        f"pathlib.Path({str(tmp_path / 'pid')!r}).write_text(str(inner.pid)); inner.wait()"
    )
    run = (
        "import sys, pickle; from rangesfm.sfm.reconstruct import reconstruct; "
        "room, names, out, camera, mapper = pickle.load(sys.stdin.buffer); "
        "reconstruct(room, names, out, camera=camera, mapper=mapper)"
    )

    given = pickle.dumps((room.folder, room.names, output, room.camera, by_program(program)))
    process = subprocess.Popen([sys.executable, "-c", run], stdin=subprocess.PIPE, stderr=subprocess.DEVNULL)
    assert process.stdin is not None
    with process.stdin as stdin:
        stdin.write(given)
    while not (tmp_path / "pid").is_file() or not (tmp_path / "pid").read_text():
        assert process.poll() is None
        time.sleep(0.05)
    inner = psutil.Process(int((tmp_path / "pid").read_text()))
    os.kill(process.pid, number)
    process.wait()
    deadline = time.monotonic() + HANGS_AFTER_S
    while not has_ended(inner):
        if time.monotonic() > deadline:
            inner.kill()
            pytest.fail("it is still there")
        time.sleep(0.05)


def has_ended(process: psutil.Process) -> bool:
    try:
        return bool(process.status() == psutil.STATUS_ZOMBIE)
    except psutil.NoSuchProcess:
        return True

"""Whole batches: surveys in processes of this machine, some of which are killed while they work, and on a scheduler."""

from __future__ import annotations

import csv
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import dask
import psutil
import pycolmap
import pytest
from distributed import LocalCluster, Security
from tests.traps import set_traps

from rangesfm.batch.workers import num_at_once, workers_of
from rangesfm.cli import main
from rangesfm.errors import InputError
from rangesfm.util.files.output_folder import LOCK_NAME, PRIVATE_NAME

if TYPE_CHECKING:
    from tests.conftest import Command, PhotoRun, WalkedSurvey

NAMES = ("north", "east")
QUICK = """
[scale]
{scale}
[refine]
covariance = false
{mapper}
"""
IN_CLUSTERS = """
[mapper]
method = "hierarchical"
"""


@pytest.fixture
def surveys(photo_run: PhotoRun, tmp_path: Path) -> Path:
    """Two surveys, the first of which is mapped already.

    The second needs another mapping, and asks for a scale more certain than its data allow.
    """
    for name in NAMES:
        folder = shutil.copytree(photo_run.survey.folder, tmp_path / name)
        (folder / "out" / "result.json").unlink()
        log = (folder / "uwb.csv").read_text().splitlines(keepends=True)
        (folder / "uwb.csv").write_text("".join([log[0], *log[1::3]]))  # a third of the ranges, to be quicker
        text = (folder / "survey.toml").read_text().replace('time_offset = "auto"', "time_offset = 2.35")
        text = text.replace("[report]", "[report]\nenabled = false")
        scale = "max_relative_stddev = 1e-6" if name == "east" else ""
        (folder / "survey.toml").write_text(
            text + QUICK.format(scale=scale, mapper=IN_CLUSTERS if name == "east" else "")
        )
    (tmp_path / "broken.toml").write_text("[images\n")
    return tmp_path


@contextmanager
def batch(folder: Path, *arguments: str) -> Iterator[subprocess.Popen[str]]:
    command = [sys.executable, "-m", "rangesfm", "batch", *arguments]
    # A session of its own, as a terminal has one, so that Ctrl-C goes to all processes of the group.
    process = subprocess.Popen(
        command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    with process:
        try:
            yield process
        finally:
            process.kill()


def survey_process(folder: Path, batch: subprocess.Popen[str]) -> psutil.Process:
    """Suspend the process of the first survey that writes to its folder, and return it."""
    while batch.poll() is None:
        for name in NAMES:
            try:
                found = psutil.Process(json.loads((folder / name / "out" / LOCK_NAME).read_text())["pid"])
                found.suspend()
                return found
            # no such process, a lock file half-written, or the process has ended
            except (OSError, ValueError, psutil.Error):
                pass
        time.sleep(0.02)
    pytest.fail(f"it has ended\n{batch.communicate()}")


def rows_of(folder: Path) -> dict[str, dict[str, str]]:
    with (folder / "batch" / "batch.csv").open(newline="") as file:
        return {row["survey"]: row for row in csv.DictReader(file)}


def left_over(folder: Path) -> list[Path]:
    """List unfinished files and folders, which have hidden names, wherever they are."""
    return [path for path in folder.rglob(".*") if path.name != PRIVATE_NAME] + [*folder.rglob("parts/*")]


def ports_of(process: psutil.Process) -> list[object]:
    """List the sockets on which this process and its children listen."""
    of_all = [process, *process.children(recursive=True)]
    return [socket.laddr for one in of_all for socket in one.net_connections() if socket.status == psutil.CONN_LISTEN]


def test_all_surveys_end_though_one_is_killed_and_others_fail_and_nothing_is_open_to_other_users(
    surveys: Path, photo_run: PhotoRun
) -> None:
    files = [f"{name}/survey.toml" for name in NAMES]
    # modules that every process of the batch would import from its working folder if it looked there
    sprung = set_traps(surveys)
    with batch(surveys, "broken.toml", *files, "--num_workers", "2") as process:
        survey = survey_process(surveys, process)
        assert ports_of(psutil.Process(process.pid)) == []
        survey.kill()
        out, errors = process.communicate()
    assert not survey.is_running()
    assert not sprung()
    assert process.returncode == 3, errors
    rows = rows_of(surveys)
    assert list(rows) == ["broken.toml", *files]
    assert [row["status"] for row in rows.values()] == ["failed", "done", "failed"]
    assert rows["broken.toml"]["reason"].startswith("broken.toml:1: ")
    assert rows["east/survey.toml"]["reason"].startswith("the scale is only known to ")
    assert sorted(row["num_attempts"] for row in rows.values()) == ["0", "1", "2"]
    scale = json.loads((photo_run.output_path / "result.json").read_text())["scale"]["value"]
    assert float(rows["north/survey.toml"]["scale"]) == pytest.approx(scale, rel=0.02)
    assert (surveys / "north" / "out" / "result.json").is_file()
    assert pycolmap.Reconstruction(surveys / "east" / "out" / "sparse" / "0").num_reg_images() == 14
    told = [line.removeprefix("east/survey.toml: ") for line in errors.splitlines()]
    assert [line for line in told if line in ("mapping", "features", "scale")] == ["mapping", "scale"]
    assert "Traceback" not in errors
    assert "begins again, attempt 2" in errors
    assert "3 of 3 surveys over, 2 of them failed" in errors
    assert [line.split()[:2] for line in out.splitlines()[1:4]] == [
        ["broken.toml", "failed"],
        ["north/survey.toml", rows["north/survey.toml"]["verdict"]],
        ["east/survey.toml", "failed"],
    ]
    assert left_over(surveys) == []


def test_interrupted_it_stops_its_workers_and_says_how_far_it_came(surveys: Path) -> None:
    with batch(surveys, "north/survey.toml", "east/survey.toml", "--num_workers", "1", "--restart") as process:
        survey = survey_process(surveys, process)
        processes = [psutil.Process(process.pid), *psutil.Process(process.pid).children(recursive=True)]
        os.killpg(process.pid, signal.SIGINT)
        survey.resume()
        out, errors = process.communicate()
    assert (process.returncode, out) == (130, "")
    assert errors.splitlines()[-1] == "rangesfm: error: interrupted; stages that were done are kept"
    assert psutil.wait_procs(processes, timeout=600)[1] == []
    assert [row["status"] for row in rows_of(surveys).values()] == ["interrupted", "interrupted"]
    assert left_over(surveys) == []


def test_surveys_may_begin_with_a_model(own_survey: WalkedSurvey, rangesfm_process: Command) -> None:
    text = """
        [images]
        model = "sparse/0"
        times = "images.csv"
        [ranges]
        path = "uwb.csv"
        time_offset = 2.0
        [anchors]
        path = "anchors_first_camera.csv"
        frame = "first_camera"
        [report]
        enabled = false
    """
    for name, is_refined in (("refined", "true"), ("scaled", "false")):
        own = f'[refine]\nenabled = {is_refined}\n[output]\npath = "{name}"\n'
        (own_survey.folder / f"{name}.toml").write_text(text + own)
    done = rangesfm_process("batch", "refined.toml", "scaled.toml", "--num_workers", "1", cwd=own_survey.folder)
    assert [row["status"] for row in rows_of(own_survey.folder).values()] == ["done", "done"], done.stderr
    assert (own_survey.folder / "refined" / "sparse_metric" / "0").is_dir()
    assert (own_survey.folder / "scaled" / "sparse_scaled" / "0").is_dir()
    assert not (own_survey.folder / "scaled" / "sparse_metric").exists()


def test_two_surveys_with_one_folder_are_refused_before_anything_starts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("a.toml", "b.toml"):
        (tmp_path / name).touch()
    assert main(["batch", "a.toml", "b.toml"]) == 2
    assert capsys.readouterr().err == (
        f"rangesfm: error: b.toml: writes to {tmp_path / 'out'}, as a.toml does: expected another [output] path\n"
    )
    assert sorted(os.listdir(tmp_path)) == ["a.toml", "b.toml"]


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        (["--num_workers", "0"], "argument --num_workers: 0 is less than 1"),
        (["--memory_limit", "8"], "argument --memory_limit: '8' is not a size, expected one such as 8GB or 500MB"),
        (["--scheduler", "tcp://head:8786", "--num_workers", "2"], "--num_workers is for this machine"),
        (
            ["--scheduler", "nowhere"],
            "no Dask scheduler answers at 'nowhere' (expected an address like tcp://head:8786)",
        ),
        (["--num_threads", "4096"], "1 workers with 4096 threads each, and this machine has "),
    ],
)
def test_what_cannot_be_is_refused(
    flags: list[str], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a.toml").touch()
    assert main(["batch", "a.toml", *flags]) == 2
    assert capsys.readouterr().err.startswith(f"rangesfm: error: {said}")
    assert not (tmp_path / "batch").exists()


@contextmanager
def scheduler(scratch: Path, protocol: str, security: Security) -> Iterator[str]:
    """Start a Dask scheduler with one worker, both in this process, and yield its address."""
    with LocalCluster(
        n_workers=1,
        threads_per_worker=1,
        processes=False,
        protocol=protocol,
        security=security,
        host="127.0.0.1",
        dashboard_address=None,
        local_directory=str(scratch),
        scheduler_kwargs={"dashboard_address": "127.0.0.1:0"},
    ) as cluster:
        yield cluster.scheduler_address


def test_the_workers_of_a_scheduler_do_what_they_are_given(surveys: Path, rangesfm_process: Command) -> None:
    shutil.rmtree(surveys / "north" / "images")
    with scheduler(surveys / "scratch", "tcp", Security()) as address:
        done = rangesfm_process("batch", "north/survey.toml", "--scheduler", address, cwd=surveys, status=2)
    row = rows_of(surveys)["north/survey.toml"]
    assert (row["status"], row["num_attempts"], row["host"]) == ("failed", "1", socket.gethostname())
    assert row["reason"] == f"{surveys / 'north' / 'images'}: no such folder"
    assert done.stderr.splitlines()[0] == "north/survey.toml: begins"


def test_a_scheduler_with_certificates_speaks_only_to_who_has_one_of_them(tmp_path: Path) -> None:
    ours, of_others = Security.temporary(), Security.temporary()
    with scheduler(tmp_path / "scratch", "tls", ours) as address:
        with dask.config.set(as_configured(ours, tmp_path)), workers_of(address) as client:
            assert sum(num_at_once(client).values()) == 1
        with dask.config.set(as_configured(of_others, tmp_path)), pytest.raises(InputError), workers_of(address):
            pass
        expected = (
            "tls:// needs certificates, expected distributed.comm.tls.ca-file, client.cert and client.key in Dask's"
        )
        with pytest.raises(InputError, match=f"no Dask scheduler answers at '{address}' .*: {expected}"):
            workers_of(address).__enter__()
        without = address.replace("tls:", "tcp:")
        with pytest.raises(InputError, match=f"no Dask scheduler answers at '{without}'"):
            workers_of(without).__enter__()
        required = dask.config.set({"distributed.comm.require-encryption": True})
        with required, pytest.raises(InputError, match="expected an address like tls://head:8786"):
            workers_of(without).__enter__()


def as_configured(security: Security, folder: Path) -> dict[str, str]:
    """Dask's configuration of a client, with its certificates written to files."""
    for name in ("tls_ca_file", "tls_client_cert", "tls_client_key"):
        (folder / name).write_text(getattr(security, name))
    of_client = {f"distributed.comm.tls.client.{name}": str(folder / f"tls_client_{name}") for name in ("cert", "key")}
    return {"distributed.comm.tls.ca-file": str(folder / "tls_ca_file"), **of_client}


def test_without_dask_it_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    assert main(["batch", str(tmp_path / "a.toml")]) == 2
    said = "rangesfm: error: rangesfm batch needs Dask: pip install '.[batch]' in a clone of rangesfm installs it\n"
    assert capsys.readouterr().err == said

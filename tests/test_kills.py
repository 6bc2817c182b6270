"""Runs that are killed outright (SIGKILL), and how the next run treats what they leave."""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from tests.studies import kills

if TYPE_CHECKING:
    from tests.conftest import Command, PhotoRun

# Runs a command that is killed at a call of some function, after a number of calls that succeed.
PROGRAM = """
import importlib, os, signal, sys
from rangesfm.cli import main
from rangesfm.sfm import incremental_mapping

module, name, num_calls, *argv = sys.argv[1:]
module, left = importlib.import_module(module), int(num_calls)
incremental_mapping._MIN_INTERVAL_S = incremental_mapping._INTERVAL_OVER_DURATION = 0.0  # the mapping takes a second
function = getattr(module, name)

def function_or_death(*arguments, **options):
    global left
    if left == 0:
        os.kill(os.getpid(), signal.SIGKILL)
    left -= 1
    return function(*arguments, **options)

setattr(module, name, function_or_death)
sys.exit(main(argv))
"""
IN_MATCHING = ("rangesfm.sfm.matching", "copy_matches", 0)
IN_MAPPING = ("rangesfm.sfm.incremental_mapping", "_keep", 3)
BEFORE_THE_RESULT = ("rangesfm.pipeline.run_results", "input_hashes", 0)
BEFORE_THE_REPORT = ("rangesfm.pipeline.run_results", "write_report_of", 0)
AMONG_RENAMES = ("rangesfm.util.files.output_folder", "_rename", 9)


def killed(moment: tuple[str, str, int], *arguments: str, cwd: Path) -> str:
    """Run until the process is killed, and return its messages."""
    command = [sys.executable, "-c", PROGRAM, *map(str, moment), "run", *arguments]
    done = subprocess.run(command, cwd=cwd, capture_output=True, text=True, check=False)
    assert done.returncode == -signal.SIGKILL, done.stderr
    return done.stderr


def assert_whole(output: Path, whole: Path) -> None:
    assert kills.differences(whole, output) == []
    assert kills.names_in(output) == kills.names_in(whole)


def test_killed_in_step_after_step_it_ends_as_if_nothing_had_been(
    photo_run: PhotoRun, rangesfm_command: Command, tmp_path: Path
) -> None:
    output, folder = tmp_path / "out", photo_run.survey.folder
    flags = (*photo_run.flags, "--output_path", str(output))
    said = []
    for moment in (IN_MATCHING, IN_MAPPING, BEFORE_THE_RESULT):
        said.append(killed(moment, *flags, cwd=folder))
        assert not (output / "result.json").exists()
    assert "mapping: continues from " in said[2]
    said.append(rangesfm_command("run", *flags, cwd=folder).stderr)
    for step, first_without in (("features", 1), ("matching", 2), ("mapping", 3)):
        is_done = [f"{step}: taken over from an earlier run" in text for text in said]
        assert is_done == [number >= first_without for number in range(len(said))]
    assert_whole(output, photo_run.output_path)


def test_killed_while_it_replaces_a_result_it_leaves_the_old_one_or_what_completes_the_new_one(
    photo_run: PhotoRun, rangesfm_command: Command, tmp_path: Path
) -> None:
    output, folder = shutil.copytree(photo_run.output_path, tmp_path / "out"), photo_run.survey.folder
    flags = (*photo_run.flags, "--output_path", str(output))
    killed(BEFORE_THE_REPORT, *flags, "--check_share", "0.2", cwd=folder)
    assert_whole(output, photo_run.output_path)
    killed(AMONG_RENAMES, *flags, "--check_share", "0.2", cwd=folder)
    assert not (output / "result.json").exists()
    rangesfm_command("report", str(output), cwd=folder)
    assert json.loads((output / "result.json").read_text())["check_ranges"]["num"] > 0
    rangesfm_command("run", *flags, cwd=folder)
    assert_whole(output, photo_run.output_path)

"""Steps of a reconstruction and their folder; steps that an earlier run into the folder completed are not repeated."""

from __future__ import annotations

import hashlib
import json
import math
import shutil
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from itertools import takewhile
from pathlib import Path
from typing import Any

from rangesfm.colmap.colmap_log import colmap_log
from rangesfm.errors import ReconstructionError
from rangesfm.progress import Progress
from rangesfm.util.files.contents import open_regular
from rangesfm.util.files.records import write_json

DATABASE_NAME, MODELS_NAME, LOG_NAME, RECORD_NAME = "database.db", "sparse", "mapper.log", "reconstruct.json"
RECONSTRUCTION_NAMES = (DATABASE_NAME, MODELS_NAME, LOG_NAME, RECORD_NAME)
"""Files and folders of a complete reconstruction."""
SNAPSHOTS_NAME = "mapping_snapshot"
# What each step makes, and then what it leaves where it is interrupted.
_MADE_BY = {
    "features": (DATABASE_NAME,),
    "matching": (DATABASE_NAME,),
    "rigs": (DATABASE_NAME,),
    "mapping": (f"{MODELS_NAME}/0", SNAPSHOTS_NAME),
}


def fingerprint(*inputs: Any) -> str:
    """Return a hash of the inputs (plain values, in any nesting); equal inputs have equal hashes."""
    return hashlib.sha256(json.dumps(inputs, sort_keys=True, default=str).encode()).hexdigest()


class Workspace:
    """Folder in which a reconstruction is made in steps, each of which needs the one before.

    The state of the steps is kept in a JSON file there, the record.

    Attributes:
        folder: the folder. database, models, snapshots, log: files and folders in it.
        log_folder: of the messages of COLMAP in this process and in others, which ``logged`` adds to the log.
        notes: other plain values in the record, by name; see ``note``.
        seconds: duration of each step that was done in this run, by name.
        earlier_seconds: of each step that was taken over, as far as the record has it.
    """

    def __init__(self, folder: Path, progress: Progress):
        self.progress = progress
        self.folder = folder
        self.database = folder / DATABASE_NAME
        self.models = folder / MODELS_NAME
        self.snapshots = folder / SNAPSHOTS_NAME
        self.log = folder / LOG_NAME
        self.log_folder = folder
        self._steps, self.notes = (_read(folder / RECORD_NAME, part) for part in ("steps", "notes"))
        self.seconds: dict[str, float] = {}
        self.earlier_seconds: dict[str, float] = {}

    def num_done(self, plan: Mapping[str, str]) -> int:
        """Return how many of the first steps of a plan are done.

        Args:
            plan: for each step, the fingerprint of all that it depends on.
        """
        return len([*takewhile(lambda step: self._is_done(*step), plan.items())])

    def run(self, name: str, inputs: str, prepare: Callable[[], object], work: Callable[[], object]) -> None:
        """Do a step, unless it was done with the same inputs and what it makes is still there.

        Args:
            inputs: fingerprint of all that the step depends on.
            prepare: removes old results; skipped where ``work`` was interrupted on the same inputs.
            work: does the step, continuing from what an interruption left.
        """
        state = self._steps.get(name, {})
        if self._is_done(name, inputs):
            seconds = state.get("seconds")
            if isinstance(seconds, float) and 0 <= seconds < math.inf:
                self.earlier_seconds[name] = seconds
            self.progress.message(f"{name}: taken over from an earlier run")
            return
        self.progress.stage(name)
        start = time.perf_counter()
        if state.get("inputs") != inputs or not any((self.folder / made).exists() for made in _MADE_BY[name]):
            self.forget(name)
            self._write()
            prepare()
        self._steps[name] = {"inputs": inputs, "done": False}
        self._write()
        work()
        self.seconds[name] = time.perf_counter() - start
        self._steps[name] = {"inputs": inputs, "done": True, "seconds": self.seconds[name]}
        self._write()

    def _is_done(self, name: str, inputs: str) -> bool:
        state = self._steps.get(name, {})
        is_same = state.get("done") is True and state.get("inputs") == inputs
        return is_same and (self.folder / _MADE_BY[name][0]).exists()

    def forget(self, first: str) -> None:
        """Do this step and those after it again, even if they were done with the same inputs."""
        names = list(self._steps)
        for name in names[names.index(first) :] if first in names else ():
            del self._steps[name]

    def note(self, name: str, value: dict[str, Any]) -> None:
        """Keep a value for the next run, independently of the state of the steps."""
        self.notes[name] = value
        self._write()

    def _write(self) -> None:
        write_json({"steps": self._steps, "notes": self.notes}, self.folder / RECORD_NAME)

    def remove_old_models(self) -> None:
        """Remove the models in this folder, complete and unfinished ones."""
        for folder in (self.models, self.snapshots):
            shutil.rmtree(folder, ignore_errors=True)

    @contextmanager
    def logged(self) -> Iterator[None]:
        """Write COLMAP's messages to the log inside the block, and name the log in the error of a failure."""
        with colmap_log(self.log) as self.log_folder:
            try:
                yield
            except ReconstructionError as error:
                raise ReconstructionError(f"{error} (COLMAP's log: {self.log})") from error
            except RuntimeError as error:
                # Where the database cannot be read or written, the message of pycolmap's error does not mention the
                # disk.
                raise ReconstructionError(
                    f"COLMAP stopped: {error}; is there room on the disk, and for files of that size?"
                    f" (COLMAP's log: {self.log})"
                ) from error


def _read(path: Path, part: str) -> dict[str, dict[str, Any]]:
    try:
        with open_regular(path) as file:
            entries = json.loads(file.read())[part]
        return {str(name): dict(entry) for name, entry in entries.items()}
    except (OSError, ValueError, AttributeError, TypeError, LookupError, RecursionError):
        return {}  # there is no record yet, or the file is not one of ours

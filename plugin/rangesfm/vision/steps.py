"""Steps of a reconstruction and their folder; steps that an earlier run into the folder completed are not repeated."""

from __future__ import annotations

import hashlib
import json
import math
import shutil
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rangesfm.colmap.colmap_log import colmap_log
from rangesfm.errors import ReconstructionError
from rangesfm.files.contents import open_regular
from rangesfm.files.records import write_json
from rangesfm.progress import Progress

DATABASE_NAME, MODELS_NAME, LOG_NAME, RECORD_NAME = "database.db", "sparse", "mapper.log", "reconstruct.json"
RECONSTRUCTION_NAMES = (DATABASE_NAME, MODELS_NAME, LOG_NAME, RECORD_NAME)
"""Files and folders of a complete reconstruction."""
SNAPSHOTS_NAME = "mapping_snapshot"


def fingerprint(*inputs: Any) -> str:
    """Return a hash of the inputs (plain values, in any nesting); equal inputs have equal hashes."""
    return hashlib.sha256(json.dumps(inputs, sort_keys=True, default=str).encode()).hexdigest()


class Steps:
    """A series of steps, each of which needs the one before; their state is kept in a JSON file.

    Attributes:
        notes: other plain values kept in that file, by name; see ``note``.
        seconds: duration of each step that was done in this run, by name.
        earlier_seconds: of each step that was taken over, as far as the record has it.
    """

    def __init__(
        self,
        record_path: Path,
        progress: Progress,
        earlier: Steps | None = None,
        begin: Callable[[Mapping[str, str]], object] = lambda passed: None,
    ):
        """Read the record of earlier runs.

        Args:
            record_path: the JSON file.
            earlier: the same steps, complete, with their results in another folder. A step that was done there with the
                same inputs is not done here.
            begin: called before the first step that has to be done here, with the inputs of the steps before it, by
                name. The record is read again afterwards.
        """
        self._path = record_path
        self._progress = progress
        self._earlier = earlier
        self._begin = begin
        self._passed: dict[str, str] = {}
        self._read_record()
        self.seconds: dict[str, float] = {}
        self.earlier_seconds: dict[str, float] = {}

    def run(
        self,
        name: str,
        inputs: str,
        output: Path,
        prepare: Callable[[], object],
        work: Callable[[], object],
        *,
        unfinished: Path | None = None,
    ) -> None:
        """Do a step, unless it was done with the same inputs and its output is still there.

        Args:
            inputs: fingerprint of all that the step depends on.
            output: file or folder that the step makes.
            prepare: removes old results; skipped where ``work`` was interrupted on the same inputs.
            work: does the step, continuing from what an interruption left.
            unfinished: where an interruption leaves its results, if not in ``output``.
        """
        if self._earlier is not None:
            if self._earlier._has(name, inputs, output.relative_to(self._path.parent)):
                self._passed[name] = inputs
                self._take_over(name, self._earlier._record[name])
                return
            self.begin()
        state = self._record.get(name, {})
        is_same = state.get("inputs") == inputs
        if is_same and state.get("done") and output.exists():
            self._take_over(name, state)
            return
        self._progress.stage(name)
        start = time.perf_counter()
        if not (is_same and (output.exists() or (unfinished is not None and unfinished.exists()))):
            self.forget(name)
            prepare()
        self._set_state(name, inputs, done=False)
        work()
        self.seconds[name] = time.perf_counter() - start
        self._set_state(name, inputs, done=True, seconds=self.seconds[name])

    @property
    def has_begun(self) -> bool:
        """Return whether the results are in this folder, not in that of the earlier steps."""
        return self._earlier is None

    def begin(self) -> None:
        """Do all further steps in this folder, building on what the earlier steps have done."""
        self._begin(self._passed)
        self._earlier = None
        self._read_record()

    def has_done(self, steps: Mapping[str, str]) -> bool:
        """Return whether all these steps are recorded as done with these inputs, given by the steps' names."""
        states = [(self._record.get(name, {}), inputs) for name, inputs in steps.items()]
        return all(state.get("done") is True and state.get("inputs") == inputs for state, inputs in states)

    def _has(self, name: str, inputs: str, output: Path) -> bool:
        return self.has_done({name: inputs}) and (self._path.parent / output).exists()

    def _read_record(self) -> None:
        source = self._path if self._earlier is None else self._earlier._path
        self._record, self.notes = _read(source, "steps"), _read(source, "notes")

    def repeat(self, first: str) -> None:
        """Do this step and those after it again, even if they were done with the same inputs."""
        if self._earlier is not None:
            self.begin()
        self.forget(first)

    def forget(self, first: str) -> None:
        """Remove this step and those after it from the record."""
        names = list(self._record)
        for name in names[names.index(first) :] if first in names else ():
            del self._record[name]
        self._write()

    def note(self, name: str, value: dict[str, Any]) -> None:
        """Keep a value for the next run, independently of the state of the steps."""
        self.notes[name] = value
        if self._earlier is None:
            self._write()

    def _take_over(self, name: str, state: Mapping[str, Any]) -> None:
        seconds = state.get("seconds")
        if isinstance(seconds, float) and 0 <= seconds < math.inf:
            self.earlier_seconds[name] = seconds
        self._progress.message(f"{name}: taken over from an earlier run")

    def _set_state(self, name: str, inputs: str, **state: Any) -> None:
        self._record[name] = {"inputs": inputs, **state}
        self._write()

    def _write(self) -> None:
        write_json({"steps": self._record, "notes": self.notes}, self._path)


class Workspace:
    """Folder in which a reconstruction is made, with the record of what earlier runs have done there.

    Args:
        folder: the folder.
        earlier: the steps of a complete reconstruction in another folder, to continue from.
        begin: see ``Steps``.
    """

    def __init__(
        self,
        folder: Path,
        progress: Progress,
        *,
        earlier: Steps | None = None,
        begin: Callable[[Mapping[str, str]], object] = lambda passed: None,
    ):
        self.progress = progress
        self.output = folder
        self.database = folder / DATABASE_NAME
        self.models = folder / MODELS_NAME
        self.snapshots = folder / SNAPSHOTS_NAME
        self.log = folder / LOG_NAME
        self.steps = Steps(folder / RECORD_NAME, progress, earlier, begin)

    def remove_old_models(self) -> None:
        """Remove the models in this folder, complete and unfinished ones."""
        for folder in (self.models, self.snapshots):
            shutil.rmtree(folder, ignore_errors=True)

    @contextmanager
    def logged(self) -> Iterator[Path]:
        """Write COLMAP's messages to the log inside the block, and name the log in the error of a failure.

        Yields the folder of the messages, as ``colmap_log`` does.
        """
        with colmap_log(self.log) as log_folder:
            try:
                yield log_folder
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

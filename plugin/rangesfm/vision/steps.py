"""Steps that are done once, and their folder: what an earlier run into the same one did need not be done again."""

from __future__ import annotations

import hashlib
import json
import shutil
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rangesfm.colmap.log import colmap_log
from rangesfm.errors import ReconstructionError
from rangesfm.files.records import write_json
from rangesfm.progress import Progress

DATABASE_NAME, MODELS_NAME, LOG_NAME, RECORD_NAME = "database.db", "sparse", "mapper.log", "reconstruct.json"
RECONSTRUCTION_NAMES = (DATABASE_NAME, MODELS_NAME, LOG_NAME, RECORD_NAME)
"""What a reconstruction consists of."""
SNAPSHOTS_NAME = "mapping_snapshot"


def fingerprint(*inputs: Any) -> str:
    """The same text for the same inputs (plain values, in any nesting)."""
    return hashlib.sha256(json.dumps(inputs, sort_keys=True, default=str).encode()).hexdigest()


class Steps:
    """A series of steps, each of which needs the one before; their state is kept in a JSON file.

    Attributes:
        notes: what else is kept there, plain values by name; see ``note``.
        seconds: how long each step took that was done here, by name.
    """

    def __init__(
        self,
        record_path: Path,
        progress: Progress,
        earlier: Steps | None = None,
        begin: Callable[[Mapping[str, str]], None] = lambda passed: None,
    ):
        """Read the record.

        Args:
            earlier: the same steps with their results in another folder, complete: what was done there with the same
                inputs need not be done here.
            begin: called before the first step that has to be done here, with the inputs of those before it, by name.
                The record is read again after it.
        """
        self._path = record_path
        self._progress = progress
        self._earlier = earlier
        self._begin = begin
        self._passed: dict[str, str] = {}
        self._read_record()
        self.seconds: dict[str, float] = {}

    def run(
        self,
        name: str,
        inputs: str,
        output: Path,
        prepare: Callable[[], None],
        work: Callable[[], None],
        *,
        unfinished: Path | None = None,
    ) -> None:
        """Do a step, unless it was done with the same inputs and its output is still there.

        Args:
            inputs: fingerprint of all that the step depends on.
            prepare: clears the ground; skipped where ``work`` was interrupted on the same inputs.
            work: goes on from whatever it left when it was interrupted.
            unfinished: where it leaves that, if not in ``output``.
        """
        if self._earlier is not None:
            if self._earlier._has(name, inputs, output.relative_to(self._path.parent)):
                self._passed[name] = inputs
                self._progress.message(f"{name}: taken over from an earlier run")
                return
            self.begin()
        state = self._record.get(name, {})
        is_same = state.get("inputs") == inputs
        if is_same and state.get("done") and output.exists():
            self._progress.message(f"{name}: taken over from an earlier run")
            return
        self._progress.stage(name)
        start = time.perf_counter()
        if not (is_same and (output.exists() or (unfinished is not None and unfinished.exists()))):
            self.forget(name)
            prepare()
        self._set_state(name, inputs, done=False)
        work()
        self._set_state(name, inputs, done=True)
        self.seconds[name] = time.perf_counter() - start

    @property
    def has_begun(self) -> bool:
        """Whether results are in this folder, and not in that of the earlier steps."""
        return self._earlier is None

    def begin(self) -> None:
        """Do all from here on in this folder, on top of what the earlier steps have done."""
        self._begin(self._passed)
        self._earlier = None
        self._read_record()

    def has_done(self, steps: Mapping[str, str]) -> bool:
        """Whether the record says of all these steps, by name, that they were done with these inputs."""
        states = [(self._record.get(name, {}), inputs) for name, inputs in steps.items()]
        return all(state.get("done") is True and state.get("inputs") == inputs for state, inputs in states)

    def _has(self, name: str, inputs: str, output: Path) -> bool:
        return self.has_done({name: inputs}) and (self._path.parent / output).exists()

    def _read_record(self) -> None:
        source = self._path if self._earlier is None else self._earlier._path
        self._record, self.notes = _read(source, "steps"), _read(source, "notes")

    def forget(self, first: str) -> None:
        """Nothing is known any more of this step and of those after it."""
        names = list(self._record)
        for name in names[names.index(first) :] if first in names else ():
            del self._record[name]
        self._write()

    def note(self, name: str, value: dict[str, Any]) -> None:
        """Keep something for the next run, whatever becomes of the steps."""
        self.notes[name] = value
        if self._earlier is None:
            self._write()

    def _set_state(self, name: str, inputs: str, *, done: bool) -> None:
        self._record[name] = {"inputs": inputs, "done": done}
        self._write()

    def _write(self) -> None:
        write_json({"steps": self._record, "notes": self.notes}, self._path)


class Workspace:
    """Folder in which a reconstruction is made, and what an earlier run has done there.

    Args:
        folder: where that is.
        earlier: the steps of a complete reconstruction in another folder, to go on from.
        begin: see ``Steps``.
        log: of COLMAP's own words; None: in this folder.
    """

    def __init__(
        self,
        folder: Path,
        progress: Progress,
        *,
        earlier: Steps | None = None,
        begin: Callable[[Mapping[str, str]], None] = lambda passed: None,
        log: Path | None = None,
    ):
        self.progress = progress
        self.output = folder
        self.database = folder / DATABASE_NAME
        self.models = folder / MODELS_NAME
        self.snapshots = folder / SNAPSHOTS_NAME
        self.log = log or folder / LOG_NAME
        self.steps = Steps(folder / RECORD_NAME, progress, earlier, begin)

    def remove_old_models(self) -> None:
        """Remove the models that were made here, and those in the making."""
        for folder in (self.models, self.snapshots):
            shutil.rmtree(folder, ignore_errors=True)

    @contextmanager
    def logged(self) -> Iterator[None]:
        """Have COLMAP's own words in the log, and say in a failure where they are."""
        with colmap_log(self.log):
            try:
                yield
            except ReconstructionError as error:
                raise ReconstructionError(f"{error} (COLMAP's log: {self.log})") from error
            except RuntimeError as error:
                # What pycolmap raises where the database cannot be read or written says nothing of the disk.
                raise ReconstructionError(
                    f"COLMAP stopped: {error}; is there room on the disk, and for files of that size?"
                    f" (COLMAP's log: {self.log})"
                ) from error


def _read(path: Path, part: str) -> dict[str, dict[str, Any]]:
    try:
        entries = json.loads(path.read_text(encoding="utf-8"))[part]
        return {str(name): dict(entry) for name, entry in entries.items()}
    except (OSError, ValueError, AttributeError, TypeError, LookupError, RecursionError):
        return {}  # none yet, or not ours: nothing is known

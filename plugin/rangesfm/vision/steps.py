"""Steps that are done once, and their folder: what an earlier run into the same one did need not be done again."""

from __future__ import annotations

import hashlib
import json
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rangesfm.colmap.log import colmap_log
from rangesfm.errors import ReconstructionError
from rangesfm.files.records import write_json
from rangesfm.progress import Progress


def fingerprint(*inputs: Any) -> str:
    """The same text for the same inputs (plain values, in any nesting)."""
    return hashlib.sha256(json.dumps(inputs, sort_keys=True, default=str).encode()).hexdigest()


class Steps:
    """A series of steps, each of which needs the one before; their state is kept in a JSON file.

    Attributes:
        notes: what else is kept there, plain values by name; see ``note``.
        seconds: how long each step took that was done here, by name.
    """

    def __init__(self, record_path: Path, progress: Progress):
        self._path = record_path
        self._progress = progress
        self._record = _read(record_path, "steps")
        self.notes = _read(record_path, "notes")
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

    def forget(self, first: str) -> None:
        """Nothing is known any more of this step and of those after it."""
        names = list(self._record)
        for name in names[names.index(first) :] if first in names else ():
            del self._record[name]
        self._write()

    def note(self, name: str, value: dict[str, Any]) -> None:
        """Keep something for the next run, whatever becomes of the steps."""
        self.notes[name] = value
        self._write()

    def _set_state(self, name: str, inputs: str, *, done: bool) -> None:
        self._record[name] = {"inputs": inputs, "done": done}
        self._write()

    def _write(self) -> None:
        write_json({"steps": self._record, "notes": self.notes}, self._path)


class Workspace:
    """The output folder of a reconstruction: what is where, and what of it an earlier run has done.

    Args:
        before_change: called before models of an earlier run are removed or replaced.
        log: of COLMAP's own words; None: in this folder.
    """

    def __init__(
        self,
        output: Path,
        progress: Progress,
        before_change: Callable[[], None] = lambda: None,
        log: Path | None = None,
    ):
        self.progress = progress
        self.output = output
        self.database = output / "database.db"
        self.models = output / "sparse"
        self.snapshots = output / "mapping_snapshot"
        self.log = log or output / "mapper.log"
        self.steps = Steps(output / "reconstruct.json", progress)
        self._before_change = before_change

    def remove_old_models(self) -> None:
        self._before_change()
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


def _read(path: Path, part: str) -> dict[str, dict[str, Any]]:
    try:
        entries = json.loads(path.read_text(encoding="utf-8"))[part]
        return {str(name): dict(entry) for name, entry in entries.items()}
    except (OSError, ValueError, AttributeError, TypeError, LookupError, RecursionError):
        return {}  # none yet, or not ours: nothing is known

"""One survey in a process of its own: what ``python -m rangesfm.batch.survey_process PARENT`` does.

A worker starts it, so that a crash of the survey leaves the worker whole, what the survey needs of memory is known, and
it can be interrupted. It reads a pickled (survey, restart) and writes one JSON object a line: ``{"stage": name}``,
``{"num_done": n, "num_total": m}``, and last either ``{"done": ...}`` or ``{"failed": ...}``.
"""

from __future__ import annotations

import ctypes
import json
import os
import pickle
import signal
import sys
import threading
import time
from dataclasses import asdict
from typing import Any, TextIO

from rangesfm.failures import failure_of

_PR_SET_PDEATHSIG = 1
_UPDATE_INTERVAL_S = 0.5


class MessagesToWorker:
    """A run's progress, one message a line; not every one of the many updates."""

    def __init__(self, stream: TextIO):
        self._stream = stream
        self._last_update = 0.0

    def stage(self, name: str) -> None:
        self._last_update = time.monotonic()
        self.send({"stage": name})

    def update(self, num_done: int, num_total: int | None = None) -> None:
        now = time.monotonic()
        if now - self._last_update >= _UPDATE_INTERVAL_S:
            self._last_update = now
            self.send({"num_done": num_done, "num_total": num_total})

    def message(self, text: str) -> None:
        """Warnings are in the survey's own report."""

    def send(self, message: dict[str, Any]) -> None:
        self._stream.write(json.dumps(message) + "\n")
        self._stream.flush()


def main() -> None:
    # It may have been started where Ctrl-C is ignored.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    worker = MessagesToWorker(_own_stdout())
    try:
        survey, restart = pickle.load(sys.stdin.buffer)
        _end_with(int(sys.argv[1]))
        sys.argv = ["rangesfm", "batch", str(survey.source.path)]  # by which others know who writes to its folder
        from rangesfm.batch.rows import figures_of
        from rangesfm.pipeline import run_survey

        result = run_survey(survey, progress=worker, restart=restart).result
        reasons = result["scale"]["reasons"] if result["scale"]["verdict"] != "good" else ()
        worker.send({"done": {"figures": asdict(figures_of(result)), "reason": "; ".join(reasons)}})
    except (Exception, KeyboardInterrupt) as error:
        worker.send({"failed": asdict(failure_of(error))})


def _own_stdout() -> TextIO:
    """The worker's end of stdout; whatever else is printed goes to stderr."""
    stream = os.fdopen(os.dup(sys.stdout.fileno()), "w", encoding="utf-8")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    return stream


def _end_with(parent: int) -> None:
    """Be killed as soon as the worker is, however it ends: the survey's folder must be free for the next one."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != parent:
            os.kill(os.getpid(), signal.SIGKILL)
    else:  # the worker's end of stdin closes with it
        threading.Thread(target=lambda: (sys.stdin.buffer.read(), os._exit(1)), daemon=True).start()


if __name__ == "__main__":
    main()

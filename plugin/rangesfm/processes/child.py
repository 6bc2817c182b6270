"""The child's side of a supervised process: what it is given, how far it is, how it ended.

It is started as ``python -m MODULE PARENT``, reads one pickled object and writes one JSON object a line:
``{"stage": name}``, ``{"num_done": n, "num_total": m}``, and last either ``{"done": ...}`` or ``{"failed": ...}``.
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
from collections.abc import Callable
from dataclasses import asdict
from typing import Any, TextIO

from rangesfm.errors import failure_of

_PR_SET_PDEATHSIG = 1
_UPDATE_INTERVAL_S = 0.5


class MessagesToParent:
    """The progress of the work, one message a line; not every one of the many updates."""

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
        """Warnings are in what the work leaves."""

    def send(self, message: dict[str, Any]) -> None:
        self._stream.write(json.dumps(message) + "\n")
        self._stream.flush()


def work_for_parent(work: Callable[[Any, MessagesToParent], Any]) -> None:
    """Do what a process is there for.

    Args:
        work: called with what the process is given; what it returns (plain values), or the error that it raises, is
            the process's last message.
    """
    # It may have been started where Ctrl-C is ignored.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    parent = MessagesToParent(_own_stdout())
    try:
        given = pickle.load(sys.stdin.buffer)
        _end_with(int(sys.argv[1]))
        parent.send({"done": work(given, parent)})
    except (Exception, KeyboardInterrupt) as error:
        parent.send({"failed": asdict(failure_of(error))})


def _own_stdout() -> TextIO:
    """The parent's end of stdout; whatever else is printed goes to stderr."""
    stream = os.fdopen(os.dup(sys.stdout.fileno()), "w", encoding="utf-8")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    return stream


def _end_with(parent: int) -> None:
    """Be killed as soon as the parent is, however it ends: the folder written to must be free for the next one."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != parent:
            os.kill(os.getpid(), signal.SIGKILL)
    else:  # the parent's end of stdin closes with it
        threading.Thread(target=lambda: (sys.stdin.buffer.read(), os._exit(1)), daemon=True).start()

"""What a Dask worker does for a survey: it runs a process, passes on what that says, and tells how it ended."""

from __future__ import annotations

import os
import pickle
import signal
import socket
from dataclasses import dataclass
from typing import Any

from dask.system import CPU_COUNT
from distributed import get_worker
from distributed.system import MEMORY_LIMIT

from rangesfm.batch.shares import Share
from rangesfm.processes.supervision import Ended, child_command, supervise
from rangesfm.survey.settings import Survey

# By the system for want of memory, or by somebody from outside: then it is worth another try.
_FROM_OUTSIDE = (signal.SIGKILL, signal.SIGTERM, signal.SIGHUP)

_FAILED, _INTERRUPTED = 4, 130

# Batches whose surveys this worker is to leave alone.
_stopped: set[str] = set()


@dataclass(frozen=True)
class SurveyTask:
    """What a worker is given.

    Attributes:
        batch: the batch's own name, under which the worker tells how far it is.
        index: of the survey in the batch.
        share: what it may use.
        restart: do anew what earlier runs have done.
    """

    batch: str
    index: int
    survey: Survey
    share: Share
    restart: bool


class KilledError(Exception):
    """The survey's process was killed from outside; its text is one line for the user."""


def stop_batch(batch: str) -> None:
    """Interrupt the surveys of a batch, and begin no more of them on this worker."""
    _stopped.add(batch)


def run_on_worker(task: SurveyTask) -> dict[str, Any]:
    """Run a survey in a process of its own.

    Returns:
        ``{"done": {"figures": ..., "reason": ...}}`` or ``{"failed": {"message": ..., "exit_status": ...}}``.

    Raises:
        KilledError: the process was killed from outside, so that another attempt may well go through.
    """
    worker, host = get_worker(), socket.gethostname()

    def tell(message: dict[str, Any]) -> None:
        worker.log_event(task.batch, {"index": task.index, **message})

    if task.batch in _stopped:
        return _failed("interrupted", _INTERRUPTED)
    tell({"began_on": host})
    # The limit of all of a worker's tasks, if it has one, as clusters' workers do.
    memory_bytes = getattr(worker.memory_manager, "memory_limit", None) or MEMORY_LIMIT
    num_threads, memory_limit_bytes = task.share.on(host, worker.state.nthreads, CPU_COUNT, memory_bytes)
    own = task.survey.mapper.num_threads  # no more, though the file may ask for fewer
    survey = task.survey.changed({"mapper.num_threads": num_threads if own < 1 else min(own, num_threads)})
    ended = supervise(
        child_command("rangesfm.batch.survey_process"),
        pickle.dumps((survey, task.restart)),
        tell,
        environment={**os.environ, "OMP_NUM_THREADS": str(num_threads), "OPENBLAS_NUM_THREADS": "1"},
        memory_limit_bytes=memory_limit_bytes,
        is_stopped=lambda: task.batch in _stopped,
    )
    return _ending(ended, memory_limit_bytes)


def _ending(ended: Ended, memory_limit_bytes: int) -> dict[str, Any]:
    if ended.last is not None and ended.last.keys() & {"done", "failed"}:
        return ended.last
    if ended.needed_bytes is not None:
        needed, limit = (f"{num / 1e6:.0f} MB" for num in (ended.needed_bytes, memory_limit_bytes))
        why = f"needs more memory than its share: {needed}, and {limit} is what it may take"
        return _failed(f"{why}; give it more by --memory_limit, or fewer --num_workers", _FAILED)
    if ended.stopped:
        return _failed("interrupted", _INTERRUPTED)
    if ended.signal in _FROM_OUTSIDE:
        raise KilledError(
            f"its process was killed ({ended.signal.name}): by somebody, or by the system for want of memory"
        )
    return _failed(ended.how, _FAILED)


def _failed(message: str, exit_status: int) -> dict[str, Any]:
    return {"failed": {"message": message, "exit_status": exit_status}}

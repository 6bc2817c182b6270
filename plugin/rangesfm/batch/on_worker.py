"""What a Dask worker does for a survey: it runs a process, passes on what that says, and tells how it ended."""

from __future__ import annotations

import base64
import os
import pickle
import signal
import socket
from dataclasses import dataclass
from typing import Any

from dask.system import CPU_COUNT
from distributed import get_worker
from distributed.system import MEMORY_LIMIT

from rangesfm.batch.jobs import Share
from rangesfm.errors import FAILED, INTERRUPTED, Failure
from rangesfm.processes.supervision import Ended, child_command, supervise
from rangesfm.survey.settings import Survey
from rangesfm.vision.submaps import Submap

# By the system for want of memory, or by somebody from outside: then it is worth another try.
_FROM_OUTSIDE = (signal.SIGKILL, signal.SIGTERM, signal.SIGHUP)

# Batches whose surveys this worker is to leave alone.
_stopped: set[str] = set()


@dataclass(frozen=True)
class SurveyTask:
    """What a worker is given: a survey, or a part of one that is mapped in submaps.

    Attributes:
        batch: the batch's own name, under which the worker tells how far it is.
        index: of the survey in the batch.
        share: what it may use.
        restart: do anew what earlier runs have done.
        only_prepare: find the submaps that are to be mapped, and no more.
        submap: only map this one.
        begins: whether the survey begins with it.
    """

    batch: str
    index: int
    survey: Survey
    share: Share
    restart: bool
    only_prepare: bool = False
    submap: Submap | None = None
    begins: bool = True


class KilledError(Exception):
    """The survey's process was killed from outside; its text is one line for the user."""


def stop_batch(batch: str) -> None:
    """Interrupt the surveys of a batch, and begin no more of them on this worker."""
    _stopped.add(batch)


def run_on_worker(task: SurveyTask) -> Any:
    """Run a survey, or a part of one, in a process of its own.

    Returns:
        The Failure, or what the process ended with: ``{"figures": ..., "reason": ...}``; of a survey only prepared a
        tuple of Submap; of a submap None.

    Raises:
        KilledError: the process was killed from outside, so that another attempt may well go through.
    """
    worker, host = get_worker(), socket.gethostname()

    def tell(message: dict[str, Any]) -> None:
        if task.submap is None:  # of many at once the batch itself counts those that are done
            worker.log_event(task.batch, {"index": task.index, **message})

    if task.batch in _stopped:
        return Failure("interrupted", INTERRUPTED)
    if task.begins:
        tell({"began_on": host})
    # The limit of all of a worker's tasks, if it has one, as clusters' workers do.
    memory_bytes = getattr(worker.memory_manager, "memory_limit", None) or MEMORY_LIMIT
    num_threads, memory_limit_bytes = task.share.on(host, worker.state.nthreads, CPU_COUNT, memory_bytes)
    module, given = _work(task, num_threads)
    ended = supervise(
        child_command(module),
        given,
        tell,
        environment={**os.environ, "OMP_NUM_THREADS": str(num_threads), "OPENBLAS_NUM_THREADS": "1"},
        memory_limit_bytes=memory_limit_bytes,
        is_stopped=lambda: task.batch in _stopped,
    )
    if ended.last is None or not ended.last.keys() & {"done", "failed"}:
        return _why_it_did_not_end(ended, memory_limit_bytes)
    if "failed" in ended.last:
        return Failure(**ended.last["failed"])
    done = ended.last["done"]
    return pickle.loads(base64.b64decode(done["submaps"])) if task.only_prepare else done


def _work(task: SurveyTask, num_threads: int) -> tuple[str, bytes]:
    """The module that does it, and what that is given; with no more threads, though the file may ask for fewer."""
    own = task.survey.mapper.num_threads
    num = num_threads if own < 1 else min(own, num_threads)
    if task.submap is not None:
        return "rangesfm.vision.submap_process", pickle.dumps(task.submap.with_threads(num))
    survey = task.survey.changed({"mapper.num_threads": num})
    return "rangesfm.batch.survey_process", pickle.dumps((survey, task.restart, task.only_prepare))


def _why_it_did_not_end(ended: Ended, memory_limit_bytes: int) -> Failure:
    if ended.needed_bytes is not None:
        needed, limit = (f"{num / 1e6:.0f} MB" for num in (ended.needed_bytes, memory_limit_bytes))
        why = f"needs more memory than its share: {needed}, and {limit} is what it may take"
        return Failure(f"{why}; give it more by --memory_limit, or fewer --num_workers", FAILED)
    if ended.stopped:
        return Failure("interrupted", INTERRUPTED)
    if ended.signal in _FROM_OUTSIDE:
        raise KilledError(
            f"its process was killed ({ended.signal.name}): by somebody, or by the system for want of memory"
        )
    return Failure(ended.how, FAILED)

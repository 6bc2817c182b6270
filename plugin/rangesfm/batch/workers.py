"""Dask workers, on this machine or of an existing scheduler, and the run of one survey on a worker."""

from __future__ import annotations

import logging
import os
import pickle
import signal
import socket
import tempfile
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import dask
from dask.system import CPU_COUNT
from distributed import Client, Scheduler, Security, SpecCluster, Worker, get_worker
from distributed.comm import get_address_host_port
from distributed.system import MEMORY_LIMIT

from rangesfm.batch.jobs import Share
from rangesfm.errors import FAILED, INTERRUPTED, Failure, InputError
from rangesfm.processes.supervision import Ended, child_command, supervise
from rangesfm.survey.settings import Survey

_CONNECT_S = 10
_IN_PROCESS = "inproc://"
# Dask's web pages and profiling are switched off.
_CONFIG = {
    "distributed.scheduler.http.routes": [],
    "distributed.worker.http.routes": [],
    "distributed.admin.system-monitor.interval": "5s",
    "distributed.worker.profile.enabled": False,
    "distributed.comm.timeouts.connect": f"{_CONNECT_S}s",
}
_SILENT = logging.CRITICAL + 1
# Signals by which the system, when memory is short, or a user kills a process. Such a survey is tried again.
_FROM_OUTSIDE = (signal.SIGKILL, signal.SIGTERM, signal.SIGHUP)
# Batches whose surveys this worker must not run any more.
_stopped: set[str] = set()


class _NoServer:
    """Mixin for a scheduler or worker without Dask's web server, which would open a port even if it has no pages."""

    def start_http_server(self, *arguments: Any, **options: Any) -> None:
        """Start nothing."""


class _Scheduler(_NoServer, Scheduler):  # type: ignore[misc] # Dask has no type hints
    pass


class _Worker(_NoServer, Worker):  # type: ignore[misc] # Dask has no type hints
    pass


@contextmanager
def local_workers(num: int) -> Iterator[Client]:
    """Start workers in this process, each for one survey at a time.

    They need no processes of their own, because every survey has one. They open no port, because Dask runs any code
    that is sent to its port, so that another user of the machine could run code as this user.
    """
    with (
        dask.config.set(_CONFIG),
        _silence(),
        tempfile.TemporaryDirectory(prefix="rangesfm_batch_", ignore_cleanup_errors=True) as scratch,
        SpecCluster(
            scheduler={"cls": _Scheduler, "options": {"protocol": _IN_PROCESS, "dashboard": False}},
            workers={key: {"cls": _Worker, "options": _worker_options(scratch)} for key in range(num)},
            silence_logs=_SILENT,
        ) as cluster,
        Client(cluster, set_as_default=False) as client,
    ):
        yield client


def _worker_options(scratch: str) -> dict[str, Any]:
    # Dask does not watch the memory, because each survey's process is watched.
    return {"protocol": _IN_PROCESS, "nthreads": 1, "memory_limit": 0, "local_directory": scratch}


@contextmanager
def workers_of(scheduler: str) -> Iterator[Client]:
    """Connect to the workers of a scheduler, by its address.

    For an address that begins with tls://, certificates are taken from Dask's own configuration.

    Raises:
        InputError: the scheduler does not answer, or certificates are missing.
    """
    with dask.config.set(_CONFIG), _silence():
        try:
            get_address_host_port(scheduler)
            _require_certificates(scheduler)
            client = Client(scheduler, timeout=_CONNECT_S, set_as_default=False)
        except (OSError, ValueError, ImportError, RuntimeError) as error:
            reason = " ".join(str(error).split())
            raise InputError(
                f"no Dask scheduler answers at '{scheduler}' (expected an address like tcp://head:8786): {reason}"
            ) from None
        with client:
            yield client


def _require_certificates(scheduler: str) -> None:
    """Raise ValueError if an address and Dask's configuration disagree on encryption; Dask's client would hang."""
    security = Security()
    if scheduler.startswith("tls://"):
        if security.get_connection_args("client")["ssl_context"] is None:
            expected = "distributed.comm.tls.ca-file, client.cert and client.key"
            raise ValueError(f"tls:// needs certificates, expected {expected} in Dask's configuration")
    elif security.require_encryption:
        raise ValueError("Dask's configuration says require-encryption, expected an address like tls://head:8786")


@contextmanager
def _silence() -> Iterator[None]:
    """Switch off logging inside the block, because Dask logs a traceback for each worker that is lost."""
    before = logging.root.manager.disable
    logging.disable(logging.CRITICAL)
    try:
        yield
    finally:
        logging.disable(before)


def num_at_once(client: Client) -> Mapping[str, int]:
    """Return the number of tasks that each host runs at once, by the workers present now.

    Raises:
        InputError: the workers cannot import this package.
    """
    try:
        slots = client.run(_slots).values()
    except Exception as error:  # any error on a worker is raised here
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        raise InputError(f"the workers of the scheduler cannot run surveys ({reason})") from None
    num = Counter[str]()
    for host, num_threads in slots:
        num[host] += num_threads
    return num


def _slots(dask_worker: Any) -> tuple[str, int]:
    return socket.gethostname(), dask_worker.state.nthreads


@dataclass(frozen=True)
class SurveyTask:
    """A survey for a worker.

    Attributes:
        batch: name of the batch, which is the topic of the worker's messages.
        index: of the survey in the batch.
        survey: its settings.
        share: the resources that it may use.
        restart: repeat what earlier runs have done.
    """

    batch: str
    index: int
    survey: Survey
    share: Share
    restart: bool


class KilledError(Exception):
    """The survey's process was killed from outside; the text is one line for the user."""


def stop_batch(batch: str) -> None:
    """Interrupt the surveys of a batch on this worker, and begin no more of them."""
    _stopped.add(batch)


def run_on_worker(task: SurveyTask) -> Any:
    """Run a survey in a process of its own.

    Returns:
        A Failure, or the result of the process: ``{"figures": ..., "reason": ...}``.

    Raises:
        KilledError: the process was killed from outside, so that another attempt may succeed.
    """
    worker, host = get_worker(), socket.gethostname()

    def tell(message: dict[str, Any]) -> None:
        worker.log_event(task.batch, {"index": task.index, **message})

    if task.batch in _stopped:
        return Failure("interrupted", INTERRUPTED)
    tell({"began_on": host})
    # A worker of a cluster may have a memory limit for all its tasks.
    memory_bytes = getattr(worker.memory_manager, "memory_limit", None) or MEMORY_LIMIT
    num_threads, memory_limit_bytes = task.share.on(host, worker.state.nthreads, CPU_COUNT, memory_bytes)
    own = task.survey.mapper.num_threads  # the survey file may ask for fewer threads, but not for more
    survey = task.survey.changed({"mapper.num_threads": num_threads if own < 1 else min(own, num_threads)})
    ended = supervise(
        child_command("rangesfm.batch.survey_process"),
        pickle.dumps((survey, task.restart)),
        tell,
        environment={**os.environ, "OMP_NUM_THREADS": str(num_threads), "OPENBLAS_NUM_THREADS": "1"},
        memory_limit_bytes=memory_limit_bytes,
        is_stopped=lambda: task.batch in _stopped,
    )
    if not ended.last.keys() & {"done", "failed"}:
        return _why_it_did_not_end(ended, memory_limit_bytes)
    if "failed" in ended.last:
        return Failure(**ended.last["failed"])
    return ended.last["done"]


def _why_it_did_not_end(ended: Ended, memory_limit_bytes: int) -> Failure:
    if ended.needed_bytes:
        needed, limit = (f"{num / 1e6:.0f} MB" for num in (ended.needed_bytes, memory_limit_bytes))
        why = f"needs more memory than its share: it took {needed}, and its limit is {limit}"
        return Failure(f"{why}; set a larger --memory_limit or fewer --num_workers", FAILED)
    if ended.stopped:
        return Failure("interrupted", INTERRUPTED)
    if ended.signal in _FROM_OUTSIDE:
        raise KilledError(
            f"its process was killed ({ended.signal.name}) by a user, or by the system because memory was short"
        )
    return Failure(ended.how, FAILED)

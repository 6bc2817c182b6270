"""Those who run the surveys of a batch: threads of this process, or the Dask workers of a scheduler.

Each survey is run in a process of its own. A crash of the survey then does not affect who runs it, its memory is known,
and it can be interrupted.
"""

from __future__ import annotations

import logging
import os
import queue
import signal
import socket
import threading
import uuid
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any

import dask
from dask.system import CPU_COUNT
from distributed import Client, Security, get_worker, wait
from distributed.comm import get_address_host_port
from distributed.system import MEMORY_LIMIT

from rangesfm.batch.jobs import BatchOptions, share_this_machine
from rangesfm.errors import FAILED, INTERRUPTED, Failure, InputError
from rangesfm.survey.settings import Survey
from rangesfm.util.processes.supervision import call_by_name, supervise

MAX_STOP_S = 30.0  # longer than it takes to interrupt a survey
_CONNECT_S = 10
_NUM_ATTEMPTS = 3  # to run a survey whose process is killed; Dask itself counts attempts whose worker was killed
# Signals by which the system, when memory is short, or a user kills a process. Such a survey is tried again.
_FROM_OUTSIDE = (signal.SIGKILL, signal.SIGTERM, signal.SIGHUP)
# Batches whose surveys this Dask worker must not run any more.
_stopped: set[str] = set()


@dataclass(frozen=True)
class Crew:
    """Those who run the surveys of a batch.

    Attributes:
        submit: has the survey with this index run, and returns a future with what ``run_apart`` returns.
        stop: interrupts all surveys, and waits for their end, so that nothing is left half-written.
        is_lost: whether no more surveys can end, because nobody answers.
    """

    submit: Callable[[int, Survey], Any]
    stop: Callable[[], None]
    is_lost: Callable[[], bool]


@contextmanager
def on_this_machine(
    options: BatchOptions, num_surveys: int, inbox: queue.SimpleQueue[Any], say: Callable[[str], None]
) -> Iterator[Crew]:
    """Yield threads of this process, as many as cores and memory allow.

    Args:
        inbox: is put the messages of surveys, each with the survey's index before it.
        say: is told remarks for the user.

    Raises:
        InputError: more threads are asked for than there are cores.
    """
    num_at_once, num_threads, memory_bytes, note = share_this_machine(options, num_surveys, CPU_COUNT, MEMORY_LIMIT)
    if note:
        say(note)
    stop = threading.Event()

    with ThreadPoolExecutor(num_at_once, thread_name_prefix="survey") as pool:

        def submit(index: int, survey: Survey) -> Any:
            def tell(message: dict[str, Any]) -> None:
                inbox.put((index, message))

            return pool.submit(run_apart, survey, options.restart, num_threads, memory_bytes, tell, stop.is_set)

        def stop_all() -> None:
            stop.set()
            pool.shutdown(cancel_futures=True)

        try:
            yield Crew(submit, stop_all, lambda: False)
        finally:
            stop.set()


@contextmanager
def on_scheduler(options: BatchOptions, inbox: queue.SimpleQueue[Any], say: Callable[[str], None]) -> Iterator[Crew]:
    """Yield the workers of a Dask scheduler; arguments as in ``on_this_machine``.

    Raises:
        InputError: there is no such scheduler, or its workers cannot run surveys.
    """
    with workers_of(options.scheduler) as client:
        at_once = num_at_once(client)
        if not at_once:
            say(f"{options.scheduler} has no workers yet: the surveys wait for them")
        batch, futures = f"rangesfm-batch-{uuid.uuid4().hex}", list[Any]()
        client.subscribe_topic(batch, lambda event: inbox.put((*event[1],)))  # event[0] is its time

        def submit(index: int, survey: Survey) -> Any:
            task = batch, index, survey, options, at_once
            key = f"{batch}-{index}"
            futures.append(client.submit(_run_on_worker, *task, key=key, pure=False))
            return futures[-1]

        def stop() -> None:
            try:
                client.run(_stop_on_worker, batch, on_error="ignore")
                with client.as_current():
                    wait(futures, timeout=MAX_STOP_S)
                client.cancel(futures)
            except (OSError, RuntimeError):  # the workers are gone, or do not answer (TimeoutError)
                pass

        yield Crew(submit, stop, lambda: client.status != "running")


@contextmanager
def workers_of(scheduler: str) -> Iterator[Client]:
    """Connect to the workers of a scheduler, by its address.

    For an address that begins with tls://, certificates are taken from Dask's own configuration.

    Raises:
        InputError: the scheduler does not answer, or certificates are missing.
    """
    before = logging.root.manager.disable
    logging.disable(logging.CRITICAL)  # Dask logs a traceback for each worker that is lost
    try:
        with dask.config.set({"distributed.comm.timeouts.connect": f"{_CONNECT_S}s"}):
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
    finally:
        logging.disable(before)


def _require_certificates(scheduler: str) -> None:
    """Raise ValueError if an address and Dask's configuration disagree on encryption; Dask's client would hang."""
    security = Security()
    if scheduler.startswith("tls://"):
        if security.get_connection_args("client")["ssl_context"] is None:
            expected = "distributed.comm.tls.ca-file, client.cert and client.key"
            raise ValueError(f"tls:// needs certificates, expected {expected} in Dask's configuration")
    elif security.require_encryption:
        raise ValueError("Dask's configuration says require-encryption, expected an address like tls://head:8786")


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


def _run_on_worker(batch: str, index: int, survey: Survey, options: BatchOptions, at_once: Mapping[str, int]) -> Any:
    """Run a survey on a Dask worker.

    Args:
        batch: name of the batch, which is the topic of the worker's messages.
        at_once: number of surveys at once on each host, as far as it was known when the batch began.
    """
    worker = get_worker()
    # A machine's cores and memory are divided by the surveys that run there at once. A worker may have a memory limit.
    num = max(worker.state.nthreads, at_once.get(socket.gethostname(), 0))
    memory_bytes = getattr(worker.memory_manager, "memory_limit", None) or MEMORY_LIMIT
    return run_apart(
        survey,
        options.restart,
        options.num_threads or max(1, CPU_COUNT // num),
        options.memory_limit_bytes or memory_bytes // num,
        lambda message: worker.log_event(batch, (index, message)),
        lambda: batch in _stopped,
    )


def _stop_on_worker(batch: str) -> None:
    """Interrupt the surveys of a batch on this worker, and begin no more of them."""
    _stopped.add(batch)


def run_apart(
    survey: Survey,
    restart: bool,
    num_threads: int,
    memory_limit_bytes: int,
    tell: Callable[[dict[str, Any]], object],
    is_stopped: Callable[[], bool],
) -> Any:
    """Run a survey in a process of its own, and again if that is killed from outside, because it may succeed then.

    Returns:
        A Failure, or the result of the process: ``{"figures": ..., "reason": ...}``.
    """
    own = survey.mapper.num_threads  # the survey file may ask for fewer threads, but not for more
    survey = survey.changed({"mapper.num_threads": num_threads if own < 1 else min(own, num_threads)})
    killed = ""
    for _ in range(_NUM_ATTEMPTS):
        if is_stopped():
            return Failure("interrupted", INTERRUPTED)
        tell({"began_on": socket.gethostname()})
        ended = supervise(
            # By its name, because what runs a batch loads no estimator.
            partial(call_by_name, "rangesfm.batch.survey_process:run_in_batch", survey, restart),
            tell,
            environment={**os.environ, "OMP_NUM_THREADS": str(num_threads), "OPENBLAS_NUM_THREADS": "1"},
            memory_limit_bytes=memory_limit_bytes,
            is_stopped=is_stopped,
        )
        if "done" in ended.last:
            return ended.last["done"]
        if "failed" in ended.last:
            return Failure(**ended.last["failed"])
        if ended.needed_bytes:
            needed, limit = (f"{num / 1e6:.0f} MB" for num in (ended.needed_bytes, memory_limit_bytes))
            why = f"needs more memory than its share: it took {needed}, and its limit is {limit}"
            return Failure(f"{why}; set a larger --memory_limit or fewer --num_workers", FAILED)
        if ended.stopped:
            return Failure("interrupted", INTERRUPTED)
        if ended.signal not in _FROM_OUTSIDE:
            return Failure(ended.how, FAILED)
        killed = f"its process was killed ({ended.signal.name}) by a user, or by the system because memory was short"
    return Failure(f"{killed}; this happened at every attempt", FAILED)

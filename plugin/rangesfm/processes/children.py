"""Pieces of work of one kind, each done by a process of its own, some at once."""

from __future__ import annotations

import os
import pickle
import threading
from collections import deque
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from typing import Any

from rangesfm.errors import ReconstructionError
from rangesfm.processes.supervision import child_command, supervise

_POLL_INTERVAL_S = 0.2


def run_children(
    module: str, given: Iterable[object], num_at_once: int, update: Callable[[int], None]
) -> Generator[None, None, None]:
    """Have pieces of work done, each by a process; yields once for each that is done, in their order.

    Leaving the iteration (``contextlib.closing``) interrupts the processes, and waits for their end.

    Args:
        module: what they run, by ``work_for_parent``; it ends with the number of items that it has done.
        given: what each process is given. Not taken from before there is need of it: no more than one waits.
        update: called several times a second with the number of items that all of them have done.

    Raises:
        ReconstructionError: a process failed; the others were interrupted.
    """
    stop, num_done = threading.Event(), list[int]()
    pending: deque[Future[None]] = deque()

    def run(place: int, work: bytes) -> None:
        if not stop.is_set():
            _run_child(module, work, lambda num: num_done.__setitem__(place, num), stop)

    def wait_for_first() -> None:
        while not wait([pending[0]], timeout=_POLL_INTERVAL_S).done:
            update(sum(num_done))
            for future in pending:
                if future.done():
                    future.result()
        pending.popleft().result()
        update(sum(num_done))

    with ThreadPoolExecutor(num_at_once, thread_name_prefix="child") as executor:
        try:
            for place, work in enumerate(given):
                num_done.append(0)
                pending.append(executor.submit(run, place, pickle.dumps(work)))
                if len(pending) > num_at_once:
                    wait_for_first()
                    yield
            while pending:
                wait_for_first()
                yield
        except BaseException:
            stop.set()
            raise


def _run_child(module: str, work: bytes, tell: Callable[[int], None], stop: threading.Event) -> None:
    def listen(message: dict[str, Any]) -> None:
        if "num_done" in message:
            tell(message["num_done"])

    ended = supervise(
        child_command(module),
        work,
        listen,
        environment={**os.environ, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"},
        memory_limit_bytes=None,
        is_stopped=stop.is_set,
    )
    last = ended.last or {}
    if "done" in last:
        tell(last["done"])
    elif not ended.stopped:
        raise ReconstructionError(last["failed"]["message"] if "failed" in last else ended.how)

"""Dask: workers of this machine, or a scheduler that is there already."""

from __future__ import annotations

import logging
import socket
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import dask
from dask.system import CPU_COUNT
from distributed import Client, LocalCluster
from distributed.comm import get_address_host_port
from distributed.system import MEMORY_LIMIT

from rangesfm.errors import InputError

_CONNECT_S = 10
# Nothing is served beside the work itself.
_CONFIG = {
    "distributed.scheduler.http.routes": [],
    "distributed.worker.http.routes": [],
    "distributed.admin.system-monitor.interval": "5s",
    "distributed.worker.profile.enabled": False,
    "distributed.comm.timeouts.connect": f"{_CONNECT_S}s",
}
_SILENT = logging.CRITICAL + 1


def this_machine() -> tuple[int, int]:
    """Its cores and the bytes of its memory, as far as this process may use them."""
    return CPU_COUNT, MEMORY_LIMIT


@contextmanager
def local_workers(num: int) -> Iterator[Client]:
    """Processes of this machine, each for one survey at a time, which only this machine can speak to."""
    with (
        dask.config.set(_CONFIG),
        _silence(),
        tempfile.TemporaryDirectory(prefix="rangesfm_batch_", ignore_cleanup_errors=True) as scratch,
        LocalCluster(
            n_workers=num,
            threads_per_worker=1,
            processes=True,
            host="127.0.0.1",
            dashboard_address=None,
            scheduler_kwargs={"dashboard_address": "127.0.0.1:0"},
            silence_logs=_SILENT,
            memory_limit=0,  # surveys are watched, and named
            local_directory=scratch,
            # A Ctrl-C in the terminal is for the command, which stops them in order.
            preload=["import signal; signal.signal(signal.SIGINT, signal.SIG_IGN)"],
        ) as cluster,
        Client(cluster, set_as_default=False) as client,
    ):
        yield client


@contextmanager
def workers_of(scheduler: str) -> Iterator[Client]:
    """The workers of a scheduler, by its address.

    Raises:
        InputError: it does not answer.
    """
    with dask.config.set(_CONFIG), _silence():
        try:
            get_address_host_port(scheduler)
            client = Client(scheduler, timeout=_CONNECT_S, set_as_default=False)
        except (OSError, ValueError, ImportError, RuntimeError) as error:
            reason = " ".join(str(error).split())
            raise InputError(f"no Dask scheduler answers at '{scheduler}', as tcp://head:8786: {reason}") from None
        with client:
            yield client


@contextmanager
def _silence() -> Iterator[None]:
    """Nobody but the batch itself speaks to the user: Dask logs each worker that is lost, with a traceback."""
    before = logging.root.manager.disable
    logging.disable(logging.CRITICAL)
    try:
        yield
    finally:
        logging.disable(before)


def num_at_once(client: Client) -> Mapping[str, int]:
    """How many tasks each host does at once, by the workers that are there now.

    Raises:
        InputError: they do not know this package.
    """
    try:
        slots = client.run(_slots).values()
    except Exception as error:  # whatever went wrong there, it is raised here
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        raise InputError(f"the workers of the scheduler cannot run surveys ({reason})") from None
    num: dict[str, int] = {}
    for host, num_threads in slots:
        num[host] = num.get(host, 0) + num_threads
    return num


def _slots(dask_worker: Any) -> tuple[str, int]:
    return socket.gethostname(), dask_worker.state.nthreads

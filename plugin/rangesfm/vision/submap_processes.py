"""Submaps mapped on this machine, some at once, each by a process of its own."""

from __future__ import annotations

import os
import pickle
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from typing import Any

from rangesfm.errors import ReconstructionError
from rangesfm.processes.supervision import child_command, supervise
from rangesfm.progress import Progress
from rangesfm.vision.submaps import Submap

_POLL_INTERVAL_S = 0.2


def map_submaps(submaps: Sequence[Submap], num_at_once: int, progress: Progress) -> None:
    """Map the submaps that are not mapped yet.

    Args:
        num_at_once: they share the threads of their options.

    Raises:
        ReconstructionError: the process of one of them failed; the others were stopped.
        KeyboardInterrupt: once all processes have ended.
    """
    missing = [submap for submap in submaps if not submap.is_mapped]
    if num_mapped := len(submaps) - len(missing):
        progress.message(f"mapping: {num_mapped} of {len(submaps)} submaps are taken over from an earlier run")
    num_total = sum(len(submap.photos.names) for submap in missing)
    stop, num_done = threading.Event(), [0] * len(missing)

    def map_one(k: int) -> None:
        _map_in_a_process(_sharing_threads(missing[k], num_at_once), lambda num: num_done.__setitem__(k, num), stop)

    with ThreadPoolExecutor(num_at_once, thread_name_prefix="submap") as executor:
        try:
            futures = [executor.submit(map_one, k) for k in range(len(missing))]
            pending = set(futures)
            while pending:
                ended, pending = wait(pending, timeout=_POLL_INTERVAL_S)
                progress.update(sum(num_done), num_total)
                for future in ended:
                    future.result()
        except BaseException:
            stop.set()
            raise


def _map_in_a_process(submap: Submap, tell: Callable[[int], None], stop: threading.Event) -> None:
    if stop.is_set():
        return

    def listen(message: dict[str, Any]) -> None:
        if "num_done" in message:
            tell(message["num_done"])

    ended = supervise(
        child_command("rangesfm.vision.submap_process"),
        pickle.dumps(submap),
        listen,
        environment={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
        memory_limit_bytes=None,
        is_stopped=stop.is_set,
    )
    if "done" not in (ended.last or {}) and not ended.stopped:
        failed = (ended.last or {}).get("failed")
        raise ReconstructionError(f"submap {submap.folder.name}: {failed['message'] if failed else ended.how}")
    tell(len(submap.photos.names))


def _sharing_threads(submap: Submap, num_at_once: int) -> Submap:
    if num_at_once == 1:
        return submap
    num_threads = submap.mapper.num_threads if submap.mapper.num_threads > 0 else os.cpu_count() or 1
    return submap.with_threads(max(1, num_threads // num_at_once))

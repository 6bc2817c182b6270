"""Long calls into COLMAP that Ctrl-C can end."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from typing import TypeVar

import pycolmap

from rangesfm.errors import ReconstructionError
from rangesfm.progress import Progress

Result = TypeVar("Result")

_POLL_INTERVAL_S = 0.2


def run_in_background(
    work: Callable[[pycolmap.CancellationToken], Result],
    progress: Progress,
    count: Callable[[], int],
    num_total: int,
) -> Result:
    """Run ``work`` in a thread and report its progress meanwhile.

    Python notices Ctrl-C in the main thread only, and only between its own instructions, so that a call into COLMAP in
    the main thread would delay it for minutes. An exception that interrupts the waiting cancels the work, and is raised
    once the work has ended.

    Args:
        work: passes the token on to COLMAP. If its calls do not release Python's global lock, Ctrl-C and progress are
            handled only when they call back.
        count: returns how many of ``num_total`` items are done; it may exceed them.

    Raises:
        ReconstructionError: COLMAP raised an error of its own.
    """
    token = pycolmap.CancellationToken()
    with ThreadPoolExecutor(max_workers=1, thread_name_prefix="colmap") as executor:
        # After a Ctrl-C while the thread starts, nothing would wait for it. So it starts with a task that does nothing.
        executor.submit(int).result()
        try:
            future = executor.submit(work, token)
            while not wait([future], timeout=_POLL_INTERVAL_S).done:
                progress.update(min(count(), num_total), num_total)
        except BaseException as error:
            token.cancel()
            if isinstance(error, KeyboardInterrupt):
                progress.message("interrupted: COLMAP finishes its current photos")
            raise
    try:
        result = future.result()
    except (RuntimeError, ValueError) as error:
        raise ReconstructionError("COLMAP stopped: " + " ".join(str(error).split())) from error
    progress.update(min(count(), num_total), num_total)
    return result

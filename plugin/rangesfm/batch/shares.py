"""What each survey may use of a machine: its threads and its memory."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from rangesfm.errors import InputError

_USUAL_BYTES = 2 * 10**9  # what a reconstruction of some hundred photos stays below


@dataclass(frozen=True)
class BatchOptions:
    """How a batch is run.

    Attributes:
        scheduler: address of a Dask scheduler; None: workers of this machine.
        num_workers: surveys at once on this machine; None: as many as it has cores and memory for.
        num_threads: of each survey; None: its worker's share of the cores.
        memory_limit_bytes: of each survey; None: its worker's share of the memory.
        restart: do anew what earlier runs have done.
    """

    scheduler: str | None = None
    num_workers: int | None = None
    num_threads: int | None = None
    memory_limit_bytes: int | None = None
    restart: bool = False


@dataclass(frozen=True)
class Share:
    """What one survey may use; None: what there is on its worker's machine, over the surveys it does at once.

    Attributes:
        num_at_once: surveys at once by host, as far as it is known beforehand.
    """

    num_threads: int | None = None
    memory_limit_bytes: int | None = None
    num_at_once: Mapping[str, int] = field(default_factory=dict)

    def on(self, host: str, num_slots: int, num_cores: int, memory_bytes: int) -> tuple[int, int]:
        """Number of threads and of bytes for a survey on a machine, of which the asking worker has ``num_slots``."""
        num = max(num_slots, self.num_at_once.get(host, 0))
        return self.num_threads or max(1, num_cores // num), self.memory_limit_bytes or memory_bytes // num


def share_this_machine(
    options: BatchOptions, num_surveys: int, num_cores: int, memory_bytes: int
) -> tuple[int, Share, str | None]:
    """How many workers, what each survey may use, and what is to be said about it.

    Raises:
        InputError: more threads are asked for than there are cores.
    """
    for_cores = num_cores // (options.num_threads or 1)
    for_memory = memory_bytes // (options.memory_limit_bytes or _USUAL_BYTES)
    num_workers = max(1, min(options.num_workers or min(for_cores, for_memory), num_surveys))
    num_threads = options.num_threads or max(1, num_cores // num_workers)
    asked_for = f"{num_workers} workers with {num_threads} threads each, and this machine has {num_cores} cores"
    if num_threads > 1 and num_workers * num_threads > num_cores:
        raise InputError(f"{asked_for}: expected no more threads than cores, by --num_workers or --num_threads")
    note = f"{asked_for}: each survey takes longer" if num_workers > num_cores else None
    return num_workers, Share(num_threads, options.memory_limit_bytes or memory_bytes // num_workers), note

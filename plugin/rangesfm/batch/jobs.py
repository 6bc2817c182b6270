"""Input of a batch: its surveys, which are read before anything starts, and the resources that each may use."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from rangesfm.errors import Failure, InputError, failure_of, one_line
from rangesfm.files.folders import real_path
from rangesfm.survey.settings import Survey
from rangesfm.survey.survey_reader import read_survey

_USUAL_BYTES = 2 * 10**9  # a reconstruction of some hundred photos needs less memory than this


@dataclass(frozen=True)
class Job:
    """One survey of a batch.

    Attributes:
        name: its file as the user wrote it, on one line, without characters that cannot be printed.
        survey: its settings; None if the file cannot be used.
        failure: why the file cannot be used; None if it can.
    """

    name: str
    survey: Survey | None
    failure: Failure | None = None


def read_jobs(paths: Sequence[str | Path], overrides: Mapping[str, object], output_path: Path) -> tuple[Job, ...]:
    """Read the survey files of a batch.

    Args:
        overrides: values by dotted key that replace those in every file; see ``read_survey``.
        output_path: folder of the batch's own table.

    Returns:
        A job for each file, also for files that cannot be used.

    Raises:
        InputError: two surveys write to the same folder, or one writes to the batch's own.
    """
    jobs = tuple(_read_job(path, overrides) for path in paths)
    writes_to = {real_path(output_path): "the table of the batch"}
    for job in jobs:
        if job.survey is None:
            continue
        folder = real_path(job.survey.output.path)
        if folder in writes_to:
            raise InputError(
                f"writes to {folder}, as {writes_to[folder]} does: expected another [output] path", job.name
            )
        writes_to[folder] = job.name
    return jobs


def _read_job(path: str | Path, overrides: Mapping[str, object]) -> Job:
    try:
        return Job(one_line(str(path)), read_survey(path, overrides))
    except (InputError, OSError) as error:
        return Job(one_line(str(path)), None, failure_of(error))


@dataclass(frozen=True)
class BatchOptions:
    """Options of a batch.

    Attributes:
        scheduler: address of a Dask scheduler; empty: workers on this machine.
        num_workers: number of surveys at once on this machine; 0: as many as its cores and memory allow.
        num_threads: threads of each survey; 0: its worker's share of the cores.
        memory_limit_bytes: memory of each survey; 0: its worker's share of the memory.
        restart: repeat what earlier runs have done.
    """

    scheduler: str = ""
    num_workers: int = 0
    num_threads: int = 0
    memory_limit_bytes: int = 0
    restart: bool = False


@dataclass(frozen=True)
class Share:
    """Resources that one survey may use.

    Attributes:
        num_threads: threads; 0: the cores of its machine, divided by the surveys that run there at once.
        memory_limit_bytes: memory; 0: the memory of its machine, divided likewise.
        num_at_once: number of surveys at once on each host, as far as it is known beforehand.
    """

    num_threads: int = 0
    memory_limit_bytes: int = 0
    num_at_once: Mapping[str, int] = field(default_factory=dict)

    def on(self, host: str, num_slots: int, num_cores: int, memory_bytes: int) -> tuple[int, int]:
        """Return the numbers of threads and of bytes of memory for one survey on a machine.

        Args:
            host: name of the machine.
            num_slots: number of surveys at once of the worker that asks.
            num_cores, memory_bytes: of the machine.
        """
        num = max(num_slots, self.num_at_once.get(host, 0))
        return self.num_threads or max(1, num_cores // num), self.memory_limit_bytes or memory_bytes // num


def share_this_machine(
    options: BatchOptions, num_surveys: int, num_cores: int, memory_bytes: int
) -> tuple[int, Share, str | None]:
    """Return the number of workers, the resources of each survey, and a remark for the user or None.

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

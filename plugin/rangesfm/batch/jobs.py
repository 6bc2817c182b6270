"""Input of a batch: its surveys, which are read before anything starts, and the resources that each may use."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

from rangesfm.errors import Failure, InputError, failure_of, one_line
from rangesfm.survey.settings import Survey
from rangesfm.survey.survey_reader import read_survey
from rangesfm.util.files.folders import real_path

_USUAL_BYTES = 2 * 10**9  # a reconstruction of some hundred photos needs less memory than this
# The file of a survey as the user wrote it, on one printable line; and its settings, or why it cannot be used.
Job: TypeAlias = tuple[str, Survey | Failure]


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


def read_jobs(paths: Sequence[str | Path], overrides: Mapping[str, object], output_path: Path) -> list[Job]:
    """Read the survey files of a batch; there is a job also for each file that cannot be used.

    Args:
        overrides: values by dotted key that replace those in every file; see ``read_survey``.
        output_path: folder of the batch's own table.

    Raises:
        InputError: two surveys write to the same folder, or one writes to the batch's own.
    """
    jobs: list[Job] = []
    writes_to = {real_path(output_path): "the table of the batch"}
    for path in paths:
        name = one_line(str(path))
        try:
            survey = read_survey(path, overrides)
        except (InputError, OSError) as error:
            jobs.append((name, failure_of(error)))
            continue
        folder = real_path(survey.output.path)
        if folder in writes_to:
            raise InputError(f"writes to {folder}, as {writes_to[folder]} does: expected another [output] path", name)
        writes_to[folder] = name
        jobs.append((name, survey))
    return jobs


def share_this_machine(
    options: BatchOptions, num_surveys: int, num_cores: int, memory_bytes: int
) -> tuple[int, int, int, str]:
    """Return the number of workers, threads and bytes of memory of each survey, and a remark for the user or "".

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
    note = f"{asked_for}: each survey takes longer" if num_workers > num_cores else ""
    return num_workers, num_threads, options.memory_limit_bytes or memory_bytes // num_workers, note

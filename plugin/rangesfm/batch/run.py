"""Many surveys, each run by a Dask worker: one that fails does not stop the others."""

from __future__ import annotations

import queue
import sys
import uuid
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from distributed import Client, Future, KilledWorker, wait

from rangesfm.batch.course import BatchListener, Course, Figures, Status, SurveyRow
from rangesfm.batch.jobs import BatchOptions, Job, Share, share_this_machine
from rangesfm.batch.page import render
from rangesfm.batch.workers import (
    KilledError,
    SurveyTask,
    local_workers,
    num_at_once,
    run_on_worker,
    stop_batch,
    this_machine,
    workers_of,
)
from rangesfm.ceres.doctor import versions
from rangesfm.errors import FAILED, Failure
from rangesfm.files.atomic import sole_writer, write_text
from rangesfm.files.records import write_json
from rangesfm.files.tables import write_table
from rangesfm.vision.submaps import Submap

_POLL_INTERVAL_S = 0.2
_NUM_RETRIES = 2  # of a survey whose process was killed; Dask itself counts the workers that were
_MAX_STOP_S = 30.0  # more than a worker gives a survey
TABLE_NAME, JSON_NAME, PAGE_NAME = "batch.csv", "batch.json", "batch.html"


def write_results(course: Course, folder: Path) -> None:
    """Write ``batch.csv``, ``batch.json`` and ``batch.html``; while the batch runs the page loads itself anew."""
    rows = course.rows
    cells = [["" if value is None else str(value) for value in row.cells().values()] for row in rows]
    write_table(folder / TABLE_NAME, list(SurveyRow("").cells()), cells)
    summary = {
        **{f"num_{status.value}": course.num(status) for status in Status},
        "seconds": course.seconds,
        "versions": versions(),
        "surveys": [row.cells() for row in rows],
    }
    write_json(summary, folder / JSON_NAME)
    write_text(render(course, folder), folder / PAGE_NAME)


def run_batch(jobs: Sequence[Job], options: BatchOptions, output_path: Path, listener: BatchListener) -> Course:
    """Run all surveys; write ``batch.csv``, ``batch.json`` and ``batch.html``, anew whenever one has ended.

    Args:
        jobs: from ``read_jobs``; those that cannot be used are in the table too.
        output_path: folder of the table.

    Raises:
        InputError: no scheduler answers, the folder cannot be written to, or more threads are asked for than there
            are cores.
        KeyboardInterrupt: once the workers have stopped; the table says how far each survey came.
    """
    course = Course(jobs)
    with sole_writer(output_path):
        if not course.is_over:
            with _workers(options, jobs, listener) as (client, shares):
                _Crew(client, course, output_path, listener, shares).run(jobs, options.restart)
        write_results(course, output_path)
        listener.show(course)
    return course


@dataclass(frozen=True)
class _Shares:
    """What a survey may use, and what a submap of one."""

    of_survey: Share
    of_submap: Share


@contextmanager
def _workers(options: BatchOptions, jobs: Sequence[Job], listener: BatchListener) -> Iterator[tuple[Client, _Shares]]:
    if options.scheduler is not None:
        with workers_of(options.scheduler) as client:
            at_once = num_at_once(client)
            if not at_once:
                listener.message(f"{options.scheduler} has no workers yet: the surveys wait for some")
            share = Share(options.num_threads, options.memory_limit_bytes, at_once)
            yield client, _Shares(share, share)
        return
    surveys = [job.survey for job in jobs if job.survey is not None]
    num_workers, of_survey, note = share_this_machine(options, len(surveys), *this_machine())
    of_submap = of_survey
    if any(survey.mapper.submap_size is not None for survey in surveys):
        # There are as many submaps as anybody could want; while one survey is prepared, the others' workers rest.
        num_workers, of_submap, note = share_this_machine(options, sys.maxsize, *this_machine())
    if note is not None:
        listener.message(note)
    with local_workers(num_workers) as client:
        yield client, _Shares(of_survey, of_submap)


class _Crew:
    """The workers of a batch, given its surveys, and listened to.

    A survey that is mapped in submaps is prepared by one task, its submaps are a task each, and the last one finds them
    mapped and does the rest.
    """

    def __init__(self, client: Client, course: Course, output_path: Path, listener: BatchListener, shares: _Shares):
        self._client = client
        self._course = course
        self._output_path = output_path
        self._listener = listener
        self._shares = shares
        self._batch = f"rangesfm-batch-{uuid.uuid4().hex}"
        self._inbox: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._task_of: dict[Future, SurveyTask] = {}
        self._num_submaps: dict[int, int] = {}
        self._num_left: dict[int, int] = {}

    def run(self, jobs: Sequence[Job], restart: bool) -> None:
        """Until all surveys are over."""
        try:
            write_results(self._course, self._output_path)
            self._client.subscribe_topic(self._batch, self._inbox.put)
            for index, job in enumerate(jobs):
                if job.survey is not None:
                    in_submaps = job.survey.mapper.submap_size is not None
                    share = self._shares.of_survey
                    self._submit(SurveyTask(self._batch, index, job.survey, share, restart, only_prepare=in_submaps))
            while not self._course.is_over:
                self._look()
        except BaseException:
            self._listener.message("stopping the workers")
            self._stop()
            self._course.interrupted()
            write_results(self._course, self._output_path)
            self._listener.show(self._course)
            raise

    def _submit(self, task: SurveyTask) -> None:
        key = f"{self._batch}-{len(self._task_of)}"
        future = self._client.submit(run_on_worker, task, key=key, pure=False, retries=_NUM_RETRIES)
        self._task_of[future] = task
        future.add_done_callback(self._inbox.put)

    def _look(self) -> None:
        """Take in what has come, or wait a moment for it, and pass it on."""
        items = _all_of(self._inbox)
        if self._client.status != "running":
            self._course.all_failed("the connection to the scheduler was lost")
            return
        if items:
            self._course.num_at_once = max(1, sum(self._client.nthreads().values()))
        ended = [item for item in items if not isinstance(item, tuple)]
        for item in items:
            if isinstance(item, tuple):  # when, and what
                self._course.tell(item[1]["index"], item[1])
            else:
                self._take_end(item)
        if ended:
            write_results(self._course, self._output_path)
        self._listener.show(self._course)

    def _take_end(self, future: Future) -> None:
        task = self._task_of[future]
        if self._course.rows[task.index].status.is_final:  # another of its submaps has failed
            return
        ending = _ending(future)
        if isinstance(ending, Failure):
            self._fail(task, ending)
        elif task.only_prepare:
            self._begin_submaps(task, ending)
        elif task.submap is not None:
            self._end_submap(task)
        else:
            self._course.done(task.index, Figures(**ending["figures"]), ending["reason"])

    def _begin_submaps(self, task: SurveyTask, submaps: Sequence[Submap]) -> None:
        self._num_submaps[task.index] = self._num_left[task.index] = len(submaps)
        for submap in submaps:
            self._submit(replace(_rest_of(task), submap=submap, share=self._shares.of_submap))
        self._tell_submaps(task.index)
        if not submaps:
            self._submit(_rest_of(task))

    def _end_submap(self, task: SurveyTask) -> None:
        self._num_left[task.index] -= 1
        self._tell_submaps(task.index)
        if not self._num_left[task.index]:
            self._submit(replace(_rest_of(task), share=self._shares.of_survey))

    def _tell_submaps(self, index: int) -> None:
        num_total = self._num_submaps[index]
        self._course.tell(index, {"stage": "submaps"})
        self._course.tell(index, {"num_done": num_total - self._num_left[index], "num_total": num_total})

    def _fail(self, task: SurveyTask, failure: Failure) -> None:
        where = "" if task.submap is None else f"submap {task.submap.folder.name}: "
        self._course.failed(task.index, where + failure.message, failure.exit_status)
        others = [future for future, other in self._task_of.items() if other.index == task.index and not future.done()]
        self._client.cancel(others)

    def _stop(self) -> None:
        """Have the workers interrupt what they are at, and wait for it; then nothing is half-written."""
        futures = list(self._task_of)
        try:
            self._client.run(stop_batch, self._batch, on_error="ignore")
            with self._client.as_current():
                wait(futures, timeout=_MAX_STOP_S)
            self._client.cancel(futures)
        except (OSError, RuntimeError):  # they are gone, or do not answer (TimeoutError): then they are ended
            pass


def _rest_of(task: SurveyTask) -> SurveyTask:
    """What is to be done of a survey once it is prepared, or once its submaps are mapped."""
    return replace(task, only_prepare=False, submap=None, restart=False, begins=False)


def _all_of(inbox: queue.SimpleQueue[Any]) -> list[Any]:
    """What is in it; waits a moment for the first."""
    items = []
    wait_s = _POLL_INTERVAL_S
    while True:
        try:
            items.append(inbox.get(timeout=wait_s))
        except queue.Empty:
            return items
        wait_s = 0.0


def _ending(future: Future) -> Any:
    """What ``run_on_worker`` returned, or why it did not."""
    if future.cancelled():  # as it is where the scheduler has ended
        return Failure("the scheduler gave it up", FAILED)
    error = future.exception(timeout=_MAX_STOP_S)
    if error is None:
        return future.result(timeout=_MAX_STOP_S)
    if isinstance(error, KilledWorker):
        return Failure("the worker that had it was lost, and so were those that tried it again", FAILED)
    if isinstance(error, KilledError):
        return Failure(f"{error}; so it was each time it was tried", FAILED)
    return Failure(" ".join(f"its worker failed: {type(error).__name__}: {error}".split()), FAILED)

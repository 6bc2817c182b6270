"""Many surveys, each run by a Dask worker: one that fails does not stop the others."""

from __future__ import annotations

import queue
import uuid
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from distributed import Client, Future, KilledWorker, wait

from rangesfm.batch.cluster import local_workers, num_at_once, this_machine, workers_of
from rangesfm.batch.course import BatchListener, Course
from rangesfm.batch.jobs import Job
from rangesfm.batch.on_worker import KilledError, SurveyTask, run_on_worker, stop_batch
from rangesfm.batch.results import write_results
from rangesfm.batch.rows import Figures
from rangesfm.batch.shares import BatchOptions, Share, share_this_machine
from rangesfm.files.sole_writer import sole_writer

_POLL_INTERVAL_S = 0.2
_NUM_RETRIES = 2  # of a survey whose process was killed; Dask itself counts the workers that were
_MAX_STOP_S = 30.0  # more than a worker gives a survey
_FAILED = 4


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
            with _workers(options, jobs, listener) as (client, share):
                _Crew(client, course, output_path, listener, share).run(jobs, options.restart)
        write_results(course, output_path)
        listener.show(course)
    return course


@contextmanager
def _workers(options: BatchOptions, jobs: Sequence[Job], listener: BatchListener) -> Iterator[tuple[Client, Share]]:
    if options.scheduler is not None:
        with workers_of(options.scheduler) as client:
            at_once = num_at_once(client)
            if not at_once:
                listener.message(f"{options.scheduler} has no workers yet: the surveys wait for some")
            yield client, Share(options.num_threads, options.memory_limit_bytes, at_once)
        return
    num_surveys = sum(job.survey is not None for job in jobs)
    num_workers, share, note = share_this_machine(options, num_surveys, *this_machine())
    if note is not None:
        listener.message(note)
    with local_workers(num_workers) as client:
        yield client, share


class _Crew:
    """The workers of a batch, given its surveys, and listened to."""

    def __init__(self, client: Client, course: Course, output_path: Path, listener: BatchListener, share: Share):
        self._client = client
        self._course = course
        self._output_path = output_path
        self._listener = listener
        self._share = share
        self._batch = f"rangesfm-batch-{uuid.uuid4().hex}"
        self._inbox: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._task_of: dict[Future, SurveyTask] = {}

    def run(self, jobs: Sequence[Job], restart: bool) -> None:
        """Until all surveys are over."""
        try:
            write_results(self._course, self._output_path)
            self._client.subscribe_topic(self._batch, self._inbox.put)
            for index, job in enumerate(jobs):
                if job.survey is not None:
                    self._submit(SurveyTask(self._batch, index, job.survey, self._share, restart))
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
            self._course.all_failed("the connection to the scheduler was lost", _FAILED)
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
        if future.cancelled():  # as it is where the scheduler has ended
            self._course.failed(task.index, "the scheduler gave it up", _FAILED)
            return
        error = future.exception(timeout=_MAX_STOP_S)
        if error is not None:
            self._course.failed(task.index, _reason(error), _FAILED)
            return
        ending = future.result(timeout=_MAX_STOP_S)
        if "failed" in ending:
            self._course.failed(task.index, ending["failed"]["message"], ending["failed"]["exit_status"])
        else:
            self._course.done(task.index, Figures(**ending["done"]["figures"]), ending["done"]["reason"])

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


def _reason(error: BaseException) -> str:
    if isinstance(error, KilledWorker):
        return "the worker that had it was lost, and so were those that tried it again"
    if isinstance(error, KilledError):
        return f"{error}; so it was each time it was tried"
    return " ".join(f"its worker failed: {type(error).__name__}: {error}".split())

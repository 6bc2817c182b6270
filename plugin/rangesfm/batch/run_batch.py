"""Run of many surveys, each by a Dask worker; a survey that fails does not stop the others."""

from __future__ import annotations

import queue
import uuid
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from dask.system import CPU_COUNT
from distributed import Client, Future, KilledWorker, wait
from distributed.system import MEMORY_LIMIT

from rangesfm.batch import workers
from rangesfm.batch.batch_page import render_batch
from rangesfm.batch.batch_state import BatchListener, BatchState, Status, SurveyRow
from rangesfm.batch.jobs import BatchOptions, Job, Share, share_this_machine
from rangesfm.ceres.installation_checks import recorded_versions
from rangesfm.errors import FAILED, Failure
from rangesfm.files.atomic import sole_writer, write_text
from rangesfm.files.records import write_json
from rangesfm.files.text_tables import write_table

_POLL_INTERVAL_S = 0.2
_NUM_RETRIES = 2  # for a survey whose process was killed; Dask itself counts attempts whose worker was killed
_MAX_STOP_S = 30.0  # longer than a worker waits for an interrupted survey
TABLE_NAME, JSON_NAME, PAGE_NAME = "batch.csv", "batch.json", "batch.html"


def write_batch_results(batch_state: BatchState, folder: Path) -> None:
    """Write ``batch.csv``, ``batch.json`` and ``batch.html``; while the batch runs the page reloads itself."""
    rows = batch_state.rows
    cells = [["" if value is None else str(value) for value in row.cells().values()] for row in rows]
    write_table(folder / TABLE_NAME, list(SurveyRow("").cells()), cells)
    summary = {
        **{f"num_{status.value}": batch_state.num(status) for status in Status},
        "seconds": batch_state.seconds,
        "versions": recorded_versions(),
        "surveys": [row.cells() for row in rows],
    }
    write_json(summary, folder / JSON_NAME)
    write_text(render_batch(batch_state, folder), folder / PAGE_NAME)


def run_batch(jobs: Sequence[Job], options: BatchOptions, output_path: Path, listener: BatchListener) -> BatchState:
    """Run all surveys; rewrite ``batch.csv``, ``batch.json`` and ``batch.html`` whenever one has ended.

    Args:
        jobs: from ``read_jobs``; those that cannot be used are in the table, too.
        output_path: folder of the table.

    Raises:
        InputError: no scheduler answers, the folder cannot be written to, or more threads are asked for than there
            are cores.
        KeyboardInterrupt: once the workers have stopped; the table then says how far each survey came.
    """
    batch_state = BatchState(jobs)
    with sole_writer(output_path):
        if not batch_state.is_over:
            with _workers(options, jobs, listener) as (client, share):
                _Crew(client, batch_state, output_path, listener, share).run(jobs, options.restart)
        write_batch_results(batch_state, output_path)
        listener.show(batch_state)
    return batch_state


@contextmanager
def _workers(options: BatchOptions, jobs: Sequence[Job], listener: BatchListener) -> Iterator[tuple[Client, Share]]:
    if options.scheduler:
        with workers.workers_of(options.scheduler) as client:
            at_once = workers.num_at_once(client)
            if not at_once:
                listener.message(f"{options.scheduler} has no workers yet: the surveys wait for them")
            yield client, Share(options.num_threads, options.memory_limit_bytes, at_once)
        return
    num_surveys = sum(job.survey is not None for job in jobs)
    num_workers, share, note = share_this_machine(options, num_surveys, CPU_COUNT, MEMORY_LIMIT)
    if note is not None:
        listener.message(note)
    with workers.local_workers(num_workers) as client:
        yield client, share


class _Crew:
    """The workers of a batch: gives them its surveys and takes in their messages."""

    def __init__(
        self, client: Client, batch_state: BatchState, output_path: Path, listener: BatchListener, share: Share
    ):
        self._client = client
        self._state = batch_state
        self._output_path = output_path
        self._listener = listener
        self._share = share
        self._batch = f"rangesfm-batch-{uuid.uuid4().hex}"
        self._inbox: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._task_of: dict[Future, workers.SurveyTask] = {}

    def run(self, jobs: Sequence[Job], restart: bool) -> None:
        """Run the surveys until all are over."""
        try:
            write_batch_results(self._state, self._output_path)
            self._client.subscribe_topic(self._batch, self._inbox.put)
            for index, job in enumerate(jobs):
                if job.survey is not None:
                    self._submit(workers.SurveyTask(self._batch, index, job.survey, self._share, restart))
            while not self._state.is_over:
                self._look()
        except BaseException:
            self._listener.message("stopping the workers")
            self._stop()
            self._state.end_all(Status.INTERRUPTED, "interrupted")
            write_batch_results(self._state, self._output_path)
            self._listener.show(self._state)
            raise

    def _submit(self, task: workers.SurveyTask) -> None:
        key = f"{self._batch}-{len(self._task_of)}"
        future = self._client.submit(workers.run_on_worker, task, key=key, pure=False, retries=_NUM_RETRIES)
        self._task_of[future] = task
        future.add_done_callback(self._inbox.put)

    def _look(self) -> None:
        """Process the messages that have arrived, after a short wait for the first."""
        items = _all_of(self._inbox)
        if self._client.status != "running":
            self._state.end_all(Status.FAILED, "the connection to the scheduler was lost", FAILED)
            return
        if items:
            self._state.num_at_once = max(1, sum(self._client.nthreads().values()))
        ended = [item for item in items if not isinstance(item, tuple)]
        for item in items:
            if isinstance(item, tuple):  # a message: its time and its content
                self._state.tell(item[1]["index"], item[1])
            else:
                self._take_end(item)
        if ended:
            write_batch_results(self._state, self._output_path)
        self._listener.show(self._state)

    def _take_end(self, future: Future) -> None:
        task = self._task_of[future]
        ending = _ending(future)
        if isinstance(ending, Failure):
            self._state.end(task.index, Status.FAILED, ending.message, ending.exit_status)
        else:
            self._state.end(task.index, Status.DONE, ending["reason"], 0, **ending["figures"])

    def _stop(self) -> None:
        """Have the workers interrupt their surveys, and wait for them, so that nothing is left half-written."""
        futures = list(self._task_of)
        try:
            self._client.run(workers.stop_batch, self._batch, on_error="ignore")
            with self._client.as_current():
                wait(futures, timeout=_MAX_STOP_S)
            self._client.cancel(futures)
        except (OSError, RuntimeError):  # the workers are gone, or do not answer (TimeoutError)
            pass


def _all_of(inbox: queue.SimpleQueue[Any]) -> list[Any]:
    """Return all items in the inbox, after a short wait for the first."""
    items = []
    wait_s = _POLL_INTERVAL_S
    while True:
        try:
            items.append(inbox.get(timeout=wait_s))
        except queue.Empty:
            return items
        wait_s = 0.0


def _ending(future: Future) -> Any:
    """Return the result of ``run_on_worker``, or a Failure that says why there is none."""
    if future.cancelled():  # also when the scheduler has ended
        return Failure("the scheduler cancelled it", FAILED)
    error = future.exception(timeout=_MAX_STOP_S)
    if error is None:
        return future.result(timeout=_MAX_STOP_S)
    if isinstance(error, KilledWorker):
        return Failure("its worker was lost, and so were the workers that tried it again", FAILED)
    if isinstance(error, workers.KilledError):
        return Failure(f"{error}; this happened at every attempt", FAILED)
    return Failure(" ".join(f"its worker failed: {type(error).__name__}: {error}".split()), FAILED)

"""Run of many surveys; a survey that fails does not stop the others."""

from __future__ import annotations

import queue
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from distributed import KilledWorker

from rangesfm.batch.batch_page import render_batch
from rangesfm.batch.batch_state import STATUSES, BatchState, SurveyRow
from rangesfm.batch.jobs import BatchOptions, Job
from rangesfm.batch.workers import MAX_STOP_S, Crew, on_scheduler, on_this_machine
from rangesfm.errors import FAILED, Failure
from rangesfm.solver.installation_checks import recorded_versions
from rangesfm.util.files.atomic import write_text
from rangesfm.util.files.output_folder import sole_writer
from rangesfm.util.files.records import write_json
from rangesfm.util.files.text_tables import write_table
from rangesfm.util.processes.supervision import POLL_INTERVAL_S

TABLE_NAME, JSON_NAME, PAGE_NAME = "batch.csv", "batch.json", "batch.html"


def write_batch_results(batch_state: BatchState, folder: Path) -> None:
    """Write ``batch.csv``, ``batch.json`` and ``batch.html``; while the batch runs the page reloads itself."""
    rows = [row.cells() for row in batch_state.rows]
    cells = [["" if value is None else str(value) for value in row.values()] for row in rows]
    write_table(folder / TABLE_NAME, list(SurveyRow("").cells()), cells)
    summary = {
        **{f"num_{status}": batch_state.num(status) for status in STATUSES},
        "seconds": batch_state.seconds,
        "versions": recorded_versions(),
        "surveys": rows,
    }
    write_json(summary, folder / JSON_NAME)
    write_text(render_batch(batch_state, folder), folder / PAGE_NAME)


def run_batch(
    jobs: Sequence[Job],
    options: BatchOptions,
    output_path: Path,
    show: Callable[[BatchState], None],
    say: Callable[[str], None],
) -> BatchState:
    """Run all surveys; rewrite ``batch.csv``, ``batch.json`` and ``batch.html`` whenever one has ended.

    Args:
        jobs: from ``read_jobs``; those that cannot be used are in the table, too.
        output_path: folder of the table.
        show: is given the state on every change, and several times a second.
        say: is given lines that the user should read.

    Raises:
        InputError: no scheduler answers, the folder cannot be written to, or more threads are asked for than there
            are cores.
        KeyboardInterrupt: once the surveys have stopped; the table then says how far each survey came.
    """
    batch_state = BatchState(jobs)
    surveys = {index: survey for index, (_, survey) in enumerate(jobs) if not isinstance(survey, Failure)}
    inbox: queue.SimpleQueue[Any] = queue.SimpleQueue()
    with sole_writer(output_path):
        if surveys:
            here = not options.scheduler
            crew_of = on_this_machine(options, len(surveys), inbox, say) if here else on_scheduler(options, inbox, say)
            with crew_of as crew:
                try:
                    write_batch_results(batch_state, output_path)
                    index_of = {crew.submit(index, survey): index for index, survey in surveys.items()}
                    for future in index_of:
                        future.add_done_callback(inbox.put)
                    while not batch_state.is_over:
                        if _take_in(batch_state, inbox, index_of, crew):
                            write_batch_results(batch_state, output_path)
                        show(batch_state)
                except BaseException:
                    say("stopping the workers")
                    crew.stop()
                    batch_state.end_all("interrupted", "interrupted")
                    write_batch_results(batch_state, output_path)
                    show(batch_state)
                    raise
        write_batch_results(batch_state, output_path)
        show(batch_state)
    return batch_state


def _take_in(batch_state: BatchState, inbox: queue.SimpleQueue[Any], index_of: dict[Any, int], crew: Crew) -> bool:
    """Take in what has arrived, after a short wait for the first: messages, and futures of surveys that have ended.

    Returns:
        Whether any survey has ended.
    """
    any_ended, wait_s = False, POLL_INTERVAL_S
    while True:
        try:
            item = inbox.get(timeout=wait_s)
        except queue.Empty:
            break
        wait_s = 0.0
        if isinstance(item, tuple):
            batch_state.tell(*item)
            continue
        any_ended, ending = True, _ending(item)
        if isinstance(ending, Failure):
            batch_state.end(index_of[item], "failed", ending.message, ending.exit_status)
        else:
            batch_state.end(index_of[item], "done", ending["reason"], 0, **ending["figures"])
    if crew.is_lost():
        batch_state.end_all("failed", "the connection to the scheduler was lost", FAILED)
    return any_ended


def _ending(future: Any) -> Any:
    """Return the result of ``run_apart``, or a Failure that says why there is none."""
    if future.cancelled():  # also when the scheduler has ended
        return Failure("the scheduler cancelled it", FAILED)
    error = future.exception(timeout=MAX_STOP_S)
    if error is None:
        return future.result(timeout=MAX_STOP_S)
    if isinstance(error, KilledWorker):
        return Failure("its worker was lost, and so were the workers that tried it again", FAILED)
    return Failure(" ".join(f"its worker failed: {type(error).__name__}: {error}".split()), FAILED)

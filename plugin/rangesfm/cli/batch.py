"""The command ``batch``: many surveys, on this machine or on a cluster, and their progress on the terminal."""

from __future__ import annotations

import argparse
import math
import re
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, TextIO

from rangesfm.cli.arguments import Commands, Outcome
from rangesfm.cli.survey_flags import add_flags, add_restart_argument, overrides_from_arguments
from rangesfm.cli.terminal import Screen, counts
from rangesfm.errors import InputError
from rangesfm.installed_versions import missing_extra
from rangesfm.progress import Progress, format_duration

if TYPE_CHECKING:
    from rangesfm.batch.batch_state import BatchState, SurveyRow


# Keys without a flag here: each survey has its own photos and output, and the workers share the threads.
_OF_A_SURVEY = ("images.path", "images.times", "mapper.num_threads", "output.path")
_BYTES_PER_UNIT = {"mb": 10**6, "gb": 10**9, "mib": 1 << 20, "gib": 1 << 30}
_INTERVAL_S = 0.2
_MAX_NUM_LINES = 20


def add_batch_commands(commands: Commands) -> None:
    parser = commands.add("batch", _batch, "run many surveys at once, on this machine or on a cluster")
    parser.add_argument(
        "surveys", nargs="+", metavar="SURVEY.toml", help="survey files, each with its own [output] path"
    )
    parser.add_argument(
        "--output_path", default="batch", metavar="FOLDER", help="folder of the tables and the page (default: batch)"
    )
    parser.add_argument("--scheduler", metavar="ADDRESS", help="address of a Dask scheduler, such as tcp://head:8786")
    parser.add_argument(
        "--num_workers", type=_at_least_1, metavar="N", help="surveys run at once (default: by cores and memory)"
    )
    parser.add_argument(
        "--num_threads", type=_at_least_1, metavar="N", help="threads per survey (default: cores divided by workers)"
    )
    parser.add_argument(
        "--memory_limit",
        type=_bytes,
        metavar="SIZE",
        help="memory per survey, such as 8GB (default: memory divided by workers)",
    )
    add_restart_argument(parser)
    add_flags(parser, without=_OF_A_SURVEY)


def _batch(args: argparse.Namespace, progress: Progress) -> Outcome:
    r"""Run many surveys, each as rangesfm run does. A survey that fails does not stop the others. The outcome of
    each is in batch.csv, batch.json and batch.html. Needs pip install '.[batch]' in a clone.

    Without --scheduler, the workers are processes of this machine, which share its cores and memory. With it,
    they are the workers of a Dask scheduler. These must have this version of rangesfm installed, and find the
    files of the surveys under the same paths. Each worker should run one survey at a time:
      dask scheduler --host HEAD
      dask worker tcp://HEAD:8786 --nthreads 1 --no-dashboard  # on each machine
    dask-jobqueue starts workers on Slurm, PBS and similar, dask-kubernetes on Kubernetes: see
    examples/many_surveys.md.

    Exit status: 0 if all are done; otherwise the largest exit status of rangesfm run among the surveys.

    example:
      rangesfm batch surveys/*.toml --output_path batch
      rangesfm batch surveys/*.toml --num_workers 2 --num_threads 4 \
        --memory_limit 8GB
      rangesfm batch surveys/*.toml --scheduler tcp://head:8786 --num_threads 8
    """
    if args.scheduler is not None and args.num_workers is not None:
        raise InputError("--num_workers is for this machine only: leave it out with --scheduler")
    try:
        import distributed  # noqa: F401
    except ImportError:
        raise missing_extra("rangesfm batch needs Dask", "batch") from None
    from rangesfm.batch.batch_state import exit_status_of, format_rows
    from rangesfm.batch.jobs import BatchOptions, read_jobs
    from rangesfm.batch.run_batch import PAGE_NAME, TABLE_NAME, run_batch

    output_path = Path(args.output_path)
    jobs = read_jobs(args.surveys, overrides_from_arguments(args), output_path)
    options = BatchOptions(
        args.scheduler or "", args.num_workers or 0, args.num_threads or 0, args.memory_limit or 0, args.restart
    )
    terminal = BatchTerminal(sys.stderr, quiet=args.quiet)
    batch_state = run_batch(jobs, options, output_path, terminal.show, terminal.message)
    lines = [
        *format_rows(batch_state.rows).splitlines(),
        "",
        f"table: {output_path / TABLE_NAME}",
        f"page: {output_path / PAGE_NAME}",
    ]
    return Outcome(lines, exit_status_of(batch_state.rows))


def _at_least_1(text: str) -> int:
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"{value} is less than 1")
    return value


def _bytes(text: str) -> int:
    found = re.fullmatch(r"(\d+(?:\.\d+)?) ?([MG]i?B)", text, re.IGNORECASE)
    if found is None or float(found[1]) == 0:
        raise argparse.ArgumentTypeError(f"'{text}' is not a size, expected one such as 8GB or 500MB")
    return int(float(found[1]) * _BYTES_PER_UNIT[found[2].lower()])


class BatchTerminal:
    """Writer of the progress of a batch to ``stream``."""

    def __init__(self, stream: TextIO, *, quiet: bool = False, clock: Callable[[], float] = time.monotonic):
        self._screen = Screen(stream, quiet=quiet)
        self._clock = clock
        self._last_drawn = -math.inf
        self._told: dict[int, str] = {}
        self._num_over = 0

    def show(self, batch_state: BatchState) -> None:
        """Print what is new, and on a terminal draw the running surveys again."""
        new = self._news(batch_state)
        now = self._clock()
        if new or batch_state.is_over:
            self._screen.say(new)
        if not batch_state.is_over and (new or now - self._last_drawn >= _INTERVAL_S):
            self._last_drawn = now
            self._screen.draw(_going_on(batch_state))

    def message(self, text: str) -> None:
        self._screen.say([text])

    def _news(self, batch_state: BatchState) -> list[str]:
        """Return new lines about surveys: each survey that has ended, and off a terminal also each stage."""
        lines = []
        for index, row in enumerate(batch_state.rows):
            line = _ended(row) if row.is_over else "" if self._screen.is_terminal else _stage(row)
            if line and self._told.get(index) != line:
                self._told[index] = line
                lines.append(line)
        num_over = sum(row.is_over for row in batch_state.rows)
        if num_over > self._num_over and not self._screen.is_terminal:
            lines.append(_summary(batch_state))
        self._num_over = num_over
        return lines


def _going_on(batch_state: BatchState) -> list[str]:
    lines = []
    for row in batch_state.rows:
        if row.began_s is not None:
            counted = f" {counts(row.num_done, row.num_total)}" if row.num_done or row.num_total else ""
            lines.append(f"  {_stage(row)}{counted}, {format_duration(batch_state.seconds_running(row))}")
    return [*lines[:_MAX_NUM_LINES], _summary(batch_state)]


def _stage(row: SurveyRow) -> str:
    if row.began_s is None:
        return ""
    again = f" again, attempt {row.num_attempts}" if row.num_attempts > 1 else ""
    return f"{row.survey}: {row.stage or 'begins' + again}"


def _ended(row: SurveyRow) -> str:
    seconds = "" if row.seconds is None else f" after {format_duration(row.seconds)}"
    what = (row.exit_status == 0 and row.figures["verdict"]) or row.status
    reason = f": {row.reason}" if row.reason and row.reason != what else ""
    return f"{row.survey}: {what}{seconds}{reason}"


def _summary(batch_state: BatchState) -> str:
    num_over = sum(row.is_over for row in batch_state.rows)
    num_failed = sum(bool(row.exit_status) for row in batch_state.rows)
    failed = f", {num_failed} of them failed" if num_failed else ""
    left = batch_state.seconds_left()
    time_left = "" if left is None or batch_state.is_over else f", {format_duration(left)} left"
    return (
        f"{num_over} of {len(batch_state.rows)} surveys over{failed}, {format_duration(batch_state.seconds)}{time_left}"
    )

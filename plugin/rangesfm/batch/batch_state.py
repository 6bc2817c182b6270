"""State of a batch: the progress and the results of each survey, and of all."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from enum import Enum
from typing import Any, Protocol

from rangesfm.batch.jobs import Job
from rangesfm.comparison.with_reference import text_or_dash
from rangesfm.errors import FAILED, INTERNAL_ERROR, one_line
from rangesfm.files.text_tables import align_rows
from rangesfm.result.summary import ResultSummary


class Status(str, Enum):
    """Status of a survey in a batch."""

    WAITING = "waiting"
    RUNNING = "running"
    DONE = "done"
    FAILED = "failed"
    INTERRUPTED = "interrupted"

    @property
    def is_final(self) -> bool:
        return self not in (Status.WAITING, Status.RUNNING)


@dataclass(frozen=True)
class SurveyRow:
    """One row of the batch's table; the results are taken from ``result.json``.

    Attributes:
        survey: the survey file.
        reason: why the survey failed, or the reasons of its verdict; one line.
        exit_status: exit status that ``rangesfm run`` would have; None while the survey is not over.
        num_attempts: number of times a worker began the survey; more than 1 where a process was killed.
        seconds: duration of the last attempt.
        host: machine of the last attempt.
        output_path: folder of the results; empty if the survey file cannot be read.
        scale: metres per unit of the unscaled model.
        scale_stddev: its empirical standard deviation, which is never less than the formal one.
        num_photos: number of photos in the model.
        rmse_m: ``ComparisonRow.rmse_m`` of the final map, where there is a reference.
    """

    survey: str
    status: Status = Status.WAITING
    reason: str = ""
    exit_status: int | None = None
    num_attempts: int = 0
    seconds: float | None = None
    host: str = ""
    output_path: str = ""
    verdict: str | None = None
    scale: float | None = None
    scale_stddev: float | None = None
    frame: str | None = None
    num_photos: int | None = None
    num_ranges: int | None = None
    num_ranges_used: int | None = None
    range_rms_m: float | None = None
    reprojection_rms_px: float | None = None
    rmse_m: float | None = None
    num_warnings: int | None = None

    def cells(self) -> dict[str, Any]:
        """Return the plain values of the row, by column."""
        return asdict(self) | {"status": self.status.value}


def figures_of(summary: ResultSummary) -> dict[str, Any]:
    """Return the fields of a SurveyRow that come from ``result.json``."""
    scale, ranges = summary.scale, summary.ranges
    return {
        "verdict": scale.verdict,
        "scale": scale.value,
        "scale_stddev": scale.stddev_empirical,
        "frame": summary.frame,
        "num_photos": summary.map.num_photos,
        "num_ranges": ranges.num,
        "num_ranges_used": ranges.num_used,
        "range_rms_m": ranges.rms_m,
        "reprojection_rms_px": None if summary.refine is None else summary.refine.reprojection_rms_px,
        "rmse_m": summary.comparison[-1].rmse_m if summary.comparison else None,
        "num_warnings": len(summary.warnings),
    }


def exit_status_of(rows: Iterable[SurveyRow]) -> int:
    """Return 0 if all surveys are done, else the largest of their exit statuses; an internal error counts as failed."""
    return max((FAILED if row.exit_status == INTERNAL_ERROR else row.exit_status or 0 for row in rows), default=0)


def format_rows(rows: Sequence[SurveyRow]) -> str:
    """Format the rows as aligned plain text, followed by the reasons of surveys that are not done."""
    header = ("survey", "result", "scale", "photos", "ranges used", "range RMS m", "RMSE m", "seconds")
    table = align_rows([header, *map(_texts, rows)])
    # An error about the survey file itself already begins with the file's name.
    reasons = [
        row.reason if row.reason.startswith(f"{row.survey}:") else f"{row.survey}: {row.reason}"
        for row in rows
        if row.status is not Status.DONE
    ]
    return "\n".join([table, *([""] if reasons else []), *reasons])


def _texts(row: SurveyRow) -> tuple[str, ...]:
    return (
        row.survey,
        row.verdict or row.status.value,
        text_or_dash(row.scale, ".6g"),
        text_or_dash(row.num_photos, "d"),
        text_or_dash(row.num_ranges_used, "d"),
        text_or_dash(row.range_rms_m, ".3f"),
        text_or_dash(row.rmse_m, ".4f"),
        text_or_dash(row.seconds, ".1f"),
    )


@dataclass(frozen=True)
class SurveyState:
    """Present state of a survey.

    Attributes:
        row: its row as far as it is known.
        stage: the stage that it is in.
        num_done, num_total: finished and all items of the stage, where the stage counts them.
        began_s: start of the last attempt on the clock of the batch, seconds.
    """

    row: SurveyRow
    stage: str = ""
    num_done: int | None = None
    num_total: int | None = None
    began_s: float | None = None


class BatchListener(Protocol):
    """Receiver of the progress of a batch."""

    def show(self, batch_state: BatchState) -> None:
        """Show the state; called on every change, and several times a second."""

    def message(self, text: str) -> None:
        """Show a line that the user should read."""


class BatchState:
    """State of all surveys of a batch, updated by the workers' messages.

    Attributes:
        num_at_once: number of surveys that run at once, as far as it is known.
    """

    def __init__(self, jobs: Sequence[Job], *, clock: Callable[[], float] = time.monotonic):
        self._clock = clock
        self._start_s = clock()
        self.num_at_once = 1
        self._states = [SurveyState(_first_row(job)) for job in jobs]

    @property
    def states(self) -> tuple[SurveyState, ...]:
        return tuple(self._states)

    @property
    def rows(self) -> tuple[SurveyRow, ...]:
        return tuple(state.row for state in self._states)

    @property
    def is_over(self) -> bool:
        return all(row.status.is_final for row in self.rows)

    @property
    def seconds(self) -> float:
        """Seconds since the beginning of the batch."""
        return self._clock() - self._start_s

    def num(self, status: Status) -> int:
        return sum(row.status is status for row in self.rows)

    def seconds_left(self) -> float | None:
        """Return the expected seconds until the end, from the mean duration of finished surveys; None before one is."""
        taken = [row.seconds for row in self.rows if row.status is Status.DONE and row.seconds is not None]
        if not taken:
            return None
        mean = sum(taken) / len(taken)
        running = [max(0.0, mean - self.seconds_running(state)) for state in self._states if state.began_s is not None]
        work = self.num(Status.WAITING) * mean + sum(running)
        return max(work / self.num_at_once, max(running, default=0.0))

    def seconds_running(self, state: SurveyState) -> float:
        """Return the seconds since the last attempt began, or 0 if the survey is not running."""
        return 0.0 if state.began_s is None else self._clock() - state.began_s

    def tell(self, index: int, message: dict[str, Any]) -> None:
        """Take in a message of a survey's worker or process.

        Args:
            index: of the survey.
        """
        state = self._states[index]
        if state.row.status.is_final:
            return
        if "began_on" in message:
            num_attempts, host = state.row.num_attempts + 1, message["began_on"]
            row = replace(state.row, status=Status.RUNNING, host=host, num_attempts=num_attempts)
            self._states[index] = SurveyState(row, began_s=self._clock())
        elif "stage" in message:
            self._states[index] = replace(state, stage=message["stage"], num_done=None, num_total=None)
        elif "num_done" in message:
            self._states[index] = replace(state, num_done=message["num_done"], num_total=message["num_total"])

    def end_all(self, status: Status, reason: str, exit_status: int | None = None) -> None:
        """End all surveys that are not over with this status."""
        for index, row in enumerate(self.rows):
            if not row.status.is_final:
                self.end(index, status, reason, exit_status)

    def end(self, index: int, status: Status, reason: str, exit_status: int | None, **figures: Any) -> None:
        """End a survey.

        Args:
            index: of the survey.
            reason: why it failed, or why its verdict is not good; one line.
            exit_status: exit status that ``rangesfm run`` would have.
            figures: its results (``figures_of``).
        """
        state = self._states[index]
        seconds = None if state.began_s is None else self.seconds_running(state)
        ended = replace(state.row, status=status, reason=reason, exit_status=exit_status, seconds=seconds, **figures)
        self._states[index] = SurveyState(ended)


def _first_row(job: Job) -> SurveyRow:
    output = "" if job.survey is None else one_line(str(job.survey.output.path))
    row = SurveyRow(job.name, output_path=output)
    if job.failure is None:
        return row
    return replace(row, status=Status.FAILED, reason=job.failure.message, exit_status=job.failure.exit_status)

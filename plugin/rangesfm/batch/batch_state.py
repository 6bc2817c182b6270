"""State of a batch: the progress and the results of each survey, and of all."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, get_args

from rangesfm.batch.jobs import Job
from rangesfm.errors import FAILED, INTERNAL_ERROR, Failure, one_line
from rangesfm.result.comparison_row import text_or_dash
from rangesfm.result.summary import ResultSummary
from rangesfm.util.files.text_tables import align_rows

Status = Literal["waiting", "running", "done", "failed", "interrupted"]
STATUSES: tuple[Status, ...] = get_args(Status)
_FIGURES = (
    *("verdict", "scale", "scale_stddev", "frame", "num_photos", "num_ranges", "num_ranges_used", "range_rms_m"),
    *("reprojection_rms_px", "rmse_m", "num_warnings"),
)
_NOT_IN_TABLE = ("figures", "stage", "num_done", "num_total", "began_s")


@dataclass
class SurveyRow:
    """One row of the batch's table; and how far the present attempt has come.

    Attributes:
        survey: the survey file.
        reason: why the survey failed, or the reasons of its verdict; one line.
        exit_status: that ``rangesfm run`` would have; None while the survey is not over.
        num_attempts: number of times a worker began the survey; more than 1 where a process was killed.
        seconds: duration of the last attempt.
        host: machine of the last attempt.
        output_path: empty if the survey file cannot be read.
        figures: from ``result.json`` (``figures_of``); each None until there is one.
        stage: that it is in. num_done, num_total: items of the stage, where it counts them.
        began_s: start of the present attempt on the clock of the batch, seconds.
    """

    survey: str
    status: Status = "waiting"
    reason: str = ""
    exit_status: int | None = None
    num_attempts: int = 0
    seconds: float | None = None
    host: str = ""
    output_path: str = ""
    figures: Mapping[str, Any] = field(default_factory=lambda: dict.fromkeys(_FIGURES))
    stage: str = ""
    num_done: int = 0
    num_total: int = 0
    began_s: float | None = None

    @property
    def is_over(self) -> bool:
        return self.status not in ("waiting", "running")

    def cells(self) -> dict[str, Any]:
        """Return the plain values of the row, by column."""
        return {name: value for name, value in vars(self).items() if name not in _NOT_IN_TABLE} | dict(self.figures)


def figures_of(summary: ResultSummary) -> dict[str, Any]:
    """Return the figures of a survey from ``result.json``.

    The stddev of the scale is the empirical one, which is never less than the formal one. The RMSE is that of the final
    map, where there is a reference.
    """
    scale, ranges = summary.scale, summary.ranges
    values = (
        *(scale.verdict, scale.value, scale.stddev_empirical, summary.frame, summary.map.num_photos),
        *(ranges.num, ranges.num_used, ranges.rms_m),
        None if summary.refine is None else summary.refine.reprojection_rms_px,
        summary.comparison[-1].rmse_m if summary.comparison else None,
        len(summary.warnings),
    )
    return dict(zip(_FIGURES, values, strict=True))


def exit_status_of(rows: Iterable[SurveyRow]) -> int:
    """Return 0 if all surveys are done, else the largest of their exit statuses; an internal error counts as failed."""
    return max((FAILED if row.exit_status == INTERNAL_ERROR else row.exit_status or 0 for row in rows), default=0)


def format_rows(rows: Sequence[SurveyRow]) -> str:
    """Format the rows as aligned plain text, followed by the reasons of surveys that are not done."""
    header = ("survey", "result", "scale", "photos", "ranges used", "range RMS m", "RMSE m", "seconds")
    cells = [
        (
            row.survey,
            row.figures["verdict"] or row.status,
            text_or_dash(row.figures["scale"], ".6g"),
            text_or_dash(row.figures["num_photos"], "d"),
            text_or_dash(row.figures["num_ranges_used"], "d"),
            text_or_dash(row.figures["range_rms_m"], ".3f"),
            text_or_dash(row.figures["rmse_m"], ".4f"),
            text_or_dash(row.seconds, ".1f"),
        )
        for row in rows
    ]
    # An error about the survey file itself already begins with the file's name.
    reasons = [
        row.reason if row.reason.startswith(f"{row.survey}:") else f"{row.survey}: {row.reason}"
        for row in rows
        if row.status != "done"
    ]
    return "\n".join([align_rows([header, *cells]), *([""] if reasons else []), *reasons])


class BatchState:
    """All surveys of a batch, updated by what their processes report.

    Attributes:
        rows: of the surveys.
        num_at_once: largest number of surveys that have run at once so far.
    """

    def __init__(self, jobs: Sequence[Job], *, clock: Callable[[], float] = time.monotonic):
        self._clock = clock
        self._start_s = clock()
        self.num_at_once = 1
        self.rows: list[SurveyRow] = []
        for name, survey in jobs:
            if isinstance(survey, Failure):
                failed = SurveyRow(name, "failed", survey.message, survey.exit_status)
                self.rows.append(failed)
            else:
                self.rows.append(SurveyRow(name, output_path=one_line(str(survey.output.path))))

    @property
    def is_over(self) -> bool:
        return all(row.is_over for row in self.rows)

    @property
    def seconds(self) -> float:
        """Seconds since the beginning of the batch."""
        return self._clock() - self._start_s

    def num(self, status: Status) -> int:
        return sum(row.status == status for row in self.rows)

    def seconds_left(self) -> float | None:
        """Return the expected seconds until the end, from the mean duration of finished surveys; None before one is."""
        taken = [row.seconds for row in self.rows if row.status == "done" and row.seconds is not None]
        if not taken:
            return None
        mean = sum(taken) / len(taken)
        running = [max(0.0, mean - self.seconds_running(row)) for row in self.rows if row.began_s is not None]
        work = self.num("waiting") * mean + sum(running)
        return max(work / self.num_at_once, max(running, default=0.0))

    def seconds_running(self, row: SurveyRow) -> float:
        """Return the seconds since the present attempt began, or 0 if the survey is not running."""
        return 0.0 if row.began_s is None else self._clock() - row.began_s

    def tell(self, index: int, message: dict[str, Any]) -> None:
        """Take in a message of the process of the survey with this index, or of its worker."""
        row = self.rows[index]
        if row.is_over:
            return
        if "began_on" in message:
            row.status, row.host, row.began_s = "running", message["began_on"], self._clock()
            row.num_attempts += 1
            row.stage, row.num_done, row.num_total = "", 0, 0
            self.num_at_once = max(self.num_at_once, self.num("running"))
        elif "stage" in message:
            row.stage, row.num_done, row.num_total = message["stage"], 0, 0
        elif "num_done" in message:
            row.num_done, row.num_total = message["num_done"], message["num_total"]

    def end(self, index: int, status: Status, reason: str, exit_status: int | None, **figures: Any) -> None:
        """End the survey with this index.

        Args:
            reason: why it failed, or why its verdict is not good; one line.
            exit_status: that ``rangesfm run`` would have.
            figures: its results (``figures_of``).
        """
        row = self.rows[index]
        row.seconds = None if row.began_s is None else self.seconds_running(row)
        row.status, row.reason, row.exit_status, row.began_s = status, reason, exit_status, None
        row.figures = {**row.figures, **figures}

    def end_all(self, status: Status, reason: str, exit_status: int | None = None) -> None:
        """End all surveys that are not over with this status."""
        for index, row in enumerate(self.rows):
            if not row.is_over:
                self.end(index, status, reason, exit_status)

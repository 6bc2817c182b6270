"""How far each survey of a batch is, and the whole of it."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

from rangesfm.batch.jobs import Job
from rangesfm.batch.rows import Figures, Status, SurveyRow
from rangesfm.errors import one_line


@dataclass(frozen=True)
class SurveyState:
    """A survey's row as far as it is known, and what it is doing.

    Attributes:
        stage: it is in.
        num_done, num_total: of the stage's items, where it counts them.
        began_s: its last attempt, on the course's clock.
    """

    row: SurveyRow
    stage: str = ""
    num_done: int | None = None
    num_total: int | None = None
    began_s: float | None = None


class BatchListener(Protocol):
    """Receives the course of a batch."""

    def show(self, course: Course) -> None:
        """Called on every change, and several times a second."""

    def message(self, text: str) -> None:
        """One line that the user should read."""


class Course:
    """All surveys of a batch; it changes as the workers tell.

    Attributes:
        num_at_once: surveys at once, as far as it is known.
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
        """Since the beginning."""
        return self._clock() - self._start_s

    def num(self, status: Status) -> int:
        return sum(row.status is status for row in self.rows)

    def seconds_left(self) -> float | None:
        """Until all are over, if the others take as long as those that are done; None before one is."""
        taken = [row.seconds for row in self.rows if row.status is Status.DONE and row.seconds is not None]
        if not taken:
            return None
        mean = sum(taken) / len(taken)
        running = [max(0.0, mean - self.seconds_running(state)) for state in self._states if state.began_s is not None]
        work = self.num(Status.WAITING) * mean + sum(running)
        return max(work / self.num_at_once, max(running, default=0.0))

    def seconds_running(self, state: SurveyState) -> float:
        """Since the last attempt began; 0 where none is going on."""
        return 0.0 if state.began_s is None else self._clock() - state.began_s

    def tell(self, index: int, message: dict[str, Any]) -> None:
        """A message of a survey's worker, or of its process."""
        state = self._states[index]
        if state.row.status.is_final:
            return
        if "began_on" in message:
            row = replace(
                state.row,
                status=Status.RUNNING,
                host=message["began_on"],
                num_attempts=state.row.num_attempts + 1,
            )
            self._states[index] = SurveyState(row, began_s=self._clock())
        elif "stage" in message:
            self._states[index] = replace(state, stage=message["stage"], num_done=None, num_total=None)
        elif "num_done" in message:
            self._states[index] = replace(state, num_done=message["num_done"], num_total=message["num_total"])

    def done(self, index: int, figures: Figures, reason: str) -> None:
        """With what it found, and the reasons of a verdict that is not good."""
        self._end(index, Status.DONE, reason, 0, figures)

    def failed(self, index: int, reason: str, exit_status: int) -> None:
        """One line why, and the exit status that ``rangesfm run`` has then."""
        self._end(index, Status.FAILED, reason, exit_status, Figures())

    def all_failed(self, reason: str, exit_status: int) -> None:
        """Whatever is not over has failed."""
        for index, row in enumerate(self.rows):
            if not row.status.is_final:
                self.failed(index, reason, exit_status)

    def interrupted(self) -> None:
        """Whatever is not over will not be."""
        for index, row in enumerate(self.rows):
            if not row.status.is_final:
                self._end(index, Status.INTERRUPTED, "interrupted", None, Figures())

    def _end(self, index: int, status: Status, reason: str, exit_status: int | None, figures: Figures) -> None:
        state = self._states[index]
        seconds = None if state.began_s is None else self.seconds_running(state)
        row = replace(
            state.row, status=status, reason=reason, exit_status=exit_status, seconds=seconds, figures=figures
        )
        self._states[index] = SurveyState(row)


def _first_row(job: Job) -> SurveyRow:
    output = "" if job.survey is None else one_line(str(job.survey.output.path))
    if job.failure is None:
        return SurveyRow(job.name, output_path=output)
    return SurveyRow(
        job.name, Status.FAILED, reason=job.failure.message, exit_status=job.failure.exit_status, output_path=output
    )

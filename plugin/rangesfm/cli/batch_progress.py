"""A batch for people: a line for each survey at work that updates itself on a terminal, plain lines elsewhere."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TYPE_CHECKING, TextIO

from rangesfm.cli.terminal import Screen, counts, duration

if TYPE_CHECKING:
    from rangesfm.batch.course import Course, SurveyState

_INTERVAL_S = 0.2
_MAX_NUM_LINES = 20


class BatchTerminal:
    """Writes the course of a batch to ``stream``."""

    def __init__(self, stream: TextIO, *, quiet: bool = False, clock: Callable[[], float] = time.monotonic):
        self._screen = Screen(stream, quiet=quiet)
        self._clock = clock
        self._last_drawn: float | None = None
        self._told: dict[int, str] = {}
        self._num_over = 0

    def show(self, course: Course) -> None:
        """Say what is new, and on a terminal draw again what is going on."""
        new = self._news(course)
        now = self._clock()
        if new or course.is_over:
            self._screen.say(new)
        if not course.is_over and (new or self._last_drawn is None or now - self._last_drawn >= _INTERVAL_S):
            self._last_drawn = now
            self._screen.draw(_going_on(course))

    def message(self, text: str) -> None:
        self._screen.say([text])

    def _news(self, course: Course) -> list[str]:
        """Lines on the surveys of which there is something to say that has not been said."""
        lines = []
        for index, state in enumerate(course.states):
            line = _ended(state) if state.row.status.is_final else "" if self._screen.is_terminal else _stage(state)
            if line and self._told.get(index) != line:
                self._told[index] = line
                lines.append(line)
        num_over = sum(row.status.is_final for row in course.rows)
        if num_over > self._num_over and not self._screen.is_terminal:
            lines.append(_summary(course))
        self._num_over = num_over
        return lines


def _going_on(course: Course) -> list[str]:
    running = [state for state in course.states if state.began_s is not None]
    lines = [f"  {_stage(state)}{_counted(state)}, {duration(course.seconds_running(state))}" for state in running]
    return [*lines[:_MAX_NUM_LINES], _summary(course)]


def _stage(state: SurveyState) -> str:
    if state.began_s is None:
        return ""
    again = f" again, attempt {state.row.num_attempts}" if state.row.num_attempts > 1 else ""
    return f"{state.row.survey}: {state.stage or 'begins' + again}"


def _counted(state: SurveyState) -> str:
    return "" if state.num_done is None else f" {counts(state.num_done, state.num_total)}"


def _ended(state: SurveyState) -> str:
    row = state.row
    seconds = "" if row.seconds is None else f" after {duration(row.seconds)}"
    what = f"{row.figures.verdict or row.status.value}" if row.exit_status == 0 else row.status.value
    reason = f": {row.reason}" if row.reason and row.reason != what else ""
    return f"{row.survey}: {what}{seconds}{reason}"


def _summary(course: Course) -> str:
    num_over = sum(row.status.is_final for row in course.rows)
    num_failed = sum(bool(row.exit_status) for row in course.rows)
    failed = f", {num_failed} of them failed" if num_failed else ""
    left = course.seconds_left()
    time_left = "" if left is None or course.is_over else f", {duration(left)} left"
    return f"{num_over} of {len(course.rows)} surveys over{failed}, {duration(course.seconds)}{time_left}"

"""Progress for people: one line that updates itself on a terminal, a few plain lines elsewhere."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TextIO

from rangesfm.errors import one_line

_ERASE_LINE = "\r\033[K"
_TERMINAL_INTERVAL_S = 0.1
_PLAIN_INTERVAL_S = 10.0


class TerminalProgress:
    """Writes the course of a run to ``stream``."""

    def __init__(self, stream: TextIO, *, quiet: bool = False, clock: Callable[[], float] = time.monotonic):
        self._stream = stream
        self._quiet = quiet
        self._clock = clock
        self._is_terminal = stream.isatty()
        self._stage: str | None = None
        self._stage_start = self._last_update = clock()

    def stage(self, name: str) -> None:
        self.end_stage()
        self._stage = name
        self._stage_start = self._last_update = self._clock()
        self._write(name if self._is_terminal else f"{name} ...\n")

    def update(self, num_done: int, num_total: int | None = None) -> None:
        now = self._clock()
        if now - self._last_update >= (_TERMINAL_INTERVAL_S if self._is_terminal else _PLAIN_INTERVAL_S):
            self._last_update = now
            line = f"{self._stage or ''} {counts(num_done, num_total, now - self._stage_start)}".strip()
            self._write(line[: shutil.get_terminal_size().columns - 1] if self._is_terminal else f"{line}\n")

    def message(self, text: str) -> None:
        self._write(f"{one_line(text)}\n")

    def end_stage(self, *, failed: bool = False) -> None:
        """The current stage, if any, has ended."""
        if self._stage is not None:
            ending = "stopped after " if failed else ""
            self._write(f"{self._stage}: {ending}{duration(self._clock() - self._stage_start)}\n")
            self._stage = None

    def _write(self, text: str) -> None:
        if not self._quiet:
            self._stream.write(f"{_ERASE_LINE}{text}" if self._is_terminal else text)
            self._stream.flush()


@contextmanager
def terminal_progress(stream: TextIO, *, quiet: bool = False) -> Iterator[TerminalProgress]:
    """Yield the progress of a run, whose last stage ends with the block."""
    progress = TerminalProgress(stream, quiet=quiet)
    try:
        yield progress
    except BaseException:
        progress.end_stage(failed=True)
        raise
    progress.end_stage()


def counts(num_done: int, num_total: int | None, seconds: float = 0.0) -> str:
    """How many of how many; with the seconds it took so far, how long the rest will take."""
    if num_total is None or num_total <= 0:
        return str(num_done)
    text = f"{num_done}/{num_total}, {100 * num_done // num_total} %"
    if seconds > 0 and 0 < num_done < num_total:
        text += f", {duration(seconds * (num_total - num_done) / num_done)} left"
    return text


def duration(seconds: float) -> str:
    """As hours, minutes and seconds, no finer than needed."""
    if seconds < 60:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest:02d} s" if minutes < 60 else f"{minutes // 60} h {minutes % 60:02d} min"

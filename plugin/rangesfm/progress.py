"""Progress of long work, reported to whoever listens, and the record that a run keeps of it."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Final


class Progress:
    """Listener to the progress of a run. This one ignores everything, which is the default; others derive from it."""

    def stage(self, name: str) -> None:
        """Note that a stage begins (for example ``"features"``), and that the previous one has ended."""

    def update(self, num_done: int, num_total: int = 0) -> None:
        """Note how many items of the current stage are done, of how many (0: unknown)."""

    def message(self, text: str) -> None:
        """Receive one line that the user should read."""


SILENT: Final = Progress()


@dataclass
class Journal:
    """Record of a run beside its results: seconds by stage, warnings and notes.

    Attributes:
        progress: the listener that is told of stages, warnings and notes.
        seconds: by name of the stage.
        warnings: one line each, about what may be wrong with the result.
        notes: one line each, about how the inputs were understood.
        start: reading of the monotonic clock, seconds.
        stage_name: stage that was announced last.
    """

    progress: Progress
    seconds: dict[str, float] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    start: float = field(default_factory=time.monotonic)
    stage_name: str = ""

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Announce a stage to the listener, unless it is the one that was announced last, and time it."""
        if name != self.stage_name:
            self.stage_name = name
            self.progress.stage(name)
        with self.timed(name):
            yield

    @contextmanager
    def timed(self, name: str) -> Iterator[None]:
        """Time a piece of work without announcing it."""
        start = time.monotonic()
        yield
        self.seconds[name] = self.seconds.get(name, 0.0) + time.monotonic() - start

    def all_seconds(self) -> dict[str, float]:
        """Return the seconds by stage, and the time since the start as ``"total"``."""
        return {**self.seconds, "total": time.monotonic() - self.start}

    def warn(self, *texts: str) -> None:
        """Tell the user these warnings, and keep them for ``result.json``."""
        self._tell(texts, self.warnings)

    def note(self, *texts: str) -> None:
        """Tell the user how inputs were understood, and keep these lines for ``result.json``."""
        self._tell(texts, self.notes)

    def _tell(self, texts: Sequence[str], kept: list[str]) -> None:
        for text in texts:
            kept.append(text)
            self.progress.message(text)


def format_duration(seconds: float) -> str:
    """Return a duration as text: "12.3 s", "5 min 03 s" or "2 h 07 min"."""
    if seconds < 60:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest:02d} s" if minutes < 60 else f"{minutes // 60} h {minutes % 60:02d} min"

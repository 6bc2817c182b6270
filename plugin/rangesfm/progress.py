"""How long work tells what it is doing, without knowing who listens; and what a run keeps of that."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Protocol


class Progress(Protocol):
    """Receives the course of a run. The command line prints it; a library user may ignore it."""

    def stage(self, name: str) -> None:
        """A stage begins (for example ``"features"``); the previous one has ended."""

    def update(self, num_done: int, num_total: int | None = None) -> None:
        """``num_done`` of ``num_total`` items of the current stage are done (None: unknown)."""

    def message(self, text: str) -> None:
        """One line that the user should read."""


class SilentProgress:
    """Listens to nothing: the default of every stage."""

    def stage(self, name: str) -> None:
        pass

    def update(self, num_done: int, num_total: int | None = None) -> None:
        pass

    def message(self, text: str) -> None:
        pass


@dataclass
class Journal:
    """What happened in a run, beside its results."""

    progress: Progress
    seconds: dict[str, float] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)
    start: float = field(default_factory=time.monotonic)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Tell of a stage and time it."""
        self.progress.stage(name)
        with self.timed(name):
            yield

    @contextmanager
    def timed(self, name: str) -> Iterator[None]:
        """Time what is too short to tell of."""
        start = time.monotonic()
        yield
        self.seconds[name] = self.seconds.get(name, 0.0) + time.monotonic() - start

    def all_seconds(self) -> dict[str, float]:
        """By stage, and in total."""
        return {**self.seconds, "total": time.monotonic() - self.start}

    def warn(self, *texts: str) -> None:
        """Lines for the user, kept for ``result.json``."""
        for text in texts:
            self.warnings.append(text)
            self.progress.message(text)


def duration(seconds: float) -> str:
    """As hours, minutes and seconds, no finer than needed."""
    if seconds < 60:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest:02d} s" if minutes < 60 else f"{minutes // 60} h {minutes % 60:02d} min"

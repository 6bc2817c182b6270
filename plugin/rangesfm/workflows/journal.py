"""Journal: seconds by stage and warnings, collected while the user is told."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

from rangesfm.progress import Progress


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

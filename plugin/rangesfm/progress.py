"""How long work tells what it is doing, without knowing who listens."""

from __future__ import annotations

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

"""A Progress that records what it is told."""

from __future__ import annotations

from rangesfm.progress import Progress


class Listener(Progress):
    """A Progress that records stages, counts by stage, and messages."""

    def __init__(self) -> None:
        self.stages: list[str] = []
        self.updates: dict[str, list[tuple[int, int]]] = {}
        self.messages: list[str] = []

    def stage(self, name: str) -> None:
        self.stages.append(name)

    def update(self, num_done: int, num_total: int = 0) -> None:
        self.updates.setdefault(self.stages[-1], []).append((num_done, num_total))

    def message(self, text: str) -> None:
        self.messages.append(text)

"""Damaged recordings: some bytes are changed, and the end is missing."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from pathlib import Path

from hypothesis import strategies as st

from rangesfm.errors import InputError
from rangesfm.survey.sources.source import open_source


@dataclass(frozen=True)
class Damage:
    """Damage to a file: bytes written at positions given as shares of its length, and the share of it that is kept."""

    bytes_at: list[tuple[float, int]]
    kept: float

    def read_or_refused(self, path: Path) -> None:
        """Damage the file, and look at all frames of what is left."""
        content = bytearray(path.read_bytes())
        for position, byte in self.bytes_at:
            content[int(position * len(content))] = byte
        path.write_bytes(content[: int(self.kept * len(content))])
        with contextlib.suppress(InputError):
            assert all(frame.grey().mode == "L" for frame in open_source(path, "").frames())


DAMAGES = st.builds(
    Damage,
    st.lists(st.tuples(st.floats(0, 1, exclude_max=True), st.integers(0, 255)), min_size=1, max_size=20),
    st.floats(0.1, 1),
)

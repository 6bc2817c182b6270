"""Redirection of COLMAP's log from the terminal into a file."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from rangesfm.colmap.glog import logging_into
from rangesfm.files.atomic import scratch_folder


@contextmanager
def colmap_log(path: Path) -> Iterator[None]:
    """Append what COLMAP logs inside the block to ``path``; blocks as for ``logging_into``.

    glog adds a time and a number to the name of its file, so that it gets a temporary folder.
    """
    with scratch_folder(path) as folder:
        try:
            with logging_into(folder):
                yield
        finally:
            for part in sorted(folder.iterdir()):
                append_log(part, path)


def append_log(part: Path, path: Path) -> None:
    """Append the log of another process to ``path``, if that log exists."""
    with suppress(FileNotFoundError), path.open("ab") as log:
        log.write(part.read_bytes())

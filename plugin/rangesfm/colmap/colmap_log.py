"""File of what COLMAP logs, in place of the terminal."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from rangesfm.colmap.glog import logging_into
from rangesfm.util.files.atomic import scratch_folder


@contextmanager
def colmap_log(path: Path) -> Iterator[Path]:
    """Append what COLMAP logs inside the block to ``path``; blocks as for ``logging_into``.

    Yields the temporary folder of the messages, into which other processes may log too: glog adds a time and the number
    of the process to the names of its files.
    """
    with scratch_folder(path) as folder:
        try:
            with logging_into(folder):
                yield folder
        finally:
            for part in sorted(folder.iterdir()):
                with path.open("ab") as log:
                    log.write(part.read_bytes())

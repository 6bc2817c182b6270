"""Redirection of COLMAP's log from the terminal into a file."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pycolmap

from rangesfm.files.atomic import scratch_folder

_FLAGS_INTO_FILE = {"alsologtostderr": False, "logtostderr": False, "stderrthreshold": 3, "minloglevel": 0}


@contextmanager
def colmap_log(path: Path) -> Iterator[None]:
    """Append what COLMAP logs inside the block to ``path``.

    COLMAP logs through glog, which has one destination per process. Blocks must therefore not nest, nor run at the same
    time in two threads. glog adds a time and a number to the name of its file, so that it gets a temporary folder.
    Afterwards the flags are restored. glog's default files in the system's temporary folder stay off.
    """
    logging = pycolmap.logging
    levels = logging.Level.__members__.values()
    flags = {name: getattr(logging, name) for name in _FLAGS_INTO_FILE}
    with scratch_folder(path) as folder:
        for level in levels:
            logging.set_log_destination(level, "")
        logging.set_log_destination(logging.INFO, folder / "colmap.")
        _set_flags(_FLAGS_INTO_FILE)
        try:
            yield
        finally:
            _set_flags(flags)
            logging.set_log_destination(logging.INFO, "")
            for part in sorted(folder.iterdir()):
                append_log(part, path)


def append_log(part: Path, path: Path) -> None:
    """Append the log of another process to ``path``, if that log exists."""
    with suppress(FileNotFoundError), path.open("ab") as log:
        log.write(part.read_bytes())


def _set_flags(flags: dict[str, bool | int]) -> None:
    for name, value in flags.items():
        setattr(pycolmap.logging, name, value)

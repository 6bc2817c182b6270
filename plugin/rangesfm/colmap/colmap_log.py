"""What COLMAP logs (by glog, which has one destination per process), in files and not on the terminal."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pycolmap

from rangesfm.util.files.atomic import scratch_folder

_FLAGS_INTO_FILE = {"alsologtostderr": False, "logtostderr": False, "stderrthreshold": 3, "minloglevel": 0}


@contextmanager
def logging_into(folder: Path) -> Iterator[None]:
    """Write what COLMAP logs inside the block to new files in a folder, and not to the terminal.

    Blocks must not nest, nor run at the same time in two threads. Afterwards the flags are restored. glog's default
    files in the system's temporary folder stay off.
    """
    logging = pycolmap.logging
    flags = {name: getattr(logging, name) for name in _FLAGS_INTO_FILE}
    for level in logging.Level.__members__.values():
        logging.set_log_destination(level, "")
    logging.set_log_destination(logging.INFO, folder / "colmap.")
    _set_flags(_FLAGS_INTO_FILE)
    try:
        yield
    finally:
        _set_flags(flags)
        logging.set_log_destination(logging.INFO, "")


def _set_flags(flags: dict[str, bool | int]) -> None:
    for name, value in flags.items():
        setattr(pycolmap.logging, name, value)


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

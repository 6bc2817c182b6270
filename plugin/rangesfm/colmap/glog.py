"""glog, COLMAP's logger, which has one destination per process, made to log into files and not to the terminal."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pycolmap

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

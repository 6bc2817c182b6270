"""One process at a time writes to an output folder."""

from __future__ import annotations

import json
import os
import re
import shutil
import socket
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

from rangesfm.errors import InputError
from rangesfm.files.atomic import LEFTOVER, make_output_folder

if TYPE_CHECKING:
    from filelock import BaseFileLock

LOCK_NAME = ".rangesfm.lock"

# For a holder that ends, and removes the file, between two tries.
_MAX_WAIT_S = 0.2

# Folders that this thread holds: what it calls meanwhile may ask for them again.
_held: ContextVar[frozenset[Path]] = ContextVar("held", default=frozenset())


@contextmanager
def sole_writer(folder: Path) -> Iterator[None]:
    """Keep other runs out of ``folder`` inside the block; clear away what killed ones left half-written there.

    The folder is made if need be, and is gone again if nothing was written to it. The lock is the
    kernel's, so a killed process leaves none behind; where the file system knows no locks there is
    none at all.

    Raises:
        InputError: another process (or thread) writes there, or the folder cannot be written to.
    """
    key = folder.resolve()
    if key in _held.get():
        yield
        return
    made = [path for path in (key, *key.parents) if not path.exists()]
    make_output_folder(folder)
    lock = _lock(folder)
    token = _held.set(_held.get() | {key})
    try:
        remove_leftovers(folder)
        yield
    finally:
        _held.reset(token)
        with suppress(OSError):  # Windows removes no open file
            (folder / LOCK_NAME).unlink()  # before it is let go, or it might already be another's
        lock.release()
        for path in made:
            with suppress(OSError):  # not empty
                path.rmdir()


def _lock(folder: Path) -> BaseFileLock:
    """The lock of a folder, held unless the file system knows none."""
    from filelock import FileLock, Timeout

    path = folder / LOCK_NAME
    lock = FileLock(path)
    try:
        lock.acquire(timeout=_MAX_WAIT_S, poll_interval=_MAX_WAIT_S / 4)
    except Timeout:
        raise InputError(f"{_holder(path)}: wait for it to end, or give another output path", folder) from None
    except OSError:
        path.unlink(missing_ok=True)
        return lock
    with suppress(OSError):  # on Windows nobody can write there now: then others are not told whose it is
        path.write_text(_own_name(), encoding="utf-8")
    return lock


def _own_name() -> str:
    program, *arguments = sys.argv or ["python"]
    name = "rangesfm" if Path(program).name == "__main__.py" else Path(program).name
    command = " ".join([name, *arguments])
    since = datetime.now().astimezone().isoformat(sep=" ", timespec="seconds")
    return json.dumps({"pid": os.getpid(), "host": socket.gethostname(), "command": command, "since": since})


def _holder(lock: Path) -> str:
    """Who writes to the folder, by what the lock file says."""
    try:
        holder = json.loads(lock.read_text(encoding="utf-8", errors="replace"))
        host = "" if holder["host"] == socket.gethostname() else f" on {holder['host']}"
        who, since = f"process {holder['pid']}{host} ({holder['command']})", holder["since"]
        return f"{who} has been writing to this folder since {since}"
    except (OSError, ValueError, TypeError, KeyError, RecursionError):  # it has only just begun
        return "another process is writing to this folder"


def remove_leftovers(folder: Path) -> None:
    """Remove what killed processes left half-written in ``folder`` and in the folders in it."""
    inside = [path for path in folder.iterdir() if path.is_dir() and not path.is_symlink()]
    for path in [path for parent in (folder, *inside) for path in _entries(parent)]:
        found = re.fullmatch(LEFTOVER, path.name)
        if found is None or _is_alive(int(found["pid"])):
            continue
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)


def _entries(folder: Path) -> list[Path]:
    try:
        return list(folder.iterdir())
    except OSError:  # gone, or not ours to look into
        return []


def _is_alive(pid: int) -> bool:
    """Whether another process has this number: our own leftovers are those of one before us that had it."""
    import psutil

    try:  # one that has ended stays until its parent asks for it
        return pid != os.getpid() and psutil.Process(pid).status() not in (psutil.STATUS_ZOMBIE, psutil.STATUS_DEAD)
    except psutil.AccessDenied:
        return True
    except (psutil.NoSuchProcess, OverflowError):
        return False

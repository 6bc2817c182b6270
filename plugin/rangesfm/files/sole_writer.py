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

from rangesfm.errors import InputError
from rangesfm.files.atomic import LEFTOVER, make_output_folder

LOCK_NAME = ".rangesfm.lock"

# Of /proc/PID/stat (proc(5)): its third field, the first one after the name, is the state, the ninth are the flags.
_ENDED_STATES = (b"Z", b"X")
_FLAGS_FIELD = 5  # after the state
_IS_EXITING = 0x4  # PF_EXITING

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
    lock = folder / LOCK_NAME
    descriptor = _lock(lock)
    token = _held.set(_held.get() | {key})
    try:
        remove_leftovers(folder)
        yield
    finally:
        _held.reset(token)
        if descriptor is not None:
            lock.unlink(missing_ok=True)  # before it is let go, or it might already be another's
            os.close(descriptor)
        for path in made:
            with suppress(OSError):  # not empty
                path.rmdir()


def _lock(path: Path) -> int | None:
    """The open lock file; None where there are no locks."""
    if sys.platform == "win32":
        return None
    import fcntl

    while True:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            text = os.read(descriptor, 1 << 16).decode(errors="replace")
            os.close(descriptor)
            raise InputError(f"{_whose(text)}: wait for it to end, or give another output path", path.parent) from None
        except OSError:
            os.close(descriptor)
            path.unlink(missing_ok=True)
            return None
        if _is_file_at(descriptor, path):
            os.ftruncate(descriptor, 0)
            os.write(descriptor, _own_name().encode())
            return descriptor
        os.close(descriptor)  # its holder ended, and removed it, between the two calls


def _is_file_at(descriptor: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(descriptor), path.stat())
    except FileNotFoundError:
        return False


def _own_name() -> str:
    program, *arguments = sys.argv or ["python"]
    name = "rangesfm" if Path(program).name == "__main__.py" else Path(program).name
    command = " ".join([name, *arguments])
    since = datetime.now().astimezone().isoformat(sep=" ", timespec="seconds")
    return json.dumps({"pid": os.getpid(), "host": socket.gethostname(), "command": command, "since": since})


def _whose(text: str) -> str:
    """Who writes to the folder, by the text of the lock file."""
    try:
        holder = json.loads(text)
        host = "" if holder["host"] == socket.gethostname() else f" on {holder['host']}"
        who, since = f"process {holder['pid']}{host} ({holder['command']})", holder["since"]
        return f"{who} has been writing to this folder since {since}"
    except (ValueError, TypeError, KeyError, RecursionError):  # it has only just begun
        return "another process is writing to this folder"


def remove_leftovers(folder: Path) -> None:
    """Remove what killed processes left half-written in ``folder`` and in the folders in it."""
    if sys.platform == "win32":  # nobody can be asked there whether a process still lives
        return
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
    if pid == os.getpid():
        return False
    try:
        os.kill(pid, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        pass
    return not _is_ending(pid)


def _is_ending(pid: int) -> bool:
    """Whether a process has ended but for its entry, which stays until its parent asks for it."""
    if sys.platform != "linux":
        return False
    try:
        state, *numbers = Path(f"/proc/{pid}/stat").read_bytes().rpartition(b")")[2].split()
    except OSError:  # asked for in this moment
        return True
    return state in _ENDED_STATES or bool(int(numbers[_FLAGS_FIELD]) & _IS_EXITING)

"""Outputs appear whole or not at all, written by one process at a time; files are known by their content."""

from __future__ import annotations

import glob
import hashlib
import json
import os
import re
import shutil
import socket
import sys
import tempfile
import unicodedata
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rangesfm.errors import InputError

if TYPE_CHECKING:
    from filelock import BaseFileLock


LEFTOVER = r"\..+\.(?P<pid>\d+)\.(part(\..+)?|old)"
"""Names of what the functions here have in the making, with the number of the process that made it."""


_CHUNK_BYTES = 1 << 20
_NOT_IN_NAMES = ("Cc", "Cs", "Zl", "Zp")  # control characters, bytes that are no text, ends of lines and paragraphs
LOCK_NAME = ".rangesfm.lock"
# For a holder that ends, and removes the file, between two tries.
_MAX_WAIT_S = 0.2
# Folders that this thread holds: what it calls meanwhile may ask for them again.
_held: ContextVar[frozenset[Path]] = ContextVar("held", default=frozenset())


def sha256_of(path: Path) -> str:
    """SHA-256 of a file's content, in hexadecimal."""
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while chunk := file.read(_CHUNK_BYTES):
            digest.update(chunk)
    return digest.hexdigest()


def state_and_sha256(path: Path, known: Any = None) -> tuple[tuple[int, int, int], str]:
    """Size and times of change of a file, and its SHA-256.

    Args:
        known: what an earlier call returned, perhaps by way of JSON: the file is not read again while its state is
            the same.
    """
    found = path.stat()
    # The second time is the file system's own: it also moves when a program sets the first one back.
    state = (found.st_size, found.st_mtime_ns, found.st_ctime_ns)
    if isinstance(known, (list, tuple)) and len(known) == 2 and known[0] in (state, [*state]):
        return state, str(known[1])
    return state, sha256_of(path)


def stays_inside(name: str) -> bool:
    """Whether a name from a file, taken relative to a folder, cannot lead out of it."""
    path = Path(name)
    return not path.is_absolute() and ".." not in path.parts


def path_of(text: str) -> Path:
    """The path that text from a file stands for, also under a locale that cannot spell it: then it is UTF-8."""
    try:
        os.fsencode(text)
    except UnicodeEncodeError:
        text = os.fsdecode(text.encode("utf-8", errors="surrogateescape"))
    return Path(text)


def is_plain_name(name: str) -> bool:
    """Whether a photo's name can stand in tables and files: some UTF-8 text on one line."""
    return bool(name) and not any(unicodedata.category(character) in _NOT_IN_NAMES for character in name)


def make_output_folder(path: Path) -> None:
    """Make ``path`` and check that it can be written to; raise InputError if not."""
    if path.resolve() == Path(path.resolve().anchor):
        raise InputError("is the root of the file system, expected a folder for the results", path)
    try:
        path.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path):
            pass
    except OSError as error:
        raise InputError(f"cannot write to this output folder ({error.strerror})", path) from error


@contextmanager
def new_file(path: Path) -> Iterator[Path]:
    """Yield a temporary sibling to write to; on success it takes the place of ``path``."""
    # With the same ending, by which libraries tell the format.
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.part{path.suffix}")
    _remove_dead(path.parent.glob(f".{glob.escape(path.stem)}.*.part{glob.escape(path.suffix)}"))
    try:
        yield temporary
        os.replace(temporary, path)
    except OSError as error:  # of a full disk, which says nothing of the file
        error.filename = error.filename or str(path)
        raise
    finally:
        temporary.unlink(missing_ok=True)


def write_text(text: str, path: Path) -> None:
    """Write a file of UTF-8, whole or not at all; of a path that is none, the bytes become escapes."""
    with new_file(path) as temporary:
        temporary.write_text(text, encoding="utf-8", errors="backslashreplace")


@contextmanager
def scratch_folder(path: Path) -> Iterator[Path]:
    """Yield a temporary folder beside ``path``, named after it, that is gone afterwards.

    Unlike tempfile's it also goes when Ctrl-C falls into its making or its removal.
    """
    folder = path.with_name(f".{path.name}.{os.getpid()}.part")  # the name first: nothing to lose track of
    try:
        try:
            shutil.rmtree(folder, ignore_errors=True)  # of a process that was killed and had the same number
            folder.mkdir(parents=True)
            yield folder
        finally:
            shutil.rmtree(folder, ignore_errors=True)
    finally:  # again: a Ctrl-C may have ended the first
        shutil.rmtree(folder, ignore_errors=True)


@contextmanager
def new_folder(path: Path) -> Iterator[Path]:
    """Yield a temporary sibling folder; on success it takes the place of the folder ``path``."""
    with scratch_folder(path) as temporary:
        yield temporary
        old = temporary.with_suffix(".old")
        try:
            if path.exists():
                path.rename(old)
            temporary.rename(path)
        finally:
            if old.exists() and not path.exists():  # interrupted halfway
                old.rename(path)
            shutil.rmtree(old, ignore_errors=True)


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
    for parent, subfolders, names in os.walk(folder):  # passes over what is gone, or not ours to look into
        _remove_dead(Path(parent, name) for name in (*subfolders, *names))
        if Path(parent) != folder:
            subfolders.clear()


def _remove_dead(paths: Iterable[Path]) -> None:
    """Remove those that a process which is no more had in the making."""
    for path in paths:
        found = re.fullmatch(LEFTOVER, path.name)
        if found is None or _is_alive(int(found["pid"])):
            continue
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)


def _is_alive(pid: int) -> bool:
    """Whether another process has this number: our own leftovers are those of one before us that had it."""
    import psutil

    try:  # one that has ended stays until its parent asks for it
        return pid != os.getpid() and psutil.Process(pid).status() not in (psutil.STATUS_ZOMBIE, psutil.STATUS_DEAD)
    except psutil.AccessDenied:
        return True
    except (psutil.NoSuchProcess, OverflowError):
        return False

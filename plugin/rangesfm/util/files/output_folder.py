"""Output folder that one process at a time writes to, and where files that this tool did not write are never lost.

A hidden folder inside it holds unfinished files, the lock, and the record of what was written.
"""

from __future__ import annotations

import itertools
import json
import os
import shutil
import socket
import sys
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from datetime import datetime
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING

from rangesfm.errors import InputError
from rangesfm.util.files.folders import real_path
from rangesfm.util.files.manifest import Manifest

if TYPE_CHECKING:
    from filelock import BaseFileLock

PRIVATE_NAME = ".rangesfm"
DEFAULT_OUTPUT = "out"
LOCK_NAME = f"{PRIVATE_NAME}/lock"
_PARTS_NAME = "parts"
# Time to wait for the lock. The short wait covers a holder that is just ending, the long one a holder that writes a
# single file.
_MAX_WAIT_S = 0.2
_MAX_WAIT_FOR_ONE_FILE_S = 10.0
_NOT_OURS = "is not a file that rangesfm wrote, or has changed since: move it away, or give another output path"
_NUM_TRIES = 5
_LOCK_BEGIN = '{"pid": '
_numbers = itertools.count()


class OutputFolder:
    """A folder that this process alone writes to while the object is in use; see ``sole_writer``.

    Attributes:
        path: the folder, absolute and without links.
        private: the hidden folder inside it, whose content is this tool's own.
    """

    def __init__(self, path: Path, *, is_locked: bool):
        """Finish what a killed process had begun to publish, and remove what it had in the making.

        Args:
            is_locked: whether other processes are kept out. Otherwise they may have something in the making, too.
        """
        self.path = path
        self._is_locked = is_locked
        self.private = path / PRIVATE_NAME
        self._manifest = Manifest(path, self.private)
        self._deferred: dict[Path, Path] = {}
        self._emptied: set[Path] = set()
        self._finish_moves()
        self.clear_parts()

    def part(self, name: str) -> Path:
        """Return a unique path for an unfinished file or folder, on the same file system."""
        folder = self.private / _PARTS_NAME
        folder.mkdir(exist_ok=True)
        return folder / f"{os.getpid()}-{next(_numbers)}-{name}"

    def require_own(self, targets: Iterable[Path]) -> None:
        """Check that everything at these paths, or inside them, was written by this tool and is unchanged.

        Raises:
            InputError: something was not, or a parent folder is a link; the message names it.
        """
        for target in targets:
            for parent in target.parents:
                if parent == self.path:
                    break
                if parent.is_symlink():
                    raise InputError("is a link, expected a folder: give another output path", parent)
            try:
                foreign = self._manifest.foreign_file(target)
            except OSError as error:
                raise InputError(f"cannot be read ({error.strerror}) and is therefore not replaced", target) from error
            if foreign is not None:
                raise InputError(_NOT_OURS, foreign)

    def is_own(self, path: Path) -> bool:
        """Return whether the file at this path was written by this tool and is unchanged."""
        return os.path.lexists(path) and self._manifest.foreign_file(path) is None

    def defer(self, new: Mapping[Path, Path]) -> None:
        """Add files and folders, by their places, to the next ``publish`` that replaces a whole result.

        Their folders are removed then.
        """
        self._deferred.update(new)
        self._emptied.update(source.parent for source in new.values())

    def newest(self, place: Path) -> Path:
        """Return the file that the next whole result will have at this place, as far as it is known."""
        return self._deferred.get(place, place)

    def publish(self, new: Mapping[Path, Path], removed: Sequence[Path] = (), *, last: Path | None = None) -> None:
        """Move files and folders into the places of earlier ones: all of them, or none if that fails.

        If the process is killed in between, the next one that writes to the folder finishes the moves.

        Args:
            new: for each place the file or folder that goes there, from the private folder.
            last: a file whose presence says that the others are complete. It is removed first and placed last.

        Raises:
            InputError: something in one of the places is not this tool's own.
        """
        if last is not None:
            new, self._deferred = {**self._deferred, **new}, {}
        targets = [*removed, *(target for target in new if target != last)]
        moves: list[tuple[Path | None, Path]] = [(new.get(target), target) for target in targets]
        if last is not None:
            moves = [(None, last), *moves, *([(new[last], last)] if last in new else [])]
        self.require_own({target for _, target in moves})
        self._manifest.expect(new)
        names = (source.relative_to(self.private).as_posix() if source else "" for source, _ in moves)
        places = (target.relative_to(self.path).as_posix() for _, target in moves)
        self._manifest.moves = [*zip(names, places, strict=True)]
        self._manifest.save()
        done: list[tuple[Path, Path]] = []
        try:
            self._move(moves, done)
        except BaseException:
            for before, after in reversed(done):
                if os.path.lexists(after) and not os.path.lexists(before):
                    os.rename(after, before)
            self._manifest.moves = []
            self._manifest.save()
            raise
        self._settle(target for _, target in moves)
        if last is not None:
            for folder in self._emptied:
                remove(folder)
            self._emptied = set()

    def _move(self, moves: Iterable[tuple[Path | None, Path]], done: list[tuple[Path, Path]]) -> None:
        """Move each source to its target, after what is there has been moved away; ``done`` gets the renames."""
        for source, target in moves:
            if os.path.lexists(target):
                _rename(target, self.part(target.name), done)
            if source is not None:
                target.parent.mkdir(parents=True, exist_ok=True)
                _rename(source, target, done)

    def _settle(self, targets: Iterable[Path]) -> None:
        self._manifest.moves = []
        self._manifest.settle(targets)
        self._manifest.save()

    def _finish_moves(self) -> None:
        """Finish the moves that a killed process had begun; all that they need is still there."""
        moves = [
            (self.private / source if source else None, self.path / target) for source, target in self._manifest.moves
        ]
        if not moves:
            return
        self.require_own(target for _, target in moves)
        filled = {target for source, target in moves if source is not None}
        # A source that is gone has been moved already; what was cleared first and then filled is not cleared again.
        left = [(s, t) for s, t in moves if (t not in filled if s is None else os.path.lexists(s))]
        self._move(left, [])
        self._settle(target for _, target in moves)

    def clear_parts(self) -> None:
        """Remove what is unfinished, and what was replaced."""
        folder = self.private / _PARTS_NAME
        for path in sorted(folder.iterdir()) if folder.is_dir() and not folder.is_symlink() else ():
            if self._is_locked or path.name.startswith(f"{os.getpid()}-"):
                remove(path)
        with suppress(OSError):
            folder.rmdir()


_held: ContextVar[Mapping[Path, OutputFolder]] = ContextVar("held", default=MappingProxyType({}))
"""Output folders that this thread holds; code that it calls meanwhile gets the same object again."""


@contextmanager
def sole_writer(folder: Path, *, max_wait_s: float = _MAX_WAIT_S) -> Iterator[OutputFolder]:
    """Keep other runs out of ``folder`` inside the block, and remove unfinished files that killed runs left there.

    The folder is made if necessary, and removed again if nothing was written to it. The lock is the kernel's, so that
    a killed process leaves none behind. Where the file system has no locks, other runs are not kept out.

    Raises:
        InputError: another process (or thread) writes there, or the folder cannot be written to.
    """
    from filelock import FileLock

    key = real_path(folder)
    if key in _held.get():
        yield _held.get()[key]
        return
    private = key / PRIVATE_NAME
    made = [path for path in (private, key, *key.parents) if not os.path.lexists(path)]
    lock = FileLock(lock_file := key / LOCK_NAME)
    make_output_folder(folder)
    is_held = False
    try:
        _acquire(lock, folder, private, max_wait_s)
        is_held = True
        held = OutputFolder(key, is_locked=lock.is_locked)
        token = _held.set(MappingProxyType({**_held.get(), key: held}))
        try:
            yield held
        finally:
            _held.reset(token)
            held.clear_parts()
    finally:
        if is_held or lock.is_locked:  # a Ctrl-C may come when the lock has just been acquired
            with suppress(OSError):  # Windows does not remove an open file
                lock_file.unlink()  # before the release, after which the file may be another process's lock
            lock.release()
            made = [private, *made]
        for path in made:
            with suppress(OSError):  # the folder is not empty
                path.rmdir()


@contextmanager
def writer_of(path: Path) -> Iterator[OutputFolder]:
    """Yield the innermost held folder around ``path``, or else hold the parent folder of ``path`` inside the block."""
    path = absolute(path)
    around = [held for folder, held in _held.get().items() if path.is_relative_to(folder)]
    if around:
        yield max(around, key=lambda held: len(held.path.parts))
        return
    with sole_writer(path.parent, max_wait_s=_MAX_WAIT_FOR_ONE_FILE_S) as held:
        yield held


def absolute(path: Path) -> Path:
    """Return the absolute path with links in its parent folders resolved; a link at the path itself stays one."""
    return real_path(path.parent) / path.name


def is_private(path: Path) -> bool:
    """Return whether a path lies in the hidden folder of an output folder that this or another process holds."""
    return any(parent.name == PRIVATE_NAME and (parent / "lock").is_file() for parent in path.parents)


def free_output(folder: Path) -> Path:
    """Choose an output folder inside ``folder``: ``out``, unless it holds files that this tool did not write."""
    first = folder / DEFAULT_OUTPUT
    is_free = (
        not os.path.lexists(first) or (first / PRIVATE_NAME).is_dir() or (first.is_dir() and not os.listdir(first))
    )
    return first if is_free else folder / f"rangesfm_{DEFAULT_OUTPUT}"


def make_output_folder(path: Path) -> None:
    """Make the folder ``path`` and check that it can be written to.

    Raises:
        InputError: it cannot be made or written to, or is no place for an output folder.
    """
    real = real_path(path)
    if real == Path(real.anchor):
        raise InputError("is the root of the file system, expected a folder for the results", path)
    if PRIVATE_NAME in real.parts and not is_private(real):
        raise InputError(f"lies in a folder {PRIVATE_NAME}, which is reserved for rangesfm's own files", path)
    try:
        path.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path):
            pass
    except OSError as error:
        raise InputError(f"cannot write to this output folder ({error.strerror})", path) from error


def remove(path: Path) -> None:
    """Remove a file, a link or a whole folder; whatever cannot be removed stays without an error."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with suppress(OSError):
            path.unlink()


def _rename(source: Path, target: Path, done: list[tuple[Path, Path]]) -> None:
    done.append((source, target))  # noted first, because an interruption may come right after the rename
    os.rename(source, target)


def _acquire(lock: BaseFileLock, folder: Path, private: Path, max_wait_s: float) -> None:
    """Acquire the lock of a folder; it is not held where the file system has no locks."""
    from filelock import Timeout

    try:
        private.mkdir(parents=True, exist_ok=True)  # the parent may just have been removed
    except OSError as error:
        raise InputError("exists, expected rangesfm's own folder or nothing here", private) from error
    if private.is_symlink():
        raise InputError("is a link, expected rangesfm's own folder or nothing here", private)
    path = private / "lock"
    if os.path.lexists(path) and not _is_lock(path):
        raise InputError("is not a lock file of rangesfm's: move it away, or give another output path", path)
    for _ in range(_NUM_TRIES):
        try:
            lock.acquire(timeout=max_wait_s, poll_interval=_MAX_WAIT_S / 4)
        except Timeout:
            raise InputError(f"{_holder(path)}: wait for it to end, or give another output path", folder) from None
        except FileNotFoundError:  # another process has just ended and removed the private folder
            private.mkdir(parents=True, exist_ok=True)
            continue
        except OSError:  # the file system has no locks; the lock file still says who writes to the folder
            pass
        break
    program, *arguments = sys.argv or ["python"]
    command = " ".join(["rangesfm" if Path(program).name == "__main__.py" else Path(program).name, *arguments])
    since = datetime.now().astimezone().isoformat(sep=" ", timespec="seconds")
    holder = {"pid": os.getpid(), "host": socket.gethostname(), "command": command, "since": since}
    with suppress(OSError):  # on Windows a locked file cannot be written, and others are not told who holds the lock
        path.write_text(json.dumps(holder), encoding="utf-8")


def _is_lock(path: Path) -> bool:
    """Return whether a file is a lock of this tool: empty, as when just made, or with the entry of a holder."""
    try:
        if path.is_symlink() or not path.is_file():
            return False
        text = path.read_text(encoding="utf-8", errors="replace")
        return not text or text.startswith(_LOCK_BEGIN)
    except OSError:
        return False


def _holder(lock: Path) -> str:
    """Return a message that says who writes to the folder, as the lock file has it."""
    try:
        holder = json.loads(lock.read_text(encoding="utf-8", errors="replace"))
        host = "" if holder["host"] == socket.gethostname() else f" on {holder['host']}"
        who, since = f"process {holder['pid']}{host} ({holder['command']})", holder["since"]
        return f"{who} has been writing to this folder since {since}"
    except (OSError, ValueError, TypeError, KeyError, RecursionError):  # the holder has not written its entry yet
        return "another process is writing to this folder"

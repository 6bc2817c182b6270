"""The errors a user can meet, and how a run that failed ends; everything else that escapes is a bug."""

from __future__ import annotations

import difflib
import errno
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

_MAX_SHOWN = 100
INTERNAL_ERROR, BAD_INPUT, FAILED = 1, 2, 4
"""Exit statuses; the first is of what nobody should ever see."""
INTERRUPTED = 130
"""As shells have it."""
# A library that finds no room as it is loaded or begins a thread says it in these words.
_WANT_OF_MEMORY = ("failed to map segment", "cannot allocate memory", "can't start new thread")
_UNUSABLE_PATH = (errno.EACCES, errno.EPERM, errno.EROFS, errno.ENOENT, errno.ENOTDIR, errno.EISDIR, errno.ENAMETOOLONG)


def one_line(text: str) -> str:
    """``text`` without line breaks and whatever else a terminal would not print but obey."""
    return "".join(c if c.isprintable() else " " if c.isspace() else "?" for c in text)


def printable(text: str) -> str:
    """``text`` fit for one line of a message."""
    return one_line(text if len(text) <= _MAX_SHOWN else text[:_MAX_SHOWN] + "...")


def shown(value: object) -> str:
    """A value of an option as a message names it."""
    if isinstance(value, (str, Path)):
        return printable(f"'{value}'")
    try:
        return "a table" if isinstance(value, Mapping) else printable(str(value))
    except ValueError:  # a whole number of thousands of digits
        return "a number beyond all bounds"


def nearest_known(name: str, known: Iterable[str]) -> str:
    """The one of ``known`` most like ``name``, whatever the case."""
    by_lower = {item.lower(): item for item in known}
    return by_lower[difflib.get_close_matches(name.lower(), by_lower, 1, 0.0)[0]]


class RangesfmError(Exception):
    """Root of all errors raised on purpose. Its text is one line for the user, whatever names the files hold.

    ``advice`` are further lines, for who sits at the terminal.
    """

    exit_status = 4
    advice: tuple[str, ...] = ()

    def __init__(self, message: str):
        super().__init__(one_line(message))


class InputError(RangesfmError):
    """Bad usage or bad input: names the file, the line and what was expected."""

    exit_status = 2

    def __init__(
        self,
        message: str,
        path: str | Path | None = None,
        line: int | None = None,
        *,
        advice: Iterable[str] = (),
    ):
        self.path = None if path is None else Path(path)
        self.advice = tuple(map(one_line, advice))
        self.line = line
        where = "" if path is None else f"{path}: " if line is None else f"{path}:{line}: "
        super().__init__(where + message)


class OptionError(InputError):
    """An option that is passed through to another library, which does not take it: a key of a table."""

    def __init__(self, message: str, table: str, key: str | None = None):
        self.table = table
        self.key = key
        super().__init__(message)


class GeometryError(RangesfmError):
    """The geometry does not determine what was asked; the text says what and why."""

    exit_status = 3


class ReconstructionError(RangesfmError):
    """The photos did not give a model."""


class SolverError(RangesfmError):
    """A solver failed, or the compiled part does not fit the installed packages."""


@dataclass(frozen=True)
class Failure:
    """One line for the user, the exit status, and lines of advice."""

    message: str
    exit_status: int
    advice: tuple[str, ...] = ()


def failure_of(error: BaseException) -> Failure:
    """What to tell about any error at all; one that is not of our own classes may be a bug, and is called so."""
    message, status = _told(error)
    advice = error.advice if isinstance(error, RangesfmError) else ()
    return Failure(" ".join(one_line(message).split()), status, advice)


def _told(error: BaseException) -> tuple[str, int]:
    if isinstance(error, RangesfmError):
        return str(error), error.exit_status
    if any(isinstance(cause, KeyboardInterrupt) for cause in _with_causes(error)):
        return "interrupted; stages that were done are kept", INTERRUPTED
    if any(map(_is_want_of_memory, _with_causes(error))):
        return "out of memory", FAILED
    if isinstance(error, OSError):
        where = f"{error.filename}: " if error.filename is not None else ""
        return f"{where}{error.strerror or error}", BAD_INPUT if error.errno in _UNUSABLE_PATH else FAILED
    what = f"{type(error).__name__}: {error}"
    return f"internal error, please report it (RANGESFM_DEBUG=1 shows where): {what}", INTERNAL_ERROR


def _with_causes(error: BaseException | None) -> Iterator[BaseException]:
    """It and what it came from: a library that is being loaded makes an error of its own of whatever happens."""
    while error is not None:
        yield error
        error = error.__cause__ or error.__context__


def _is_want_of_memory(error: BaseException) -> bool:
    return isinstance(error, MemoryError) or any(words in str(error).lower() for words in _WANT_OF_MEMORY)

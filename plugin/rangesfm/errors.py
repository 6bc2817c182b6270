"""Errors that a user can meet, and the message and exit status of each. Any other error that escapes is a bug."""

from __future__ import annotations

import difflib
import errno
import math
import os
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

_MAX_SHOWN = 100
INTERNAL_ERROR, BAD_INPUT, FAILED = 1, 2, 4
"""Exit statuses. INTERNAL_ERROR means a bug in this package."""
INTERRUPTED = 130
"""Exit status after Ctrl-C, the one that shells use."""
# Words of libraries that found no memory when they were loaded or when they started a thread.
_WANT_OF_MEMORY = ("failed to map segment", "cannot allocate memory", "can't start new thread")
_UNUSABLE_PATH = (
    *(errno.EACCES, errno.EPERM, errno.EROFS, errno.ENOENT, errno.EEXIST),
    *(errno.ENOTDIR, errno.EISDIR, errno.ENAMETOOLONG, errno.ELOOP),
)


def one_line(text: str) -> str:
    """Replace line breaks and control characters in a text, so that a terminal prints it on one line."""
    return "".join(c if c.isprintable() else " " if c.isspace() else "?" for c in text)


def printable(text: str) -> str:
    """Shorten a text to 100 characters and make it one printable line, for use inside a message."""
    return one_line(text if len(text) <= _MAX_SHOWN else text[:_MAX_SHOWN] + "...")


def shown(value: object) -> str:
    """Return the value of an option as messages show it: text in quotes, a table as "a table"."""
    if isinstance(value, (str, Path)):
        return printable(f"'{value}'")
    try:
        return "a table" if isinstance(value, Mapping) else printable(str(value))
    except ValueError:  # Python refuses to convert a whole number of thousands of digits
        return "a number beyond all bounds"


def number_text(value: float, spec: str) -> str:
    """Return a number by a format specification, as ``format`` does; one that is rounded to zero has no sign.

    All numbers that may be negative are shown by this function, so that nobody reads "-0.000 %".
    """
    text = format(value, spec)
    return text if any(digit in text for digit in "123456789") or not math.isfinite(value) else text.strip("+-")


def nearest_known(name: str, known: Iterable[str]) -> str:
    """Return the item of ``known`` that is most similar to ``name``, ignoring case."""
    by_lower = {item.lower(): item for item in known}
    return by_lower[difflib.get_close_matches(name.lower(), by_lower, 1, 0.0)[0]]


class RangesfmError(Exception):
    """Base class of all errors raised on purpose. The text is always one line, for the user.

    Attributes:
        exit_status: of the command that ends with this error.
        advice: further lines, which the command line prints below the error.
    """

    exit_status = 4
    advice: tuple[str, ...] = ()

    def __init__(self, message: str):
        super().__init__(one_line(message))


class InputError(RangesfmError):
    """Bad usage or bad input. The text names the file, the line and what was expected."""

    exit_status = 2

    def __init__(
        self,
        message: str,
        path: str | os.PathLike[str] | None = None,
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
    """A bad key or value of a table of options; the reader of the survey file adds the file and the line.

    Attributes:
        table: of the survey file, without brackets.
        key: in that table; empty where the whole table is meant.
    """

    def __init__(self, message: str, table: str, key: str = ""):
        self.table = table
        self.key = key
        super().__init__(message)


class GeometryError(RangesfmError):
    """The geometry does not determine what was asked. The text says what, and why."""

    exit_status = 3


class ReconstructionError(RangesfmError):
    """COLMAP made no model of the photos."""


class SolverError(RangesfmError):
    """A solver failed, or the compiled part does not fit the installed packages."""


@dataclass(frozen=True)
class Failure:
    """End of a failed command: one line for the user, the exit status, and further lines of advice."""

    message: str
    exit_status: int
    advice: tuple[str, ...] = ()


def failure_of(error: BaseException) -> Failure:
    """Return message, exit status and advice for any error. An unexpected error is called an internal error."""
    message, status = _told(error)
    advice = error.advice if isinstance(error, RangesfmError) else ()
    return Failure(" ".join(one_line(message).split()), status, advice)


def _told(error: BaseException) -> tuple[str, int]:
    if isinstance(error, RangesfmError):
        return str(error), error.exit_status
    if any(isinstance(cause, KeyboardInterrupt) for cause in _with_causes(error)):
        return "interrupted; stages that were done are kept", INTERRUPTED
    for cause in _with_causes(error):
        if isinstance(cause, MemoryError) or any(words in str(cause).lower() for words in _WANT_OF_MEMORY):
            return "out of memory", FAILED
    if isinstance(error, OSError):
        where = f"{error.filename}: " if error.filename is not None else ""
        return f"{where}{error.strerror or error}", BAD_INPUT if error.errno in _UNUSABLE_PATH else FAILED
    what = f"{type(error).__name__}: {error}"
    return f"internal error, please report it (RANGESFM_DEBUG=1 shows where): {what}", INTERNAL_ERROR


def _with_causes(error: BaseException | None) -> Iterator[BaseException]:
    """Yield an error and its causes: a library that fails while it is loaded wraps the cause in its own error."""
    while error is not None:
        yield error
        error = error.__cause__ or error.__context__

"""How a run that failed ends, whatever it failed of: one line for the user, and the exit status."""

from __future__ import annotations

import errno
from dataclasses import dataclass

from rangesfm.errors import RangesfmError, one_line

INTERNAL_ERROR = 1
"""Exit status of what nobody should ever see."""

_BAD_INPUT, _FAILED = 2, 4
_INTERRUPTED = 130  # as shells have it
_UNUSABLE_PATH = (errno.EACCES, errno.EPERM, errno.EROFS, errno.ENOENT, errno.ENOTDIR, errno.EISDIR, errno.ENAMETOOLONG)


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
    if isinstance(error, KeyboardInterrupt):
        return "interrupted; stages that were done are kept", _INTERRUPTED
    if isinstance(error, OSError):
        where = f"{error.filename}: " if error.filename is not None else ""
        return f"{where}{error.strerror or error}", _BAD_INPUT if error.errno in _UNUSABLE_PATH else _FAILED
    if isinstance(error, MemoryError):
        return "out of memory", _FAILED
    what = f"{type(error).__name__}: {error}"
    return f"internal error, please report it (RANGESFM_DEBUG=1 shows where): {what}", INTERNAL_ERROR

"""Contents of regular files, and their hashes, which tell whether a content has changed."""

from __future__ import annotations

import errno
import hashlib
import os
import stat
from pathlib import Path
from typing import Any, BinaryIO

CHUNK_BYTES = 1 << 20

AnyPath = str | os.PathLike[str]
"""A path as a caller of the library may give it; ``Path(path)`` makes it one of this package's own."""


def open_regular(path: AnyPath) -> BinaryIO:
    """Open a file to be read, if it is a regular one. A device or a pipe may never end, or never begin.

    Raises:
        OSError: it is something else, or cannot be opened.
    """
    mode = os.stat(path).st_mode
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    if not stat.S_ISREG(mode):
        raise OSError(errno.EINVAL, "is not a regular file", str(path))
    return open(path, "rb")


def sha256_of(path: Path) -> str:
    """Return the SHA-256 of a file's content, in hexadecimal."""
    digest = hashlib.sha256()
    with open_regular(path) as file:
        while chunk := file.read(CHUNK_BYTES):
            digest.update(chunk)
    return digest.hexdigest()


def state_and_sha256(path: Path, known: Any = None) -> tuple[tuple[int, int, int], str]:
    """Return a file's state (size and two times of change), and its SHA-256.

    Args:
        known: the result of an earlier call, which may have been stored as JSON. The file is not read again while its
            state is the same.
    """
    found = path.stat()
    # The second time is set by the file system itself, so that it also changes when a program sets the first one back.
    state = (found.st_size, found.st_mtime_ns, found.st_ctime_ns)
    if isinstance(known, (list, tuple)) and len(known) == 2 and known[0] in (state, [*state]):
        return state, str(known[1])
    return state, sha256_of(path)

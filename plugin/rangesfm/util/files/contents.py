"""Contents of regular files, and their hashes, which tell whether a content has changed."""

from __future__ import annotations

import errno
import hashlib
import os
import re
import stat
from pathlib import Path
from typing import Any, BinaryIO

CHUNK_BYTES = 1 << 20

_SQLITE_MAGIC = b"SQLite format 3\x00"
# Byte ranges of counters in SQLite's header. They change whenever the file is opened for writing, which COLMAP does
# even to look at a database. Source: https://www.sqlite.org/fileformat2.html, sections 1.3.7 and 1.3.18.
_SQLITE_COUNTERS = ((24, 28), (92, 96))

_LFS_POINTER = b"version https://git-lfs.github.com/"
_HEIC = re.compile(rb".{4}ftyp(?:heic|heix|hevc|mif1|msf1)", re.DOTALL)
_HTML = re.compile(rb"(?:\xef\xbb\xbf)?\s{0,99}<(?:!doctype html|html)\b", re.IGNORECASE)

State = tuple[int, int, int]
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


def stand_in(path: AnyPath, head: bytes) -> str:
    """Return what a file with this beginning is, if it is stored in place of the wanted one; "" if it is none."""
    if head.startswith(_LFS_POINTER):
        return "is a pointer of Git LFS in place of the file itself: fetch that (git lfs pull)"
    if _HTML.match(head) and not str(path).lower().endswith((".html", ".htm")):
        return "is an HTML page in place of the file itself: download that again"
    if _HEIC.match(head):
        return "is a HEIC photo, whatever its name says: convert it to JPEG"
    return ""


def sha256_of(path: Path, *, but_counters: bool = False) -> str:
    """Return the SHA-256 of a file's content, in hexadecimal; ``but_counters``: as if an SQLite header's were zero."""
    digest = hashlib.sha256()
    with open_regular(path) as file:
        head = bytearray(file.read(CHUNK_BYTES))
        if but_counters and head.startswith(_SQLITE_MAGIC):
            for first, end in _SQLITE_COUNTERS:
                head[first:end] = bytes(end - first)
        digest.update(head)
        while chunk := file.read(CHUNK_BYTES):
            digest.update(chunk)
    return digest.hexdigest()


def state_of(found: os.stat_result) -> State:
    # The second time is set by the file system itself, so that it also changes when a program sets the first one back.
    return found.st_size, found.st_mtime_ns, found.st_ctime_ns


def state_and_sha256(path: Path, known: Any = None) -> tuple[State, str]:
    """Return a file's state (size and two times of change), and its SHA-256.

    Args:
        known: the result of an earlier call, which may have been stored as JSON. The file is not read again while its
            state is the same.
    """
    state = state_of(path.stat())
    if isinstance(known, (list, tuple)) and len(known) == 2 and known[0] in (state, [*state]):
        return state, str(known[1])
    return state, sha256_of(path)

"""Outputs appear whole or not at all; files are known by their content."""

from __future__ import annotations

import hashlib
import os
import shutil
import tempfile
import unicodedata
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from rangesfm.errors import InputError

LEFTOVER = r"\..+\.(?P<pid>\d+)\.(part(\..+)?|old)"
"""Names of what the functions here have in the making, with the number of the process that made it."""


_CHUNK_BYTES = 1 << 20
_NOT_IN_NAMES = ("Cc", "Cs", "Zl", "Zp")  # control characters, bytes that are no text, ends of lines and paragraphs


def sha256_of(path: Path) -> str:
    """SHA-256 of a file's content, in hexadecimal."""
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while chunk := file.read(_CHUNK_BYTES):
            digest.update(chunk)
    return digest.hexdigest()


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
    try:
        yield temporary
        os.replace(temporary, path)
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

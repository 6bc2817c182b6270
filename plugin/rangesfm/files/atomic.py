"""Outputs appear whole or not at all, and never in the place of what somebody else made."""

from __future__ import annotations

import errno
import os
import unicodedata
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from rangesfm.errors import InputError
from rangesfm.files.output_folder import absolute, is_private, make_output_folder, remove, sole_writer, writer_of

__all__ = [
    "is_plain_name",
    "make_output_folder",
    "new_file",
    "new_folder",
    "path_of",
    "require_apart",
    "scratch_folder",
    "sole_writer",
    "stays_inside",
    "write_text",
]

_NOT_IN_NAMES = ("Cc", "Cs", "Zl", "Zp")  # control characters, bytes that are no text, ends of lines and paragraphs


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


def require_apart(inputs: Iterable[Path], output: Path) -> None:
    """Raise InputError if ``output`` is one of the files or folders that are read, or lies inside one."""
    target = output.resolve()
    for path in inputs:
        if path.resolve() in (target, *target.parents):
            raise InputError("the result would overwrite this input, expected another output path", path)


@contextmanager
def new_file(path: Path) -> Iterator[Path]:
    """Yield a temporary file to write to; on success it takes the place of ``path``.

    Raises:
        InputError: there is a file or folder that this tool did not write; it stays as it is.
    """
    if is_private(path):
        with _temporary(path.with_name(f".{path.stem}.part{path.suffix}")) as temporary:
            yield temporary
            os.replace(temporary, path)
        return
    if not path.parent.is_dir():
        raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), str(path))
    with writer_of(path) as output:
        target = absolute(path)
        output.require_own([target])
        if target.is_dir():
            raise InputError("is a folder, expected a file", path)
        our_names: set[str | None] = {None}  # of which an error says nothing to the user
        try:
            # With the same ending, by which libraries tell the format.
            part = output.part(path.name)
            our_names.add(str(part))
            with _temporary(part) as temporary:
                yield temporary
                output.publish({target: temporary})
        except OSError as error:  # of a full disk, which may say nothing of the file
            error.filename = str(path) if error.filename in our_names else error.filename
            raise


def write_text(text: str, path: Path) -> None:
    """Write a file of UTF-8, whole or not at all; of a path that is none, the bytes become escapes."""
    with new_file(path) as temporary:
        temporary.write_text(text, encoding="utf-8", errors="backslashreplace")


@contextmanager
def scratch_folder(path: Path) -> Iterator[Path]:
    """Yield a temporary folder, named after ``path`` and on the same file system, that is gone afterwards."""
    if is_private(path):
        with _temporary(path.with_name(f".{path.name}.part")) as folder:
            folder.mkdir(parents=True)
            yield folder
        return
    with writer_of(path) as output, _temporary(output.part(path.name)) as folder:
        folder.mkdir(parents=True)
        yield folder


@contextmanager
def new_folder(path: Path) -> Iterator[Path]:
    """Yield a temporary folder to write to; on success it takes the place of the folder ``path``.

    Raises:
        InputError: there is something in the earlier folder that this tool did not write; all of it stays as it is.
    """
    if is_private(path):
        with scratch_folder(path) as folder:
            yield folder
            remove(path)
            os.replace(folder, path)
        return
    with writer_of(path) as output:
        output.require_own([absolute(path)])
        with scratch_folder(path) as folder:
            yield folder
            output.publish({absolute(path): folder})


@contextmanager
def _temporary(path: Path) -> Iterator[Path]:
    """Have nothing at a path before the block and after it, whatever interrupts it and when."""
    try:
        try:
            remove(path)  # left by a process that was killed
            yield path
        finally:
            remove(path)
    finally:  # again: a Ctrl-C may have ended the first
        remove(path)

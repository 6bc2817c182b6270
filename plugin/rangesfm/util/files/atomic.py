"""Outputs that appear complete or not at all, and never replace files that this tool did not write."""

from __future__ import annotations

import errno
import os
import unicodedata
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path

from rangesfm.errors import InputError
from rangesfm.util.files.folders import real_path
from rangesfm.util.files.output_folder import absolute, is_private, remove, writer_of

# Unicode categories: control characters, bytes that are not text, line separators and paragraph separators.
_NOT_IN_NAMES = ("Cc", "Cs", "Zl", "Zp")


def path_of(text: str) -> Path:
    """Return the path that text from a file names; where the locale cannot encode the text, UTF-8 is used."""
    try:
        os.fsencode(text)
    except UnicodeEncodeError:
        text = os.fsdecode(text.encode("utf-8", errors="surrogateescape"))
    return Path(text)


def is_plain_name(name: str) -> bool:
    """Return whether a photo's name can be written into tables and files: UTF-8 text on one line, not empty."""
    return bool(name) and not any(unicodedata.category(character) in _NOT_IN_NAMES for character in name)


def require_apart(inputs: Iterable[Path], output: Path) -> None:
    """Check that the output path is neither one of the inputs nor inside one.

    Raises:
        InputError: it is.
    """
    target = real_path(output)
    for path in inputs:
        if real_path(path) in (target, *target.parents):
            raise InputError("the result would overwrite this input, expected another output path", path)


@contextmanager
def new_file(path: Path) -> Iterator[Path]:
    """Yield a temporary file to write to; on success it takes the place of ``path``.

    Raises:
        InputError: at ``path`` is a folder, or a file that this tool did not write; it stays as it is.
    """
    if not path.parent.is_dir():
        raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), str(path))
    if path.is_dir():
        raise InputError("is a folder, expected a file", path)
    meaningless: list[str | None] = [None]  # file names in errors; the error of a full disk may have none
    try:
        with _replacing(path) as temporary:
            meaningless.append(str(temporary))
            yield temporary
    except OSError as error:
        error.filename = str(path) if error.filename in meaningless else error.filename
        raise


def write_text(text: str, path: Path) -> None:
    """Write a UTF-8 file, complete or not at all; bytes of paths that are not UTF-8 become escapes."""
    with new_file(path) as temporary:
        temporary.write_text(text, encoding="utf-8", errors="backslashreplace")


@contextmanager
def new_folder(path: Path) -> Iterator[Path]:
    """Yield a temporary folder to write to; on success it takes the place of the folder ``path``.

    Raises:
        InputError: the earlier folder holds something that this tool did not write; all of it stays as it is.
    """
    with _replacing(path) as folder:
        folder.mkdir(parents=True)
        yield folder


@contextmanager
def scratch_folder(path: Path) -> Iterator[Path]:
    """Yield a temporary folder, named after ``path`` and on the same file system, and remove it afterwards."""
    with _temporary(path) as folder:
        folder.mkdir(parents=True)
        yield folder


@contextmanager
def _replacing(path: Path) -> Iterator[Path]:
    """Yield a place for what is to replace ``path``; in a private folder, everything may be replaced."""
    if is_private(path):
        with _temporary(path) as temporary:
            yield temporary
            if temporary.is_dir():
                remove(path)
            os.replace(temporary, path)
        return
    with writer_of(path) as output:
        target = absolute(path)
        output.require_own([target])
        with _temporary(path) as temporary:
            yield temporary
            output.publish({target: temporary})


@contextmanager
def _temporary(path: Path) -> Iterator[Path]:
    """Yield a place on the same file system as ``path``, and remove whatever is there afterwards.

    The name ends as that of ``path``, because libraries tell the format of a file by it.
    """
    with nullcontext() if is_private(path) else writer_of(path) as output:
        place = output.part(path.name) if output else path.with_name(f".{path.stem}.part{path.suffix}")
        try:
            try:
                remove(place)  # a process that was killed may have left something
                yield place
            finally:
                remove(place)
        finally:  # once more, because a Ctrl-C may have interrupted the first removal
            remove(place)

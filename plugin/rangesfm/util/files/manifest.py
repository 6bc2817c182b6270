"""Record of the files that this tool wrote into a folder, which tells them from all other files."""

from __future__ import annotations

import json
import os
import stat
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

from rangesfm.errors import InputError
from rangesfm.util.files.contents import State, open_regular, sha256_of, state_of
from rangesfm.util.files.folders import stays_inside

_NAME = "manifest.json"
_VERSION = 1


class Manifest:
    """The files of one folder that this tool wrote, with the content that it gave them.

    A file counts as this tool's own as long as it is a regular file with that content. A file that somebody has changed
    no longer does.

    Attributes:
        moves: renames that were begun and not finished: source in the private folder, target in the folder.
    """

    def __init__(self, folder: Path, private: Path):
        """Read the record of ``folder`` from its private folder; empty if there is none.

        Raises:
            InputError: the file in its place is not such a record.
        """
        self._folder = folder
        self._path = private / _NAME
        self.moves: list[tuple[str, str]] = []
        self._hashes: dict[str, list[str]] = {}
        self._states: dict[str, State] = {}
        if os.path.lexists(self._path):
            self._read()

    def foreign_file(self, path: Path) -> Path | None:
        """Return a file at ``path`` or inside it that is not this tool's own, or None if there is none."""
        for file in _files_in(path):
            if not self._is_own(file):
                return file
        return None

    def expect(self, new: Mapping[Path, Path]) -> None:
        """Count what is to go to each place as this tool's own there, in addition to what is own there already.

        The record must be saved before the moves.

        Args:
            new: the present path of the file or folder for each place.
        """
        for target, source in new.items():
            for file in _files_in(source):
                name = self._name_of(target / file.relative_to(source))
                self._hashes.setdefault(name, []).append(content_hash(file))

    def settle(self, targets: Iterable[Path]) -> None:
        """Count at these targets only what was expected last as this tool's own, and no longer any earlier content."""
        for target in map(self._name_of, targets):
            for name in [name for name in self._hashes if name == target or name.startswith(f"{target}/")]:
                if (file := self._folder / name).is_file():
                    self._hashes[name] = self._hashes[name][-1:]
                    self._states[name] = state_of(file.lstat())
                else:
                    del self._hashes[name]
                    self._states.pop(name, None)

    def save(self) -> None:
        """Write the record, complete or not at all; without anything to record there is none."""
        if not self._hashes and not self.moves:
            self._path.unlink(missing_ok=True)
            return
        files = {
            name: {"sha256": hashes, "state": self._states.get(name)} for name, hashes in sorted(self._hashes.items())
        }
        record = {"version": _VERSION, "moves": self.moves, "files": files}
        temporary = self._path.with_name(f"{_NAME}.{os.getpid()}")
        try:
            temporary.write_text(json.dumps(record, indent=1), encoding="utf-8", errors="surrogateescape")
            os.replace(temporary, self._path)
        finally:
            temporary.unlink(missing_ok=True)

    def _read(self) -> None:
        try:
            with open_regular(self._path) as file:
                record = json.loads(file.read().decode("utf-8", errors="surrogateescape"))
            if record["version"] != _VERSION:
                raise ValueError(f"version {record['version']}")
            self.moves = [(_text(source) and _name(source), _name(target)) for source, target in record["moves"]]
            for name, entry in record["files"].items():
                self._hashes[_text(name)] = [_text(sha256) for sha256 in entry["sha256"]]
                if entry["state"] is not None:
                    size, modified, changed = map(int, entry["state"])
                    self._states[name] = size, modified, changed
        except (OSError, ValueError, TypeError, AttributeError, LookupError, OverflowError, RecursionError) as error:
            raise InputError(
                "is not a record of written files by this version of rangesfm: move it away, or give another output"
                " path",
                self._path,
            ) from error

    def _is_own(self, path: Path) -> bool:
        name, found = self._name_of(path), path.lstat()
        if name not in self._hashes or not stat.S_ISREG(found.st_mode):
            return False
        state = state_of(found)
        if self._states.get(name) == state:
            return True
        if content_hash(path) not in self._hashes[name]:
            return False
        self._states[name] = state
        return True

    def _name_of(self, path: Path) -> str:
        return path.relative_to(self._folder).as_posix()


def content_hash(path: Path) -> str:
    """Return the SHA-256 of a file, in hexadecimal; the counters in the header of an SQLite database are ignored."""
    return sha256_of(path, but_counters=True)


def _files_in(path: Path) -> Iterator[Path]:
    """Yield the path if it is a file or a link, or all files and links inside it if it is a folder."""
    if not os.path.lexists(path):
        return
    if path.is_symlink() or not path.is_dir():
        yield path
        return
    for parent, folders, names in os.walk(path):
        yield from (Path(parent, name) for name in sorted(names))
        yield from (Path(parent, name) for name in sorted(folders) if Path(parent, name).is_symlink())


def _text(value: object) -> str:
    if not isinstance(value, str):
        raise TypeError(f"{value!r} is no text")
    return value


def _name(value: object) -> str:
    if not stays_inside(_text(value)):
        raise ValueError(f"{value!r} is no path inside the folder")
    return str(value)

"""Where a result says that its inputs are, and where they are looked for when it is read again.

A result is handed on, with its report: paths in it say no more of the machine that made it than is needed. And it may
come from a stranger: it does not say where this machine's photos are looked for.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from rangesfm.files.atomic import path_of
from rangesfm.survey.settings import KEYS, Survey


def recorded_path(path: Path, folder: Path) -> str:
    """Return a path as a result in ``folder`` records it.

    That is relative to the folder, with slashes, as long as both are in some folder below the file system's root; else
    the whole path.
    """
    here, there = os.path.abspath(folder), os.path.abspath(path)
    try:
        common = os.path.commonpath([here, there])
    except ValueError:  # on two drives of Windows
        return there
    return there if common == os.path.dirname(common) else Path(os.path.relpath(there, here)).as_posix()


def path_in(folder: Path, recorded: str) -> Path:
    """Return the path that a result in ``folder`` records; earlier versions recorded whole paths."""
    return Path(os.path.abspath(folder / path_of(recorded)))


def recorded_settings(survey: Survey) -> dict[str, Any]:
    """Return a survey's tables and keys as its result records them."""
    tables = survey.to_dict()
    for key in KEYS:
        if key.role is not None and tables[key.table][key.name] is not None:
            tables[key.table][key.name] = recorded_path(path_of(tables[key.table][key.name]), survey.output.path)
    return tables


def recorded_inputs(entries: list[dict[str, Any]], survey: Survey) -> list[dict[str, Any]]:
    """Return the entries of ``input_hashes`` as a survey's result records them."""
    return [{**entry, "path": recorded_path(path_of(entry["path"]), survey.output.path)} for entry in entries]


def photos_beside(folder: Path, recorded: str) -> Path | None:
    """Return the folder of photos that a result records, if it is in the result's folder or in the one around that.

    Elsewhere it is None: a stranger's result could name a folder of the reader's, whose photos would be in the page
    that the reader hands on. Nor does the home folder, or the root of the file system, count as a survey's own.
    """
    path, around = path_in(folder, recorded), folder.resolve().parent
    own = folder if around in (Path(around.anchor), _home()) else around
    return path if is_within(path, own) else None


def is_within(path: Path, folder: Path) -> bool:
    """Whether a path leads into a folder, whatever links there are on the way."""
    try:
        end = path.resolve()
        # Before Python 3.13 links in a circle are an error; from then on what is left of them is still a link.
        return not end.is_symlink() and end.is_relative_to(folder.resolve())
    except (OSError, RuntimeError, ValueError):  # or no name that a file can have
        return False


def _home() -> Path | None:
    try:
        return Path.home().resolve()
    except RuntimeError:  # this user has none
        return None

"""Paths of the inputs, as a result records them and as they are found when it is read again.

Results are given to others. So the recorded paths say no more than needed about the machine that made a result, and a
result of a stranger must not decide which photos of the reader's machine go into a page.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from rangesfm.errors import InputError
from rangesfm.survey.settings import KEYS, Survey
from rangesfm.util.files.atomic import path_of
from rangesfm.util.files.folders import real_path


def recorded_path(path: Path, folder: Path) -> str:
    """Return a path as a result in ``folder`` records it.

    It is relative to the folder, with slashes, if both are in a common folder below the root of the file system;
    otherwise it is the absolute path.
    """
    here, there = os.path.abspath(folder), os.path.abspath(path)
    try:
        common = os.path.commonpath([here, there])
    except ValueError:  # they are on different drives of Windows
        return there
    return there if common == os.path.dirname(common) else Path(os.path.relpath(there, here)).as_posix()


def path_in(folder: Path, recorded: str) -> Path:
    """Return the absolute path for a recorded path of a result in ``folder``; old results recorded absolute paths."""
    return Path(os.path.abspath(folder / path_of(recorded)))


def recorded_settings(survey: Survey) -> dict[str, Any]:
    """Return the tables and keys of a survey, with paths as its result records them."""
    tables = survey.to_dict()
    for key in KEYS:
        if key.role is not None and tables[key.table][key.name] is not None:
            tables[key.table][key.name] = recorded_path(path_of(tables[key.table][key.name]), survey.output.path)
    return tables


def input_beside(folder: Path, recorded: str) -> Path | None:
    """Return the recorded path of an input if it is in the result folder or in the folder around it, else None.

    A result of a stranger could name any folder of the reader, whose photos would then be in a page that the reader
    gives to others. For the same reason, the folder around the result does not count if it is the home folder or the
    root of the file system.
    """
    path, around = path_in(folder, recorded), real_path(folder).parent
    own = folder if around == Path(around.anchor) or _is_home(around) else around
    return path if is_within(path, own) else None


def is_within(path: Path, folder: Path) -> bool:
    """Return whether a path leads into a folder after all links are followed."""
    try:
        end = real_path(path)
    except InputError:
        return False
    return not end.is_symlink() and end.is_relative_to(real_path(folder))  # links in a circle remain a link


def _is_home(path: Path) -> bool:
    try:
        return path == real_path(Path.home())
    except RuntimeError:  # this user has no home folder
        return False

"""Paths without their links, and all folders inside folders: photos of one survey may lie on several disks."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from pathlib import Path

from rangesfm.errors import InputError

LEFT_BY_RUNS = frozenset({"result.json", "reconstruct.json", "photos.json"})
"""Names of files that mark a folder as the result of an earlier run."""
IMAGE_EXTENSIONS = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp")
"""Endings of the names of photos, in small letters."""
OTHER_PHOTOS = (".heic", ".heif", ".dng", ".cr2", ".nef", ".arw")
"""Endings of the names of photos that are not read."""


def natural_order(name: str) -> tuple[list[str], str]:
    """Return a key by which names are sorted as people number them: frame_2 before frame_10."""
    return [part.zfill(20) for part in re.split(r"(\d+)", name)], name


def real_path(path: Path) -> Path:
    """Return the absolute path after all links are followed, whether or not it exists; links in a circle remain.

    Raises:
        InputError: no file can have such a name.
    """
    try:
        return Path(os.path.realpath(path))
    except ValueError:
        raise InputError("no file can have such a name", path) from None


def stays_inside(name: str) -> bool:
    """Return whether a name from a file, taken relative to a folder, is the name of a file inside that folder."""
    path = Path(name)
    try:
        os.fsencode(name)
    except UnicodeEncodeError:
        return False
    return bool(path.parts) and "\0" not in name and not path.is_absolute() and ".." not in path.parts


def walk(*folders: Path) -> Iterator[tuple[Path, list[str], list[str]]]:
    """Yield each folder once, with the sorted names of its subfolders and of its files.

    The caller may remove subfolders from their list to skip them. Hidden files and folders are left out, and so are
    result folders of earlier runs, unless they are among ``folders``.
    """
    seen: set[str] = set()
    for folder in folders:
        for parent, subfolders, names in os.walk(folder, followlinks=True):
            real = os.path.realpath(parent)
            if real in seen:
                subfolders.clear()
                continue
            seen.add(real)
            if Path(parent) != folder and not LEFT_BY_RUNS.isdisjoint(names):
                subfolders.clear()
                continue
            subfolders[:] = sorted(name for name in subfolders if not name.startswith("."))
            yield Path(parent), subfolders, sorted(name for name in names if not name.startswith("."))

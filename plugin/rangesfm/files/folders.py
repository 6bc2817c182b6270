"""Listing of all folders inside folders, following links, because photos of one survey may lie on several disks."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

LEFT_BY_RUNS = frozenset({"result.json", "reconstruct.json", "photos.json"})
"""Names of files that mark a folder as the result of an earlier run."""


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

"""All folders inside folders, behind links too: photos of one survey may lie on several disks."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

LEFT_BY_RUNS = frozenset({"result.json", "reconstruct.json", "photos.json"})
"""Names of files by which such folders are known."""


def walk(*folders: Path) -> Iterator[tuple[Path, list[str], list[str]]]:
    """Each folder once, with the names of its folders (the caller may take out some) and of its files, sorted.

    What is hidden is left out, and so are folders that earlier runs left, but for ``folders`` themselves.
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

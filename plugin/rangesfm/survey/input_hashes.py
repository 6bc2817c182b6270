"""Hashes of the inputs of a survey, by which they can be recognised later."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

from rangesfm.survey.settings import Survey
from rangesfm.survey.survey_reader import input_paths
from rangesfm.util.files.contents import sha256_of
from rangesfm.util.files.folders import walk


def input_hashes(survey: Survey) -> list[dict[str, Any]]:
    """Return path, SHA-256, number of bytes and what was hashed, for each input that exists.

    For a folder of photos, only names and sizes are hashed: reading gigabytes again would take too long.
    """
    entries: list[dict[str, Any]] = []
    for _, role, given in input_paths(survey):
        if role == "photos":
            entries += [_folder(given)] if given.is_dir() else []
        else:
            files = sorted(given.glob("*.bin" if role == "model" else "*")) or [given]
            entries += [
                {"path": str(path), "sha256": sha256_of(path), "bytes": path.stat().st_size, "hashed": "content"}
                for path in files
                if path.is_file()
            ]
    return entries


def _folder(path: Path) -> dict[str, Any]:
    files = (parent / name for parent, _, names in walk(path) for name in names)
    sizes = {file.relative_to(path).as_posix(): file.stat().st_size for file in files if file.is_file()}
    listing = "".join(f"{name}\t{size}\n" for name, size in sorted(sizes.items()))
    return {
        "path": str(path),
        "sha256": hashlib.sha256(listing.encode("utf-8", "surrogateescape")).hexdigest(),
        "bytes": sum(sizes.values()),
        "hashed": f"names and sizes of {len(sizes)} files",
    }

"""What a result was made from: every input with its SHA-256, so that a report can be checked later."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

from rangesfm.files.atomic import sha256_of
from rangesfm.survey.settings import Survey


def input_hashes(survey: Survey) -> list[dict[str, Any]]:
    """Path, SHA-256, bytes and what was hashed, for each input that is there.

    Of a folder of photos only the names and sizes are hashed: reading gigabytes again would take
    longer than what is gained.
    """
    entries: list[dict[str, Any]] = []
    for item in survey.input_paths():
        if item.role == "photos":
            entries += [_folder(item.path)] if item.path.is_dir() else []
        else:
            files = sorted(item.path.glob("*.bin")) if item.role == "model" else [item.path]
            entries += [_file(path) for path in files if path.is_file()]
    return entries


def _file(path: Path) -> dict[str, Any]:
    return {"path": str(path), "sha256": sha256_of(path), "bytes": path.stat().st_size, "hashed": "content"}


def _folder(path: Path) -> dict[str, Any]:
    sizes = {file.relative_to(path).as_posix(): file.stat().st_size for file in path.rglob("*") if file.is_file()}
    listing = "".join(f"{name}\t{size}\n" for name, size in sorted(sizes.items()))
    return {
        "path": str(path),
        "sha256": hashlib.sha256(listing.encode("utf-8", "surrogateescape")).hexdigest(),
        "bytes": sum(sizes.values()),
        "hashed": f"names and sizes of {len(sizes)} files",
    }

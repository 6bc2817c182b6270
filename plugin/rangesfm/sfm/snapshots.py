"""Snapshots of a mapping; an interrupted mapping continues from the newest one."""

from __future__ import annotations

import json
import os
import shutil
import time
from collections.abc import Callable
from pathlib import Path

from rangesfm.colmap.model_files import read_model
from rangesfm.errors import InputError
from rangesfm.sfm.incremental_mapping import UnfinishedMapping
from rangesfm.util.files.contents import open_regular
from rangesfm.util.files.records import write_json

# Time between two snapshots: at least this, and so long that writing them takes a twentieth of the time at most.
_MIN_INTERVAL_S = 5.0
_INTERVAL_OVER_DURATION = 20.0
_SIZE_NAME = "size_at_adjustment.json"


def snapshots(path: Path, scratch: Path, min_model_size: int) -> Callable[[UnfinishedMapping], None]:
    """Return a function that takes a snapshot if one is due; it is called when COLMAP has added a photo.

    Args:
        path: folder of the newest snapshot, made with the first snapshot.
        scratch: folder on the same disk, where a snapshot is written before it is moved to ``path``.
        min_model_size: a further model with fewer photos than that may not be kept by COLMAP, and has no snapshot.
    """
    newest_ms, next_s = 0, time.monotonic() + _MIN_INTERVAL_S

    def keep(mapping: UnfinishedMapping) -> None:
        nonlocal newest_ms, next_s
        begin_s = time.monotonic()
        if begin_s < next_s or (mapping.finished and mapping.growing.num_reg_frames() < min_model_size):
            return
        # The name is the time, as COLMAP's are. Two snapshots within a millisecond must not have the same one.
        newest_ms = max(time.time_ns() // 1_000_000, newest_ms + 1)
        folder = scratch / f"{newest_ms:013d}"
        folder.mkdir()
        write_json([*mapping.size_at_adjustment], folder / _SIZE_NAME)
        for number, model in enumerate(mapping.models):
            (folder / str(number)).mkdir()
            model.write_binary(folder / str(number))
        _keep(folder, path)
        end_s = time.monotonic()
        next_s = end_s + max(_MIN_INTERVAL_S, _INTERVAL_OVER_DURATION * (end_s - begin_s))

    return keep


def newest_snapshot(path: Path) -> UnfinishedMapping | None:
    """Return the newest complete snapshot, or None if there is none."""
    for folder in sorted(path.iterdir(), reverse=True) if path.is_dir() else ():
        try:
            with open_regular(folder / _SIZE_NAME) as file:
                num_frames, num_points = map(int, json.loads(file.read()))
            numbers = sorted(int(model.name) for model in folder.iterdir() if model.name.isdecimal())
            *finished, growing = (read_model(folder / str(number)) for number in numbers)
        except (InputError, OSError, ValueError, TypeError):
            continue
        return UnfinishedMapping(tuple(finished), growing, (num_frames, num_points))
    return None


def _keep(snapshot: Path, path: Path) -> None:
    """Move a complete snapshot into the folder of snapshots, and remove the older ones."""
    path.mkdir(exist_ok=True)
    older = list(path.iterdir())
    os.replace(snapshot, path / snapshot.name)
    for folder in older:
        shutil.rmtree(folder)

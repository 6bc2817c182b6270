"""Snapshots of a mapping; an interrupted mapping continues from the newest one."""

from __future__ import annotations

import os
import shutil
import time
from pathlib import Path

import pycolmap

from rangesfm.colmap.model_files import read_model
from rangesfm.errors import InputError
from rangesfm.geometry.trajectory import pose_of


class Snapshots:
    """Keeper of the newest snapshot of a mapping's first model.

    A mapping that continues from a snapshot gives the same result as an undisturbed one. COLMAP refines the whole model
    each time it has grown by a tenth, counted from the last such refinement. A continued mapping starts counting at its
    first model, so that snapshots are taken only just after a refinement.

    Further models are begun when the first is done, and have no snapshots.

    Args:
        path: folder of the newest snapshot, made with the first snapshot.
        scratch: folder on the same disk, where a snapshot is written before it is moved to ``path``.
    """

    def __init__(self, path: Path, scratch: Path):
        self._path = path
        self._scratch = scratch
        self._poses: dict[int, bytes] = {}
        self._newest_ms = 0

    def add_photo(self, model: pycolmap.Reconstruction) -> None:
        """Take a snapshot if one is due; to be called when COLMAP has added a photo to the first model."""
        if self._is_just_refined(model):
            # Two snapshots within a millisecond must not have the same name.
            self._newest_ms = max(time.time_ns() // 1_000_000, self._newest_ms + 1)
            _keep(_write(model, self._scratch / f"{self._newest_ms:013d}"), self._path)

    def _is_just_refined(self, model: pycolmap.Reconstruction) -> bool:
        """Return whether the whole model was refined, that is, all poses have changed since the last photo."""
        poses = {id_: pose_of(model.frame(id_)).params.tobytes() for id_ in model.reg_frame_ids()}
        before, self._poses = self._poses, poses
        return bool(before) and all(poses[id_] != pose for id_, pose in before.items() if id_ in poses)


def _write(model: pycolmap.Reconstruction, folder: Path) -> Path:
    """Write a model into a new folder, named by the time in milliseconds as COLMAP does; return the folder."""
    folder.mkdir()
    model.write_binary(folder)
    return folder


def newest_snapshot(path: Path) -> Path | None:
    """Return the folder of the newest complete snapshot, or None if there is none."""
    for folder in sorted(path.iterdir(), reverse=True) if path.is_dir() else ():
        try:
            read_model(folder)
        except InputError:
            continue
        return folder
    return None


def _keep(model: Path, path: Path) -> None:
    """Move a complete model into the folder of snapshots, and remove the older ones."""
    path.mkdir(exist_ok=True)
    older = list(path.iterdir())
    os.replace(model, path / model.name)
    for folder in older:
        shutil.rmtree(folder)

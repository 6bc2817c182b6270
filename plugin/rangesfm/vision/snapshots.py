"""Snapshots of a mapping: an interrupted one goes on from the newest."""

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
    """Keeps the newest snapshot of the first model of a mapping that goes on from exactly where it is.

    COLMAP refines all of the model each time that it has grown by a tenth, and counts from there. A mapping that goes
    on from a model counts anew, so that only a model just refined gives what an undisturbed mapping does.

    Further models are begun when the first is done; there are no snapshots of them.

    Args:
        path: folder of the newest snapshot, made when there is one.
        scratch: folder beside it, where one is written.
    """

    def __init__(self, path: Path, scratch: Path):
        self._path = path
        self._scratch = scratch
        self._poses: dict[int, bytes] = {}

    def add_photo(self, model: pycolmap.Reconstruction) -> None:
        """To be called when COLMAP has added a photo to the first model."""
        if self._is_just_refined(model):
            _keep(write_snapshot(model, self._scratch), self._path)

    def _is_just_refined(self, model: pycolmap.Reconstruction) -> bool:
        """All cameras have moved since the last photo; the photos next to a new one alone move otherwise."""
        poses = {id_: pose_of(model.frame(id_)).params.tobytes() for id_ in model.reg_frame_ids()}
        before, self._poses = self._poses, poses
        return bool(before) and all(poses[id_] != pose for id_, pose in before.items() if id_ in poses)


def write_snapshot(model: pycolmap.Reconstruction, path: Path) -> Path:
    """Into a folder of its own, called by the time in milliseconds as COLMAP does."""
    folder = path / f"{time.time_ns() // 1_000_000:013d}"
    folder.mkdir()
    model.write_binary(folder)
    return folder


def newest_snapshot(path: Path) -> Path | None:
    """The model to go on from; None if there is none that is whole."""
    for folder in sorted(path.iterdir(), reverse=True) if path.is_dir() else ():
        try:
            read_model(folder)
        except InputError:
            continue
        return folder
    return None


def _keep(model: Path, path: Path) -> None:
    """Move a whole model into the folder of snapshots, in the place of older ones."""
    path.mkdir(exist_ok=True)
    older = list(path.iterdir())
    os.replace(model, path / model.name)
    for folder in older:
        shutil.rmtree(folder)

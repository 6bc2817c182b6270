"""Snapshots of a mapping: an interrupted one goes on from the newest."""

from __future__ import annotations

import os
import shutil
import struct
from pathlib import Path

import pycolmap

from rangesfm.colmap.model_files import read_model
from rangesfm.errors import InputError

# Writing a model after each photo takes a few percent of the time of mapping up to a few hundred photos, and beyond
# grows with their number.
_MAX_NUM_SNAPSHOTS = 200
# As COLMAP writes the frames of a model: id, rig and pose, then so many photos.
_FRAME = struct.Struct("<II7dI")
_PHOTO_BYTES = 16


class Snapshots:
    """Keeps the newest snapshot of the first model of a mapping that goes on from exactly where it is.

    COLMAP refines all of the model each time that it has grown by a tenth, and counts from there. A mapping that goes
    on from a model counts anew, so that only a model just refined gives what an undisturbed mapping does.

    Further models are begun when the first is done; snapshots of them are not kept.

    Args:
        path: folder of the newest snapshot, made when there is one.
        scratch: folder for COLMAP to write to; made here.
        options: of the mapping, which are told so. Snapshots that the user asked for go where the user wants them, and
            none are kept.
    """

    def __init__(self, path: Path, scratch: Path, options: pycolmap.IncrementalPipelineOptions, num_photos: int):
        self._path = path
        self._scratch = scratch
        self._num_models = 0
        self._poses: dict[int, tuple[float, ...]] | None = None
        scratch.mkdir()
        if options.snapshot_frames_freq <= 0:
            options.snapshot_path = scratch
            options.snapshot_frames_freq = max(1, num_photos // _MAX_NUM_SNAPSHOTS)

    def begin_model(self) -> None:
        """To be called when COLMAP has begun a model, or gone on with one."""
        self._num_models += 1

    def add_photo(self) -> None:
        """To be called when COLMAP has added a photo, and so is not writing a snapshot."""
        for folder in sorted(self._scratch.iterdir()):
            if self._num_models == 1 and self._is_just_refined(folder):
                _keep(folder, self._path)
            else:
                shutil.rmtree(folder)

    def _is_just_refined(self, folder: Path) -> bool:
        """All cameras have moved since the last snapshot; the photos next to a new one alone move otherwise."""
        poses = _poses(folder / "frames.bin")
        before, self._poses = self._poses, poses
        return before is not None and all(poses[id_] != pose for id_, pose in before.items() if id_ in poses)


def _poses(path: Path) -> dict[int, tuple[float, ...]]:
    """Of each frame of a model, by its id."""
    data = path.read_bytes()
    poses, at = {}, 8
    while at < len(data):
        frame_id, _, *pose, num_photos = _FRAME.unpack_from(data, at)
        poses[frame_id] = tuple(pose)
        at += _FRAME.size + num_photos * _PHOTO_BYTES
    return poses


def newest_snapshot(path: Path) -> Path | None:
    """The model to go on from; None if there is none that is whole."""
    for folder in sorted(path.iterdir(), reverse=True) if path.is_dir() else ():
        try:
            read_model(folder)
        except InputError:
            continue
        return folder
    return None


def remove_snapshots(path: Path) -> None:
    shutil.rmtree(path, ignore_errors=True)


def _keep(model: Path, path: Path) -> None:
    """Move a whole model into the folder of snapshots, in the place of older ones."""
    path.mkdir(exist_ok=True)
    older = list(path.iterdir())
    os.replace(model, path / model.name)
    for folder in older:
        shutil.rmtree(folder)

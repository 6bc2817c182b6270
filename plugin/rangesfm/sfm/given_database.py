"""A database that the user provides, from COLMAP or hloc: its features and matches of a survey's photos."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from rangesfm.colmap.colmap_log import colmap_log
from rangesfm.errors import InputError
from rangesfm.sfm.camera import PhotoCameras
from rangesfm.sfm.database import copy_database, copy_features, copying
from rangesfm.sfm.photo_files import MIN_NUM_PHOTOS, Photos
from rangesfm.util.files.atomic import scratch_folder
from rangesfm.util.files.contents import sha256_of


@dataclass(frozen=True)
class GivenDatabase:
    """A copy of the user's database; pycolmap may update the copy to its own version.

    Attributes:
        source: the user's file.
        path: the copy.
        sha256: hash of the user's file.
        photos: the photos of the survey for which the database has features.
        ids: their ids in the database, in the order of ``photos``.
        num_pairs: number of pairs of these photos with matches.
        note: message that says which parts are used, and which photos are missing on either side.
    """

    source: Path
    path: Path
    sha256: str
    photos: Photos
    ids: tuple[int, ...]
    num_pairs: int
    note: str

    @property
    def inputs(self) -> list[Any]:
        """Plain values that differ whenever the features and matches of these photos do."""
        return [self.sha256, self.photos.names]

    def cameras(self) -> PhotoCameras:
        """Return the cameras of the database.

        Raises:
            InputError: a camera has another size than one of its photos.
        """
        with pycolmap.Database.open(self.path) as database:
            of_photo = [database.read_image(id_).camera_id for id_ in self.ids]
            ids = sorted(set(of_photo))
            cameras = tuple(database.read_camera(id_) for id_ in ids)
        places = tuple(ids.index(id_) for id_ in of_photo)
        for name, size, place in zip(self.photos.names, self.photos.sizes, places, strict=True):
            if (found := (cameras[place].width, cameras[place].height)) != size:
                raise InputError(
                    f"{name} has {found[0]} x {found[1]} pixels here, expected {size[0]} x {size[1]} like its file",
                    self.source,
                )
        return PhotoCameras(cameras, places)

    def copy_to(self, path: Path) -> None:
        """Copy the photos' features and matches into a database where the photos have the ids 1, 2, ..."""
        new = {id_: new_id for new_id, id_ in enumerate(self.ids, 1)}
        with copying(self.path, path) as (source, target):
            copy_features(source, target, new)
            for first, second in _pairs(source, new):
                pair = new[first], new[second]
                target.write_matches(*pair, source.read_matches(first, second))
                if source.exists_two_view_geometry(first, second):
                    target.write_two_view_geometry(*pair, source.read_two_view_geometry(first, second))


@contextmanager
def opened(path: Path, photos: Photos, folder: Path) -> Iterator[GivenDatabase]:
    """Copy a database into ``folder`` for the duration of the block.

    Raises:
        InputError: it is not a database of COLMAP's, has features of fewer than two of the photos, or has neither
            matches nor descriptors.
    """
    with scratch_folder(folder / "given_database") as scratch:
        copy = scratch / "database.db"
        copy_database(path, copy)
        yield _read(path, copy, photos)


def _read(source: Path, path: Path, photos: Photos) -> GivenDatabase:
    try:
        with colmap_log(path.with_name("open.log")):
            database = pycolmap.Database.open(path)
    except RuntimeError:
        raise InputError("is not a database of COLMAP's", source) from None
    with database, _damage_named(source):
        of_name = {image.name: image.image_id for image in database.read_all_images()}
        ids = {
            name: of_name[name] for name in photos.names if name in of_name and database.exists_keypoints(of_name[name])
        }
        if len(ids) < MIN_NUM_PHOTOS:
            raise InputError(
                f"has features of {len(ids)} of {len(photos.names)} photos, expected at least {MIN_NUM_PHOTOS}, with"
                f" their names relative to the folder, such as {photos.names[0]}",
                source,
            )
        _require_sound(database, source, ids)
        num_pairs = len(_pairs(database, {id_: id_ for id_ in ids.values()}))
        has_rigs = any(rig.non_ref_sensors for rig in database.read_all_rigs())
        bare = next((name for name, id_ in ids.items() if not database.exists_descriptors(id_)), None)
    if not num_pairs and bare is not None:
        raise InputError(f"has neither matches nor descriptors to match {bare} by, expected one of them", source)
    note = f"features of {len(ids)} photos and matches of {num_pairs} pairs are taken from {source.name}"
    if lacking := [name for name in photos.names if name not in ids]:
        note += f"; {len(lacking)} photos are not in it and are left out, the first is {lacking[0]}"
    if others := sorted(of_name.keys() - set(photos.names)):
        note += f"; {len(others)} of its photos are not keyframes, the first is {others[0]}"
    if has_rigs:
        note += "; its rigs are ignored: rigs are taken from [images] rig_config"
    return GivenDatabase(source, path, sha256_of(source), photos.subset(ids), tuple(ids.values()), num_pairs, note)


@contextmanager
def _damage_named(source: Path) -> Iterator[None]:
    """Turn COLMAP's errors on rows that it cannot read into an InputError that names the file."""
    try:
        yield
    except (RuntimeError, ValueError, LookupError, MemoryError) as error:
        sizes = re.search(r"\((\d+) vs\. (\d+)\)", str(error))
        why = f" (sizes of {sizes[1]} and {sizes[2]} differ)" if sizes else ""
        raise InputError(f"is damaged: COLMAP cannot read a row of it{why}", source) from error


def _require_sound(database: pycolmap.Database, source: Path, ids: Mapping[str, int]) -> None:
    """Read all data of these photos that COLMAP would read, and check what COLMAP does not check.

    Args:
        ids: id of each photo by its name.

    Raises:
        InputError: a camera or feature has impossible values, or a match refers to a feature that does not exist.
    """
    num_features = {}
    for name, id_ in ids.items():
        camera = database.read_camera(database.read_image(id_).camera_id)
        if not (camera.verify_params() and np.isfinite(camera.params).all() and min(camera.width, camera.height) > 0):
            raise InputError(f"is damaged: the camera of {name} has impossible parameters", source)
        keypoints = database.read_keypoints(id_)
        if not np.isfinite(keypoints).all():
            raise InputError(f"is damaged: a feature of {name} has no finite position", source)
        num_features[id_] = len(keypoints)
        if database.exists_descriptors(id_) and len(database.read_descriptors(id_).data) != len(keypoints):
            raise InputError(f"is damaged: {name} has another number of descriptors than of features", source)
    names = {id_: name for name, id_ in ids.items()}
    for first, second in _pairs(database, num_features):
        matches = [database.read_matches(first, second)]
        if database.exists_two_view_geometry(first, second):
            matches.append(database.read_two_view_geometry(first, second).inlier_matches)
        limits = num_features[first], num_features[second]
        if any(len(pairs) and (np.max(pairs, axis=0) >= limits).any() for pairs in matches):
            raise InputError(
                f"is damaged: a match of {names[first]} and {names[second]} is of a feature that is not there", source
            )


def _pairs(database: pycolmap.Database, known: Mapping[int, Any]) -> Sequence[tuple[int, int]]:
    """Return the pairs with matches in which both photos are among ``known``, by their ids."""
    pairs = (pycolmap.pair_id_to_image_pair(pair_id) for pair_id in database.read_num_matches()[0])
    return [(first, second) for first, second in pairs if first in known and second in known]

"""Cameras of the photos: which photos share a camera, with the user's calibration or COLMAP's guess for each."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import pycolmap

from rangesfm.colmap.calibrated_cameras import calibrated_cameras
from rangesfm.errors import InputError, nearest_known
from rangesfm.options import CameraOptions
from rangesfm.sfm.photo_files import Photos, exif_tags
from rangesfm.sfm.rigs import NO_RIGS, Rigs

# EXIF tags that tell one camera from another: make, model, serial number, focal length.
_TELLING_TAGS = (0x010F, 0x0110, 0xA431, 0x920A)
_MODELS = {name: model for name, model in pycolmap.CameraModelId.__members__.items() if name != "INVALID"}


def check_camera(options: CameraOptions) -> None:
    """Check that the options describe cameras that COLMAP has.

    Raises:
        InputError: an unknown model; parameters without a model; too few, too many or impossible parameters; a pattern
            of photo names where there is only one [camera] table.
    """
    if options.images and not options.others:
        raise InputError(
            f"[camera] images is '{options.images}', expected this key only with several [[camera]] tables"
        )
    for table in options.tables:
        _check_table(table)


def _check_table(options: CameraOptions) -> None:
    if not options.params and options.focal_length_stddev_px is not None:
        raise InputError("[camera] has focal_length_stddev_px but no params, expected params with a focal length")
    if not options.model:
        if options.params:
            raise InputError("[camera] has params but no model, expected the COLMAP camera model they belong to")
        return
    if options.model not in _MODELS:
        nearest = nearest_known(options.model, _MODELS)
        raise InputError(
            f"[camera] model is '{options.model}', expected a COLMAP camera model; the nearest is '{nearest}'"
        )
    if not options.params:
        return
    expected = pycolmap.Camera.create_from_model_name(1, options.model, 1.0, 1, 1)
    if len(options.params) != len(expected.params):
        raise InputError(
            f"[camera] params has {len(options.params)} numbers, expected {len(expected.params)}"
            f" for {options.model} ({expected.params_info})"
        )
    expected.params = list(options.params)
    if not all(map(math.isfinite, options.params)) or any(options.params[i] <= 0 for i in expected.focal_length_idxs()):
        raise InputError(f"[camera] params are {list(options.params)}, expected {expected.params_info} with f above 0")


@dataclass(frozen=True)
class PhotoCameras:
    """Cameras of n photos.

    Attributes:
        cameras: the cameras, without ids.
        of_photo: n indices into ``cameras``, the camera of each photo.
        guessed: where parameters are given, one photo of each camera that they do not fit.
    """

    cameras: tuple[pycolmap.Camera, ...]
    of_photo: tuple[int, ...]
    guessed: tuple[str, ...] = ()

    @property
    def inputs(self) -> list[Any]:
        """Plain values that are equal only for equal cameras; they go into a fingerprint."""
        cameras = [
            [camera.model_name, camera.params.tolist(), camera.width, camera.height, camera.has_prior_focal_length]
            for camera in self.cameras
        ]
        return [*cameras, *([] if len(cameras) == 1 else [self.of_photo])]


def cameras_of_photos(options: CameraOptions, photos: Photos, rigs: Rigs = NO_RIGS) -> PhotoCameras:
    """Find the camera that took each photo; all photos of one camera have the same size.

    Args:
        options: as checked by ``check_camera``. Where they give no parameters, COLMAP guesses the camera from the EXIF
            data of its first photo.
        rigs: each camera of a rig is one camera, whatever the options say.

    Raises:
        InputError: a camera of a rig has photos of two sizes, the parameters belong to photos of another size, or no
            photo fits the pattern of a table.
        OptionError: a photo belongs to two tables.
    """
    table_of = {name: options.of_photo(name) for name in photos.names}
    cameras: list[pycolmap.Camera] = []
    place_of: dict[str, int] = {}
    guessed: list[str] = []
    for table in options.tables:
        own = photos.subset([name for name in photos.names if table_of[name] is table])
        if not own.names and table.images:
            raise InputError(
                f"[[camera]] images is '{table.images}', expected a pattern that fits some photo's name, such as"
                f" {photos.names[0]}"
            )
        if not own.names:
            continue
        found = _of_one_table(table, own, rigs)
        place_of |= {name: len(cameras) + place for name, place in zip(own.names, found.of_photo, strict=True)}
        cameras += found.cameras
        guessed += found.guessed
    return PhotoCameras(tuple(cameras), tuple(place_of[name] for name in photos.names), tuple(guessed))


def _of_one_table(options: CameraOptions, photos: Photos, rigs: Rigs) -> PhotoCameras:
    groups: dict[Any, int] = {}
    of_photo = [groups.setdefault(key, len(groups)) for key in _keys(options.mode, photos, rigs)]
    firsts = [of_photo.index(group) for group in range(len(groups))]
    known: dict[tuple[int, int], pycolmap.Camera] = {}
    if options.model and options.params:
        known = calibrated_cameras(options.model, options.params, photos.sizes)
    for camera in known.values():
        for index, size_px in zip(camera.principal_point_idxs(), (camera.width, camera.height), strict=False):
            if not 0 < camera.params[index] < size_px:
                raise InputError(
                    f"[camera] params are {camera.params.tolist()} ({camera.params_info}), expected a principal point"
                    f" inside the photos of {camera.width} x {camera.height} pixels: do they belong to another image"
                    " size?"
                )
    reader = pycolmap.ImageReaderOptions()
    if options.model:
        reader.camera_model = options.model
    cameras = tuple(
        pycolmap.Camera(known[photos.sizes[first]].todict())
        if photos.sizes[first] in known
        else pycolmap.infer_camera_from_image(photos.folder / photos.names[first], reader)
        for first in firsts
    )
    guessed = tuple(photos.names[first] for first in firsts if known and photos.sizes[first] not in known)
    return PhotoCameras(cameras, tuple(of_photo), guessed)


def _keys(mode: str, photos: Photos, rigs: Rigs) -> list[Any]:
    """Return a key for each photo; photos with equal keys share a camera."""
    sizes: dict[str | None, tuple[int, int]] = {}
    in_rigs = [rigs.camera_of(name) for name in photos.names]
    for name, size, camera in zip(photos.names, photos.sizes, in_rigs, strict=True):
        if camera is not None and (first := sizes.setdefault(camera, size)) != size:
            message = (
                f"{name} has {size[0]} x {size[1]} pixels, expected {first[0]} x {first[1]} like others of '{camera}'"
            )
            raise InputError(message, rigs.path)
    key_of: Callable[[str], Any] = {
        "per_image": lambda name: name,
        "per_folder": lambda name: PurePosixPath(name).parent,
        "single": lambda name: None,
        "auto": lambda name: _maker(photos.folder / name),
    }[mode]
    return [
        (key_of(name), size) if camera is None else (camera, "of a rig")
        for name, size, camera in zip(photos.names, photos.sizes, in_rigs, strict=True)
    ]


def _maker(path: Path) -> tuple[str, ...]:
    """Return the EXIF values that tell cameras and focal lengths apart; empty without EXIF."""
    tags = exif_tags(path)
    return tuple(str(tags[tag]).strip("\0 ") for tag in _TELLING_TAGS if tag in tags)

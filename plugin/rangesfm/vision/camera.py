"""The camera of the photos: what the user knows of it, or COLMAP's guess."""

from __future__ import annotations

import math
from pathlib import Path

import pycolmap

from rangesfm.errors import InputError, nearest_known
from rangesfm.options import CameraOptions

_MODELS = {name: model for name, model in pycolmap.CameraModelId.__members__.items() if name != "INVALID"}


def check_camera(options: CameraOptions) -> None:
    """Refuse what is no camera of COLMAP's.

    Raises:
        InputError: an unknown model, parameters without a model, too few or too many or impossible ones.
    """
    if options.params is None and options.focal_length_stddev_px is not None:
        raise InputError("[camera] has focal_length_stddev_px but no params, expected those that it is of")
    if options.model is None:
        if options.params is not None:
            raise InputError("[camera] has params but no model, expected COLMAP's camera model that they belong to")
        return
    if options.model not in _MODELS:
        nearest = nearest_known(options.model, _MODELS)
        raise InputError(f"[camera] model is '{options.model}', expected one of COLMAP's, the nearest is '{nearest}'")
    if options.params is None:
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


def camera_of_photos(options: CameraOptions, photo: Path, width: int, height: int) -> pycolmap.Camera:
    """The one camera of all photos.

    Args:
        options: as checked by ``check_camera``.
        photo: one of the photos, from whose EXIF COLMAP takes what ``options`` leave open.
        width, height: of the photos, pixels.

    Raises:
        InputError: parameters that belong to photos of another size.
    """
    if options.model is None or options.params is None:
        reader = pycolmap.ImageReaderOptions()
        if options.model is not None:
            reader.camera_model = options.model
        return pycolmap.infer_camera_from_image(photo, reader)
    camera = pycolmap.Camera.create_from_model_name(pycolmap.INVALID_CAMERA_ID, options.model, 1.0, width, height)
    camera.params = list(options.params)
    camera.has_prior_focal_length = True
    for index, size_px in zip(camera.principal_point_idxs(), (width, height), strict=False):
        if not 0 < camera.params[index] < size_px:
            raise InputError(
                f"[camera] params are {list(options.params)} ({camera.params_info}), expected a principal point inside"
                f" the photos of {width} x {height} pixels: do they belong to another image size?"
            )
    return camera

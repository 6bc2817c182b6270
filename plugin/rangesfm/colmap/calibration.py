"""A camera's given parameters, and the photos that they are of."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence

import pycolmap

Size = tuple[int, int]


def calibrated_cameras(model: str, params: Sequence[float], sizes: Iterable[Size]) -> dict[Size, pycolmap.Camera]:
    """The given camera for each size of photos that it can have: the most common one, and the same enlarged or reduced.

    Args:
        sizes: width and height in pixels of each photo.
    """
    counted = Counter(sizes)
    own, _ = max(counted.items(), key=lambda item: (item[1], item[0]))
    given = pycolmap.Camera.create_from_model_name(pycolmap.INVALID_CAMERA_ID, model, 1.0, *own)
    given.params = list(params)
    given.has_prior_focal_length = True
    cameras = {}
    for width, height in counted:
        if abs(width * own[1] - height * own[0]) <= max(own):  # the same shape, but for a rounded pixel
            cameras[width, height] = pycolmap.Camera(given.todict())
            cameras[width, height].rescale(width, height)
    return cameras

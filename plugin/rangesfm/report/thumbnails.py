"""Small copies of the photos, as many as the page has room for."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image, ImageOps

from rangesfm.files.atomic import stays_inside

MAX_NUM_THUMBNAILS = 160
MAX_BYTES = 600_000
"""Of all thumbnails as they stand in the page."""

_WIDTHS_PX = (256, 208, 160, 128)
_QUALITY = 60


def thumbnails(folder: Path | None, image_names: Sequence[str]) -> dict[str, str]:
    """JPEGs as data URIs by photo, evenly over the path; photos that cannot be read are left out.

    So are those that a name from a file would fetch from outside the folder: the page is handed on.

    All are made as wide as fits into MAX_BYTES; if even the smallest do not fit, there are fewer.
    """
    image_names = [name for name in image_names if stays_inside(name)]
    if folder is None or not folder.is_dir() or not image_names:
        return {}
    chosen = np.unique(np.linspace(0, len(image_names) - 1, MAX_NUM_THUMBNAILS).round().astype(int))
    photos = {image_names[i]: _small_copy(folder / image_names[i]) for i in chosen}
    made: dict[str, str] = {}
    for width in _WIDTHS_PX:
        made = {name: _data_uri(photo, width) for name, photo in photos.items() if photo is not None}
        if sum(map(len, made.values())) <= MAX_BYTES:
            return made
    num_bytes = np.cumsum([len(uri) for uri in made.values()])
    return {name: uri for (name, uri), up_to_it in zip(made.items(), num_bytes) if up_to_it <= MAX_BYTES}


def _small_copy(path: Path) -> Image.Image | None:
    width = _WIDTHS_PX[0]
    try:
        with Image.open(path) as photo:
            photo.draft("RGB", (2 * width, 2 * width))  # a JPEG is decoded no larger than needed
            return ImageOps.contain(photo.convert("RGB"), (width, width))
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError):
        return None


def _data_uri(photo: Image.Image, width: int) -> str:
    file = io.BytesIO()
    ImageOps.contain(photo, (width, width)).save(file, "JPEG", quality=_QUALITY, optimize=True)
    return "data:image/jpeg;base64," + base64.b64encode(file.getvalue()).decode("ascii")

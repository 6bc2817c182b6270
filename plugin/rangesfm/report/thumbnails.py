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
    names = [image_names[i] for i in chosen]
    width = _width_that_fits(folder, names)
    made: dict[str, str] = {}
    num_bytes = 0
    for name in names:
        uri = _thumbnail(folder / name, width)
        if uri is not None and num_bytes + len(uri) <= MAX_BYTES:
            made[name] = uri
            num_bytes += len(uri)
    return made


def _width_that_fits(folder: Path, names: Sequence[str]) -> int:
    """By a few photos; a quarter is kept in reserve for richer ones."""
    few = names[:: max(1, len(names) // 4)]
    for width in _WIDTHS_PX:
        sizes = [len(uri) for uri in (_thumbnail(folder / name, width) for name in few) if uri is not None]
        if not sizes or 1.25 * len(names) * sum(sizes) / len(sizes) <= MAX_BYTES:
            return width
    return _WIDTHS_PX[-1]


def _thumbnail(path: Path, width: int) -> str | None:
    try:
        with Image.open(path) as photo:
            photo.draft("RGB", (2 * width, 2 * width))  # a JPEG is decoded no larger than needed
            small = ImageOps.contain(photo.convert("RGB"), (width, width))
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError):
        return None
    file = io.BytesIO()
    small.save(file, "JPEG", quality=_QUALITY, optimize=True)
    return "data:image/jpeg;base64," + base64.b64encode(file.getvalue()).decode("ascii")

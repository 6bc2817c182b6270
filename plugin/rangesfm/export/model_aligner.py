"""Metric camera positions as COLMAP's ``model_aligner`` reads them (``--ref_images_path``)."""

from __future__ import annotations

from pathlib import Path

import pycolmap

from rangesfm.errors import InputError
from rangesfm.files.atomic import new_file


def write_positions(reconstruction: pycolmap.Reconstruction, path: Path) -> Path:
    """Write ``image_name x y z`` for each registered photo, in order of the names.

    Raises:
        InputError: a photo's name holds white space, at which COLMAP would split it.
    """
    lines = []
    for image in sorted((image for image in reconstruction.images.values() if image.has_pose), key=lambda i: i.name):
        if len(image.name.split()) != 1:
            raise InputError(f"the format 'model_aligner' cannot hold white space in a photo's name: {image.name!r}")
        lines.append(" ".join([image.name, *(f"{value:.17g}" for value in image.projection_center())]))
    with new_file(path) as temporary:
        temporary.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path

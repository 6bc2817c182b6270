"""What COLMAP itself reads: models, similarities for ``model_transformer`` and positions for ``model_aligner``."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pycolmap
from scipy.spatial.transform import Rotation

from rangesfm.colmap.model_files import write_binary_model
from rangesfm.errors import InputError
from rangesfm.files.atomic import new_folder, write_text
from rangesfm.geometry.similarity import Similarity


def write_model(reconstruction: pycolmap.Reconstruction, path: Path, *, as_text: bool = False) -> Path:
    """Write the model as the folder ``path``, whole or not at all; an older one is replaced."""
    with new_folder(path) as folder:
        if as_text:
            reconstruction.write_text(folder)
        else:
            write_binary_model(reconstruction, folder)
    return path


def write_transform(metric_from_sfm: Similarity | None, path: Path) -> Path:
    """Write metric_from_sfm as ``scale qw qx qy qz tx ty tz`` on one line, losing no digit.

    Raises:
        InputError: the similarity is not known.
    """
    if metric_from_sfm is None:
        raise InputError("the format 'transform' needs metric_from_sfm, which is not known of this model")
    qx, qy, qz, qw = Rotation.from_matrix(metric_from_sfm.rotation).as_quat()
    numbers = np.array([metric_from_sfm.scale, qw, qx, qy, qz, *metric_from_sfm.translation])
    write_text(" ".join(f"{number:.17g}" for number in numbers) + "\n", path)
    return path


def write_positions(reconstruction: pycolmap.Reconstruction, path: Path) -> Path:
    """Write metric camera positions, ``image_name x y z`` for each registered photo, in order of the names.

    Raises:
        InputError: a photo's name holds white space, at which COLMAP would split it.
    """
    lines = []
    for image in sorted((image for image in reconstruction.images.values() if image.has_pose), key=lambda i: i.name):
        if len(image.name.split()) != 1:
            raise InputError(f"the format 'model_aligner' cannot hold white space in a photo's name: {image.name!r}")
        lines.append(" ".join([image.name, *(f"{value:.17g}" for value in image.projection_center())]))
    write_text("\n".join(lines) + "\n", path)
    return path

"""The similarity from the unscaled to the metric world, as COLMAP's ``model_transformer`` reads it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from rangesfm.errors import InputError
from rangesfm.files.atomic import new_file
from rangesfm.geometry.similarity import Similarity


def write_transform(metric_from_sfm: Similarity | None, path: Path) -> Path:
    """Write ``scale qw qx qy qz tx ty tz`` on one line, losing no digit.

    Raises:
        InputError: the similarity is not known.
    """
    if metric_from_sfm is None:
        raise InputError("the format 'transform' needs metric_from_sfm, which is not known of this model")
    qx, qy, qz, qw = Rotation.from_matrix(metric_from_sfm.rotation).as_quat()
    numbers = np.array([metric_from_sfm.scale, qw, qx, qy, qz, *metric_from_sfm.translation])
    with new_file(path) as temporary:
        temporary.write_text(" ".join(f"{number:.17g}" for number in numbers) + "\n", encoding="ascii")
    return path

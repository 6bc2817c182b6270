"""The path of a model in a result folder, with the photo times that the run wrote beside it."""

from __future__ import annotations

import pycolmap

from rangesfm.errors import InputError
from rangesfm.result.result_folder import ResultFolder
from rangesfm.result.result_tables import PhotoTimes
from rangesfm.util.geometry.trajectory import Trajectory, trajectory_from_reconstruction


def path_in_result(model: pycolmap.Reconstruction, result: ResultFolder) -> Trajectory:
    """Return the camera's path in a model of a result.

    Raises:
        InputError: the result has photo times, but none for a photo of the model.
    """
    path = trajectory_from_reconstruction(model, result.timestamps_s)
    if not len(path) and model.num_reg_images():
        raise InputError(f"none of the model's photos has a time in {PhotoTimes.NAME}", result.path)
    return path

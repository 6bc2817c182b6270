"""Models of poses alone, from trajectories that other programs wrote."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pycolmap

from rangesfm.errors import InputError
from rangesfm.util.geometry.reference import read_reference


def model_of_trajectory(path: Path) -> pycolmap.Reconstruction:
    """Return the poses of a file as a model without points: a TUM trajectory, or the CSV of ``read_reference``.

    The poses are world from camera, in any unit. Poses by time get photos that are named after the time in seconds.

    Raises:
        InputError: the file is not valid, or has no rotations.
    """
    poses = read_reference(path)
    if poses.world_from_cam is None:
        raise InputError("has positions without rotations, expected timestamp tx ty tz qx qy qz qw", path)
    names = poses.image_names or [f"{time:.6f}.png" for time in np.asarray(poses.timestamps_s).tolist()]
    model = pycolmap.Reconstruction()
    # Poses have no pixels; the camera is only there because a model has one.
    model.add_camera_with_trivial_rig(pycolmap.Camera.create_from_model_name(1, "SIMPLE_PINHOLE", 1000.0, 1000, 1000))
    for number, (name, turn, place) in enumerate(zip(names, poses.world_from_cam, poses.positions_m, strict=True), 1):
        cam_from_world = pycolmap.Rigid3d(pycolmap.Rotation3d(turn), place).inverse()
        model.add_image_with_trivial_frame(pycolmap.Image(name=name, camera_id=1, image_id=number), cam_from_world)
    return model

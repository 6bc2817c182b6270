"""A trajectory of another program is a model of poses alone."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rangesfm.colmap.model_files import model_of_trajectory
from rangesfm.errors import InputError
from rangesfm.sfm.image_times import find_image_times


def test_poses_of_a_tum_file_are_photos_with_times(tmp_path: Path) -> None:
    path = tmp_path / "KeyFrameTrajectory.txt"
    path.write_text("1305031102.175304 1 2 3 0 0 0 1\n1305031103.5 4 5 6 0.5 0.5 0.5 0.5\n")
    images = sorted(model_of_trajectory(path).images.values(), key=lambda image: image.name)
    times = find_image_times("nowhere", [image.name for image in images])
    np.testing.assert_allclose(times.timestamps_s, [1305031102.175304, 1305031103.5], atol=1e-6)
    np.testing.assert_allclose([image.projection_center() for image in images], [[1, 2, 3], [4, 5, 6]])
    rotation = images[1].cam_from_world().rotation
    np.testing.assert_allclose(rotation.quat, [-0.5, -0.5, -0.5, 0.5])  # of the camera from the world


def test_positions_without_rotations_are_no_trajectory(tmp_path: Path) -> None:
    path = tmp_path / "positions.csv"
    path.write_text("timestamp_s,x_m,y_m,z_m\n1,1,2,3\n2,4,5,6\n")
    with pytest.raises(InputError, match="has positions without rotations"):
        model_of_trajectory(path)

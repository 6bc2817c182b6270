"""Trajectories as the KITTI odometry benchmark has them: the first three rows of world_from_cam, 12 numbers a line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

from rangesfm.files.atomic import new_file
from rangesfm.geometry.trajectory import Trajectory


def write_kitti(trajectory: Trajectory, path: Path) -> Path:
    """Write one pose a line (metres), in the order of time; the format has no place for times and names."""
    with new_file(path) as temporary:
        np.savetxt(temporary, kitti_poses(trajectory), fmt="%.17g")
    return path


def kitti_poses(trajectory: Trajectory) -> npt.NDArray[np.float64]:
    """(n, 12)."""
    poses = np.concatenate([trajectory.world_from_cam, trajectory.centers[:, :, None]], axis=2)
    return poses.reshape(-1, 12)

"""Trajectories as the TUM RGB-D benchmark has them: ``timestamp tx ty tz qx qy qz qw``."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from rangesfm.files.atomic import new_file
from rangesfm.geometry.trajectory import Trajectory

TUM_HEADER = "# world_from_cam: timestamp tx ty tz qx qy qz qw (seconds, metres)"


def write_trajectory(trajectory: Trajectory, path: Path) -> Path:
    """Write the poses (world from camera, metres), one line each.

    Without times the first column counts the keyframes from 0, and a comment says so.
    """
    with new_file(path) as temporary:
        temporary.write_text("\n".join(tum_lines(trajectory)) + "\n", encoding="utf-8")
    return path


def tum_lines(trajectory: Trajectory) -> list[str]:
    """The header, perhaps a comment, and a line for each pose."""
    lines = [TUM_HEADER]
    timestamps_s = trajectory.timestamps_s
    if timestamps_s is None:
        lines.append("# the photos have no times: the first column is the keyframe's index, in order of its name")
        timestamps_s = np.arange(len(trajectory), dtype=np.float64)
    if len(trajectory):
        quaternions = Rotation.from_matrix(trajectory.world_from_cam).as_quat()
        for time, center, quaternion in zip(timestamps_s, trajectory.centers, quaternions):
            numbers = [f"{value:.9f}" for value in center] + [f"{value:.12f}" for value in quaternion]
            lines.append(f"{time:.9f} {' '.join(numbers)}")
    return lines

"""Trajectories in the formats of the TUM RGB-D and KITTI odometry benchmarks, and covariances of camera centres.

A line of TUM is ``timestamp tx ty tz qx qy qz qw``. A line of KITTI has the first three rows of world_from_cam, 12
numbers. Programs refuse lines with more numbers, so the covariances are in a table of their own, a row for each pose.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from rangesfm.arrays import Array
from rangesfm.errors import InputError
from rangesfm.export.metric_map import MetricMap
from rangesfm.util.files.atomic import new_file
from rangesfm.util.files.text_tables import write_table
from rangesfm.util.geometry.trajectory import Trajectory

# Formats that need covariances.
COVARIANCE_FORMATS = ("tum_covariance", "kitti_covariance")
_TUM_HEADER = "# world_from_cam: timestamp tx ty tz qx qy qz qw (seconds, metres)"


def write_trajectory(trajectory: Trajectory, path: Path) -> Path:
    """Write the poses (world from camera, metres) in the format of TUM, one line each.

    Where the photos have no times, the first column is the number of the keyframe from 0, and a comment says so.
    """
    header, timestamps_s = _TUM_HEADER, trajectory.timestamps_s
    if timestamps_s is None:
        header += "\n# the photos have no times: the first column is the number of the keyframe, in order of its name"
        timestamps_s = np.arange(len(trajectory), dtype=np.float64)
    quaternions = Rotation.from_matrix(trajectory.world_from_cam).as_quat() if len(trajectory) else np.empty((0, 4))
    rows = np.hstack([timestamps_s[:, None], trajectory.centers, quaternions])
    return _write_numbers(rows, path, ["%.9f"] * 4 + ["%.12f"] * 4, header)


def write_kitti(trajectory: Trajectory, path: Path) -> Path:
    """Write one pose per line (metres), in order of time; the format has no room for times or names."""
    poses = np.concatenate([trajectory.world_from_cam, trajectory.centers[:, :, None]], axis=2)
    return _write_numbers(poses.reshape(-1, 12), path)


def _write_numbers(rows: Array, path: Path, formats: str | list[str] = "%.17g", header: str = "") -> Path:
    with new_file(path) as temporary, temporary.open("w", encoding="utf-8") as file:
        np.savetxt(file, rows, formats, header=header, comments="")
    return path


def write_covariances(map_: MetricMap, path: Path) -> Path:
    """Write ``image_name,cov_xx_m2,...,cov_zz_m2`` of each projection centre, in the world and the order of the poses.

    Raises:
        InputError: the map has no covariances.
    """
    known, names = map_.center_covariance_m2, map_.trajectory.image_names
    missing = [name for name in names if name not in known]
    if missing:
        raise InputError(
            f"there is no pose covariance of {missing[0]}: it needs a refinement with [refine] covariance = true"
        )
    upper = np.array([known[name] for name in names]).reshape(-1, 3, 3)[(slice(None), *np.triu_indices(3))]
    header = ["image_name", *(f"cov_{axes}_m2" for axes in ("xx", "xy", "xz", "yy", "yz", "zz"))]
    write_table(path, header, ([name, *(f"{v:.9g}" for v in row)] for name, row in zip(names, upper.tolist())))
    return path

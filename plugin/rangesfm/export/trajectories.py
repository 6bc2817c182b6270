"""Trajectories as the TUM RGB-D and the KITTI odometry benchmarks have them, also with covariances.

TUM: ``timestamp tx ty tz qx qy qz qw``; KITTI: the first three rows of world_from_cam, 12 numbers a line. With
covariances, six numbers stand behind the pose: xx xy xz yy yz zz of the projection centre, square metres, in the world
of the poses.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from rangesfm.arrays import Array
from rangesfm.errors import InputError
from rangesfm.export.metric_map import MetricMap
from rangesfm.files.atomic import new_file
from rangesfm.geometry.trajectory import Trajectory

# Formats that cannot do without covariances.
COVARIANCE_FORMATS = ("tum_covariance", "kitti_covariance")
_TUM_HEADER = "# world_from_cam: timestamp tx ty tz qx qy qz qw (seconds, metres)"


def write_trajectory(trajectory: Trajectory, path: Path) -> Path:
    """Write the poses (world from camera, metres) as TUM's, one line each.

    Without times the first column counts the keyframes from 0, and a comment says so.
    """
    return _write_tum(trajectory, path, _TUM_HEADER, np.empty((len(trajectory), 0)))


def write_tum_covariance(map_: MetricMap, path: Path) -> Path:
    """Write ``timestamp tx ty tz qx qy qz qw xx xy xz yy yz zz``, one line a keyframe.

    Raises:
        InputError: the map comes without covariances.
    """
    header = f"{_TUM_HEADER} and xx xy xz yy yz zz of the centre (square metres)"
    return _write_tum(map_.trajectory, path, header, _upper_triangles(map_))


def write_kitti(trajectory: Trajectory, path: Path) -> Path:
    """Write one pose a line (metres), in the order of time; the format has no place for times and names."""
    return _write_numbers(_kitti_poses(trajectory), path)


def write_kitti_covariance(map_: MetricMap, path: Path) -> Path:
    """Write the 12 numbers of a pose and the 6 of its centre's covariance, one line a keyframe.

    Raises:
        InputError: the map comes without covariances.
    """
    return _write_numbers(np.hstack([_kitti_poses(map_.trajectory), _upper_triangles(map_)]), path)


def _write_tum(trajectory: Trajectory, path: Path, header: str, further: Array) -> Path:
    """``further``: (n, k) numbers that stand behind the poses."""
    timestamps_s = trajectory.timestamps_s
    if timestamps_s is None:
        header += "\n# the photos have no times: the first column is the keyframe's index, in order of its name"
        timestamps_s = np.arange(len(trajectory), dtype=np.float64)
    quaternions = Rotation.from_matrix(trajectory.world_from_cam).as_quat() if len(trajectory) else np.empty((0, 4))
    rows = np.hstack([timestamps_s[:, None], trajectory.centers, quaternions, further])
    return _write_numbers(rows, path, ["%.9f"] * 4 + ["%.12f"] * 4 + ["%.9g"] * further.shape[1], header)


def _kitti_poses(trajectory: Trajectory) -> Array:
    """(n, 12)."""
    return np.concatenate([trajectory.world_from_cam, trajectory.centers[:, :, None]], axis=2).reshape(-1, 12)


def _write_numbers(rows: Array, path: Path, formats: str | list[str] = "%.17g", header: str = "") -> Path:
    with new_file(path) as temporary:
        np.savetxt(temporary, rows, formats, header=header, comments="")
    return path


def _upper_triangles(map_: MetricMap) -> Array:
    """(n, 6) in the order of the trajectory."""
    known, names = map_.center_covariance_m2 or {}, map_.trajectory.image_names
    missing = [name for name in names if name not in known]
    if missing:
        raise InputError(
            f"there is no pose covariance of {missing[0]}: it takes a refinement, with [refine] covariance"
        )
    rows, columns = np.triu_indices(3)
    return np.array([known[name] for name in names]).reshape(-1, 3, 3)[:, rows, columns]

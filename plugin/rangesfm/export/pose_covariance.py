"""Trajectories as TUM's and KITTI's, each line followed by the covariance of the projection centre.

Six numbers behind the pose: xx xy xz yy yz zz, square metres, in the world of the poses.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from rangesfm.errors import InputError
from rangesfm.export.kitti import kitti_poses
from rangesfm.export.metric_map import Array, MetricMap
from rangesfm.export.tum import TUM_HEADER, tum_lines
from rangesfm.files.atomic import new_file

# Formats that cannot do without covariances.
COVARIANCE_FORMATS = ("tum_covariance", "kitti_covariance")


def write_tum_covariance(map_: MetricMap, path: Path) -> Path:
    """Write ``timestamp tx ty tz qx qy qz qw xx xy xz yy yz zz``, one line a keyframe.

    Raises:
        InputError: the map comes without covariances.
    """
    lines = tum_lines(map_.trajectory)
    lines[0] = f"{TUM_HEADER} and xx xy xz yy yz zz of the centre (square metres)"
    poses = len(lines) - len(map_.trajectory)
    for row, numbers in enumerate(_upper_triangles(map_), start=poses):
        lines[row] += "".join(f" {number:.9g}" for number in numbers)
    with new_file(path) as temporary:
        temporary.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def write_kitti_covariance(map_: MetricMap, path: Path) -> Path:
    """Write the 12 numbers of a pose and the 6 of its centre's covariance, one line a keyframe.

    Raises:
        InputError: the map comes without covariances.
    """
    with new_file(path) as temporary:
        np.savetxt(temporary, np.hstack([kitti_poses(map_.trajectory), _upper_triangles(map_)]), fmt="%.17g")
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

"""Marks with known coordinates, found in a model."""

from __future__ import annotations

import numpy as np
import pycolmap
from scipy.sparse import csr_array, vstack

from rangesfm.measurements.lengths.map_points import MapPoints, by_pose
from rangesfm.measurements.lengths.tape import CONTROL
from rangesfm.measurements.positions.control_points import ControlPoints, marks_seen
from rangesfm.measurements.positions.known_positions import KnownPositions
from rangesfm.util.geometry.trajectory import Trajectory


def locate_points(points: ControlPoints, model: pycolmap.Reconstruction, path: Trajectory) -> KnownPositions:
    """Find the marks of control and check points in a model; points that fewer than two photos show are left out.

    Args:
        points: in the site. model: in any world. path: of its keyframes, in the same world.

    Raises:
        InputError: the marks of a point are not of one point, or are seen from one direction only.
    """
    seen = [point for point, is_seen in zip(points.points, marks_seen(points, model), strict=True) if is_seen]
    finder, k = MapPoints(model, {}, points.markers, np.nan), len(seen)
    found = [finder.find_marker(point.name) for point in seen]
    stddev_m = np.array([point.stddev_m for point in seen])
    return KnownPositions(
        names=tuple(point.name for point in seen),
        is_mark=np.ones(k, dtype=bool),
        is_check=np.array([point.kind != CONTROL for point in seen], dtype=bool),
        position_m=np.array([point.position_m for point in seen]).reshape(-1, 3),
        covariance_m2=stddev_m[:, None, None] ** 2 * np.eye(3),
        is_stated=np.full(k, points.stddevs_are_given),
        is_geodetic=np.full(k, bool(points.crs)),
        places=np.array([each.position_m for each in found]).reshape(-1, 3),
        arms_m=np.zeros((k, 3)),
        own_covariance=np.array([each.errors.own_m2 for each in found]).reshape(-1, 3, 3),
        arm_stddev_m=np.zeros(k),
        time_s=np.full(k, np.nan),
        clock_stddev_s=np.zeros(k),
        velocity=np.zeros((k, 3)),
        world_from_cam=np.zeros((k, 3, 3)),
        by_pose=vstack([csr_array((0, 6 * len(path))), *(by_pose(each, path) for each in found)], format="csr"),
        arms_by_pose=csr_array((3 * k, 6 * len(path))),
        on_path=np.full((k, 2), -1, dtype=np.int64),
        fraction=np.zeros(k),
        from_line=np.zeros((k, 3)),
    )

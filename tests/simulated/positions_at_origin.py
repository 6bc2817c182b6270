"""Known positions without geometry, for tests of what is made of their kinds, times and errors."""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_array

from rangesfm.measurements.places import AntennaPlaces
from rangesfm.measurements.positions.known_positions import KnownPositions


def known_positions(is_mark: list[bool], num_poses: int = 1, stddev_m: float = 0.1) -> KnownPositions:
    """Positions at the origin of the site and of the model, without arms; the antenna's are a second apart."""
    k, marks = len(is_mark), np.array(is_mark)
    return KnownPositions(
        names=tuple(f"P{row}" for row in range(k)),
        is_mark=marks,
        is_check=np.zeros(k, dtype=bool),
        position_m=np.zeros((k, 3)),
        covariance_m2=np.tile(stddev_m**2 * np.eye(3), (k, 1, 1)),
        places=np.zeros((k, 3)),
        arms_m=np.zeros((k, 3)),
        own_covariance=np.zeros((k, 3, 3)),
        arm_stddev_m=np.zeros(k),
        time_s=np.where(marks, np.nan, np.arange(k)),
        velocity=np.zeros((k, 3)),
        world_from_cam=np.zeros((k, 3, 3)),
        by_pose=csr_array((3 * k, 6 * num_poses)),
        arms_by_pose=csr_array((3 * k, 6 * num_poses)),
        on_path=AntennaPlaces.nowhere(k),
    )

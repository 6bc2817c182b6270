"""CameraPath: a camera's smooth way through a scene, exact at every time.

World z is up. Camera frame as in COLMAP: x right, y down, z forward.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from rangesfm.arrays import Array


@dataclass(frozen=True)
class CameraPath:
    """Pose as a function of time on the camera's clock.

    Attributes:
        start_s, end_s: first and last time at which it is defined.
        position: spline of the projection centre, metres.
        rotation: spline of world_from_cam.
    """

    start_s: float
    end_s: float
    position: CubicSpline
    rotation: RotationSpline

    @classmethod
    def through(cls, times_s: Array, centers_m: Array, world_from_cam: Array) -> CameraPath:
        """The smooth path through n poses.

        Args:
            times_s: (n,) strictly increasing, n >= 2.
            centers_m: (n, 3).
            world_from_cam: (n, 3, 3).
        """
        rotations = Rotation.from_matrix(world_from_cam)
        return cls(
            float(times_s[0]), float(times_s[-1]), CubicSpline(times_s, centers_m), RotationSpline(times_s, rotations)
        )

    def centers(self, times_s: Array) -> Array:
        """(n, 3) projection centres in the world, metres."""
        return np.asarray(self.position(times_s))

    def world_from_cam(self, times_s: Array) -> Array:
        """(n, 3, 3) rotations."""
        return np.asarray(self.rotation(times_s).as_matrix())

"""Gravity: the up direction in the first camera, given by the user, as a prior on the map's tilt in the site frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from rangesfm.arrays import Array
from rangesfm.util.geometry.rotations import cross_matrices

UP_IN_SITE = np.array([0.0, 0.0, 1.0])
# Standard deviation of the given direction: that of a camera held level by hand, or of a phone's accelerometer.
_STDDEV_DEG = 3.0


@dataclass(frozen=True)
class Gravity:
    """Prior on the up direction, which is +z in the site frame.

    Attributes:
        up_in_first_camera: (3,) unit vector.
        stddev_rad: standard deviation of its direction, radians.
    """

    up_in_first_camera: Array
    stddev_rad: float

    def residuals(self, rotation: Array) -> Array:
        """Return the residuals (3,) in standard deviations, given the rotation (3, 3) of site_from_first_camera."""
        off: Array = (rotation @ self.up_in_first_camera - UP_IN_SITE) / self.stddev_rad
        return off

    def jacobian(self, rotation: Array, left: Array) -> Array:
        """Return the derivatives (3, 3) of the residuals by a rotation vector whose left Jacobian is ``left``."""
        slope: Array = -cross_matrices(rotation @ self.up_in_first_camera) @ left / self.stddev_rad
        return slope

    def level_rotations(self, num: int) -> Rotation:
        """Return ``num`` rotations of an upright map, with evenly spaced headings."""
        upright, _ = Rotation.align_vectors(UP_IN_SITE[None], self.up_in_first_camera[None])
        headings = Rotation.from_euler("z", np.linspace(0.0, 2 * np.pi, num, endpoint=False)[:, None])
        return headings * upright


def gravity_of(up_in_first_camera: tuple[float, float, float] | None) -> Gravity | None:
    """Return the prior for a direction that the user gave, or None without one."""
    if up_in_first_camera is None:
        return None
    up = np.array(up_in_first_camera, dtype=np.float64)
    return Gravity(up / np.linalg.norm(up), np.deg2rad(_STDDEV_DEG))

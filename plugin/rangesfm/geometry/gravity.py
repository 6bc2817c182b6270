"""Which way is up: a user's word on the first camera, as a prior on how the map stands in the site frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from rangesfm.arrays import Array
from rangesfm.geometry.rotations import cross_matrices

UP_IN_SITE = np.array([0.0, 0.0, 1.0])
# A camera that somebody held level, or a phone's accelerometer.
_STDDEV_DEG = 3.0


@dataclass(frozen=True)
class Gravity:
    """The upward direction, which is +z in the site frame.

    Attributes:
        up_in_first_camera: (3,) unit vector.
        stddev_rad: of its direction.
    """

    up_in_first_camera: Array
    stddev_rad: float

    def residuals(self, rotation: Array) -> Array:
        """(3,) in stddevs, for the rotation of site_from_first_camera (3, 3)."""
        off: Array = (rotation @ self.up_in_first_camera - UP_IN_SITE) / self.stddev_rad
        return off

    def jacobian(self, rotation: Array, left: Array) -> Array:
        """(3, 3) of the residuals by a rotation vector; ``left`` is its left Jacobian."""
        slope: Array = -cross_matrices(rotation @ self.up_in_first_camera) @ left / self.stddev_rad
        return slope

    def level_rotations(self, num: int) -> Rotation:
        """All headings, evenly, of a map that stands upright."""
        upright, _ = Rotation.align_vectors(UP_IN_SITE[None], self.up_in_first_camera[None])
        headings = Rotation.from_euler("z", np.linspace(0.0, 2 * np.pi, num, endpoint=False)[:, None])
        return headings * upright


def gravity_of(up_in_first_camera: tuple[float, float, float] | None) -> Gravity | None:
    """The prior of what a user says; None if nothing."""
    if up_in_first_camera is None:
        return None
    up = np.array(up_in_first_camera, dtype=np.float64)
    return Gravity(up / np.linalg.norm(up), np.deg2rad(_STDDEV_DEG))

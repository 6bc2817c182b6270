"""Derivatives of rotations by rotation vectors."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from rangesfm.arrays import Array


def cross_matrices(vectors: Array) -> Array:
    """Return the matrices (..., 3, 3) of the cross product with vectors v (..., 3), so that matrix @ a = v x a."""
    x, y, z = np.moveaxis(vectors, -1, 0)
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(*vectors.shape, 3)


def left_jacobian(rotation: Rotation) -> Array:
    """Return the left Jacobian J (3, 3) of a rotation Exp(w): d Exp(w) = [J dw]x Exp(w).

    Source: Solà et al., "A micro Lie theory for state estimation in robotics", eq. 145.
    """
    vector = rotation.as_rotvec()
    angle, cross = float(np.linalg.norm(vector)), cross_matrices(vector)
    if angle < 1e-4:
        series: Array = np.eye(3) + cross / 2 + cross @ cross / 6
        return series
    first, second = (1 - np.cos(angle)) / angle**2, (angle - np.sin(angle)) / angle**3
    closed: Array = np.eye(3) + first * cross + second * cross @ cross
    return closed

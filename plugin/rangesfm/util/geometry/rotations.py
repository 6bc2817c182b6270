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


def left_jacobians(vectors: Array) -> Array:
    """Return the left Jacobians J (..., 3, 3) of rotations Exp(w) by vectors w (..., 3): d Exp(w) = [J dw]x Exp(w).

    Those by which Exp(w) is turned in its own frame, the right ones, are those of -w. Source: Solà et al., "A micro Lie
    theory for state estimation in robotics", eq. 143 to 145.
    """
    angle, cross = np.linalg.norm(vectors, axis=-1)[..., None, None], cross_matrices(vectors)
    is_small, of = angle < 1e-4, np.maximum(angle, 1e-4)
    first = np.where(is_small, 1 / 2, (1 - np.cos(of)) / of**2)
    second = np.where(is_small, 1 / 6, (of - np.sin(of)) / of**3)
    return np.asarray(np.eye(3) + first * cross + second * cross @ cross)


def exponentials(vectors: Array) -> Array:
    """Return the (k, 3, 3) rotations by vectors (k, 3)."""
    return np.asarray(Rotation.from_rotvec(vectors).as_matrix())


def logarithms(rotations: Array) -> Array:
    """Return the (k, 3) vectors of rotations (k, 3, 3)."""
    return np.asarray(Rotation.from_matrix(rotations).as_rotvec())

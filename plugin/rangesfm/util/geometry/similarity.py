"""Similarity transformations between point sets, and the shape of a path."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rangesfm.arrays import Array, Mask
from rangesfm.util.geometry.numerics import ROUNDING
from rangesfm.util.geometry.rotations import cross_matrices

# Points are on a line if their second largest extent is at most this share of the largest.
_COLLINEAR = 0.02


@dataclass(frozen=True)
class Similarity:
    """Similarity ``x_new = scale * rotation @ x_old + translation``; variables of this type are named new_from_old."""

    scale: float
    rotation: Array
    translation: Array

    def __matmul__(self, inner: Similarity) -> Similarity:
        """Compose two transformations: ``a_from_b @ b_from_c`` is ``a_from_c``."""
        return Similarity(self.scale * inner.scale, self.rotation @ inner.rotation, self.apply(inner.translation))

    def apply(self, points: Array) -> Array:
        """Map points of shape (..., 3)."""
        mapped: Array = self.scale * points @ self.rotation.T + self.translation
        return mapped

    def inverse(self) -> Similarity:
        rotation = self.rotation.T
        return Similarity(1.0 / self.scale, rotation, -(rotation @ self.translation) / self.scale)


def overflow_raised() -> np.errstate:
    """Return a context in which overflow, division by zero and invalid operations raise FloatingPointError."""
    return np.errstate(over="raise", invalid="raise", divide="raise")


IDENTITY = Similarity(1.0, np.eye(3), np.zeros(3))

# A camera counts as being at the origin up to this fraction of the path's extent. Rounding stays below it even if the
# world in which the path was computed was far from its own origin.
_AT_ORIGIN = 1e-6
# Every unit vector has a coordinate above this size, which is far enough from 0 for its sign to be stable.
_OF_SOME_SIZE = 0.3


def rounding_of(coordinates: Array) -> float:
    """Return the largest length that may be mere rounding of coordinates (n, 3), in their unit."""
    return ROUNDING * (1.0 + float(np.abs(coordinates).max(initial=0.0)))


def are_apart(points: Array) -> bool:
    """Return whether points (n, 3) differ by more than rounding, so that they are not all one place."""
    return bool(np.ptp(points, axis=0).max() > rounding_of(points))


def off_origin(centers: Array) -> Mask:
    """Return which cameras of a path are not at the origin (n,), where a change of scale would not move them."""
    distance = np.linalg.norm(centers, axis=1)
    is_off: Mask = distance > max(_AT_ORIGIN * float(distance.max(initial=0.0)), rounding_of(centers))
    return is_off


def align_points(source: Array, target: Array, *, with_scale: bool = True, weights: Array | float = 1.0) -> Similarity:
    """Return the similarity (or rigid motion) target_from_source with the least squared error.

    Source: Umeyama, "Least-squares estimation of transformation parameters between two point patterns", PAMI 1991.
    A reflection is never returned.

    Args:
        source, target: (n, 3) corresponding points, n >= 3 for a unique answer.
        with_scale: False keeps the scale at 1. The scale is also 1 if all source points are in one place.
        weights: (n,) of the squared errors, or one number for all.
    """
    w = np.broadcast_to(weights, len(source))
    w = w / w.sum()
    mean_source, mean_target = w @ source, w @ target
    centered_source, centered_target = source - mean_source, target - mean_target
    u, singular_values, vt = np.linalg.svd((centered_target * w[:, None]).T @ centered_source)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt))])
    rotation = (u * signs) @ vt
    variance = float(w @ np.sum(centered_source**2, axis=1))
    has_scale = with_scale and variance > rounding_of(source) ** 2
    scale = float(singular_values @ signs) / variance if has_scale else 1.0
    return Similarity(scale, rotation, mean_target - scale * rotation @ mean_source)


def similarity_motions(from_middle: Array) -> Array:
    """Return the derivatives (n, 3, 7) of points (n, 3) by a similarity about the origin.

    The 7 columns are the logarithm of the scale, a rotation vector (radians) and a translation.
    """
    shifts = np.tile(np.eye(3), (len(from_middle), 1, 1))
    return np.concatenate([from_middle[:, :, None], -cross_matrices(from_middle), shifts], axis=2)


def similarity_between(source: Array, target: Array) -> Similarity | None:
    """Return ``align_points(source, target)``, or None if the scale is undetermined.

    That is so if the points of one set are all in one place, or the two sets have nothing in common.
    """
    if not (are_apart(source) and are_apart(target)):
        return None
    found = align_points(source, target)
    extents = [float(np.linalg.norm(points.std(axis=0))) for points in (source, target)]
    return found if found.scale * extents[0] > ROUNDING * extents[1] else None


def rmse(differences: Array) -> float:
    """Return the root mean square length of differences (n, 3); NaN if there are none."""
    return float(np.sqrt(np.mean(np.sum(differences**2, axis=1)))) if len(differences) else float("nan")


@dataclass(frozen=True)
class PathShape:
    """Principal axes and extents of a set of points.

    Attributes:
        centroid: (..., 3) mean of the points.
        axes: (..., 3, 3) whose columns are the principal directions, longest first, with signs by ``oriented``.
        stddevs: (..., 3) standard deviations along them, in the unit of the points.
    """

    centroid: Array
    axes: Array
    stddevs: Array

    @property
    def is_line(self) -> bool:
        """Whether one set of points leaves a turn about its line open."""
        return bool(self.stddevs[1] <= _COLLINEAR * self.stddevs[0])


def path_shape(points: Array) -> PathShape:
    """Compute the principal axes and extents of points (..., n, 3)."""
    centroid, num = points.mean(axis=-2), points.shape[-2]
    _, singular_values, vt = np.linalg.svd(points - centroid[..., None, :], full_matrices=num < 3)
    stddevs = np.zeros_like(centroid)
    stddevs[..., : singular_values.shape[-1]] = singular_values / np.sqrt(num)
    return PathShape(centroid, oriented(vt.swapaxes(-1, -2)), stddevs)


def oriented(axes: Array) -> Array:
    """Fix the signs of unit vectors, the columns of (..., 3, k), which a decomposition leaves open.

    The last coordinate that is clearly not 0 becomes positive.
    """
    last = 2 - np.argmax(np.abs(axes[..., ::-1, :]) > _OF_SOME_SIZE, axis=-2, keepdims=True)
    turned: Array = axes * np.sign(np.take_along_axis(axes, last, axis=-2))
    return turned


# Up to these extents across a path, as fractions of the extent along it, the path counts as straight or flat. Ranges
# with noise of about a decimetre hardly see less.
NEARLY_STRAIGHT = 0.03
NEARLY_FLAT = 0.05
# A path counts as round up to this RMS difference of the distance from the fitted centre, in radii, and up to this
# radius, in units of the path's extent. A short arc lies near many circles, and does not count as round.
_ROUND = 0.02
_MAX_RADIUS = 2.0


def path_kind(points: Array) -> str:
    """Return the symmetry of points (n, 3), n >= 1, which leaves positions found from ranges ambiguous.

    It is "straight", "circular" (and flat), "flat", "spherical" or "general".
    """
    shape = path_shape(points)
    if shape.stddevs[1] <= NEARLY_STRAIGHT * shape.stddevs[0]:
        return "straight"
    is_flat = bool(shape.stddevs[2] < NEARLY_FLAT * shape.stddevs[0])
    middle, radius = round_middle(points)
    off = np.linalg.norm(points - middle, axis=1) - radius
    is_round = bool(rmse(off[:, None]) < _ROUND * radius and radius < _MAX_RADIUS * shape.stddevs[0])
    if is_flat:
        return "circular" if is_round else "flat"
    return "spherical" if is_round else "general"


def round_middle(points: Array) -> tuple[Array, float]:
    """Return the centre (3,) and radius of the sphere that fits points (n, 3), or of the circle if they are flat."""
    shape = path_shape(points)
    local = (points - shape.centroid) @ shape.axes
    seen = shape.stddevs > 0.02 * shape.stddevs[0]
    design = np.column_stack([2 * local[:, seen], np.ones(len(local))])
    solution = np.linalg.lstsq(design, np.sum(local**2, axis=1), rcond=None)[0]
    middle = shape.centroid + shape.axes[:, seen] @ solution[:-1]
    return middle, float(np.sqrt(max(solution[-1] + solution[:-1] @ solution[:-1], 0.0)))

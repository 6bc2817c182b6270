"""Similarities between point sets, and the shape of a path."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rangesfm.arrays import Array, Mask
from rangesfm.geometry.rotations import cross_matrices


@dataclass(frozen=True)
class Similarity:
    """``x_new = scale * rotation @ x_old + translation``; named new_from_old where it is used."""

    scale: float
    rotation: Array
    translation: Array

    def __matmul__(self, inner: Similarity) -> Similarity:
        """``(a_from_b @ b_from_c)`` is ``a_from_c``."""
        return Similarity(self.scale * inner.scale, self.rotation @ inner.rotation, self.apply(inner.translation))

    def apply(self, points: Array) -> Array:
        """Map points of shape (..., 3)."""
        mapped: Array = self.scale * points @ self.rotation.T + self.translation
        return mapped

    def inverse(self) -> Similarity:
        rotation = self.rotation.T
        return Similarity(1.0 / self.scale, rotation, -(rotation @ self.translation) / self.scale)


def overflow_raised() -> np.errstate:
    """Within it, numbers that run over, and infinite ones that cancel, raise FloatingPointError."""
    return np.errstate(over="raise", invalid="raise", divide="raise")


IDENTITY = Similarity(1.0, np.eye(3), np.zeros(3))

# Of coordinates, or of their unit where they are smaller: what some operations on numbers of sixteen digits may leave.
_ROUNDING = 1e-12
# Of the extent of a path: nearer to the origin is only a camera that stands there, however far from its own origin the
# world was in which the path was computed.
_AT_ORIGIN = 1e-6
# In medians of what all points are off, and how often they are looked at anew.
_FAR_OFF = 5.0
_NUM_TRIMMINGS = 5
# Of a unit vector, which has one coordinate that is larger: far enough from 0 for its sign to be no accident.
_OF_SOME_SIZE = 0.3


def rounding_of(coordinates: Array) -> float:
    """A length that may be nothing but the rounding of (n, 3) coordinates: what is decided by a length needs more."""
    return _ROUNDING * (1.0 + float(np.abs(coordinates).max(initial=0.0)))


def are_apart(points: Array) -> bool:
    """Whether (n, 3) points are more than one place, computed again and again."""
    return bool(np.ptp(points, axis=0).max() > rounding_of(points))


def off_origin(centers: Array) -> Mask:
    """(n,) which cameras of a path are elsewhere than at its origin, where no scale moves them."""
    distance = np.linalg.norm(centers, axis=1)
    is_off: Mask = distance > max(_AT_ORIGIN * float(distance.max(initial=0.0)), rounding_of(centers))
    return is_off


def align_points(source: Array, target: Array, *, with_scale: bool = True) -> Similarity:
    """The similarity (or rigid motion) target_from_source with least squared error.

    Umeyama, "Least-squares estimation of transformation parameters between two point
    patterns", PAMI 1991. A reflection is never returned.

    Args:
        source, target: (n, 3) corresponding points, n >= 3 for a unique answer.
        with_scale: False keeps the scale at 1, as do points that are all in one place.
    """
    w = np.ones(len(source)) / len(source)
    mean_source, mean_target = w @ source, w @ target
    centered_source, centered_target = source - mean_source, target - mean_target
    u, singular_values, vt = np.linalg.svd((centered_target * w[:, None]).T @ centered_source)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt))])
    rotation = (u * signs) @ vt
    variance = float(w @ np.sum(centered_source**2, axis=1))
    has_scale = with_scale and variance > rounding_of(source) ** 2
    scale = float(singular_values @ signs) / variance if has_scale else 1.0
    return Similarity(scale, rotation, mean_target - scale * rotation @ mean_source)


def align_most(source: Array, target: Array, start: Similarity) -> Similarity:
    """``align_points`` without the points that lie elsewhere than most: a few that moved on their own have no say.

    ``start``: about how most of the points lie to each other.
    """
    found = start
    for _ in range(_NUM_TRIMMINGS):
        off = np.linalg.norm(found.apply(source) - target, axis=1)
        kept = off <= _FAR_OFF * np.median(off) + rounding_of(target)
        found = align_points(source[kept], target[kept])
    return found


def similarity_motions(from_middle: Array) -> Array:
    """(n, 3, 7) how points (n, 3) move with the logarithm of the scale, a turn (rad) and a shift about the origin."""
    shifts = np.tile(np.eye(3), (len(from_middle), 1, 1))
    return np.concatenate([from_middle[:, :, None], -cross_matrices(from_middle), shifts], axis=2)


def similarity_between(source: Array, target: Array) -> Similarity | None:
    """As ``align_points``; None where it has no scale: one of them is a single place, or they have nothing alike."""
    if not (are_apart(source) and are_apart(target)):
        return None
    found = align_points(source, target)
    extents = [float(np.linalg.norm(points.std(axis=0))) for points in (source, target)]
    return found if found.scale * extents[0] > _ROUNDING * extents[1] else None


def rmse(differences: Array) -> float:
    """Root of the mean squared length of (n, 3) differences; NaN for none."""
    return float(np.sqrt(np.mean(np.sum(differences**2, axis=1)))) if len(differences) else float("nan")


@dataclass(frozen=True)
class PathShape:
    """Principal extents of a set of points.

    Attributes:
        centroid: (..., 3).
        axes: (..., 3, 3), columns are the principal directions, longest first; ``oriented``.
        stddevs: (..., 3) along them, in the unit of the points.
    """

    centroid: Array
    axes: Array
    stddevs: Array


def path_shape(points: Array) -> PathShape:
    """Principal directions of (..., n, 3) points."""
    centroid, num = points.mean(axis=-2), points.shape[-2]
    _, singular_values, vt = np.linalg.svd(points - centroid[..., None, :], full_matrices=num < 3)
    stddevs = np.zeros_like(centroid)
    stddevs[..., : singular_values.shape[-1]] = singular_values / np.sqrt(num)
    return PathShape(centroid, oriented(vt.swapaxes(-1, -2)), stddevs)


def oriented(axes: Array) -> Array:
    """Columns (..., 3, k), each turned so that its last coordinate of some size is positive: no decomposition tells."""
    last = 2 - np.argmax(np.abs(axes[..., ::-1, :]) > _OF_SOME_SIZE, axis=-2, keepdims=True)
    turned: Array = axes * np.sign(np.take_along_axis(axes, last, axis=-2))
    return turned


# Extents of a path across itself, in lengths, that ranges with noise of about a decimetre hardly see.
NEARLY_STRAIGHT = 0.03
NEARLY_FLAT = 0.05
# Stddev of the distance from the fitted centre, in radii, and the largest radius in lengths of the path: a short arc
# lies near many circles and is none.
_ROUND = 0.02
_MAX_RADIUS = 2.0


def path_kind(points: Array) -> str:
    """The symmetries of (n, 3) points, n >= 1, that ranges cannot see past.

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
    """Centre (3,) and radius of the sphere nearest to (n, 3) points; of flat ones, of the circle in their plane."""
    shape = path_shape(points)
    local = (points - shape.centroid) @ shape.axes
    seen = shape.stddevs > 0.02 * shape.stddevs[0]
    design = np.column_stack([2 * local[:, seen], np.ones(len(local))])
    solution = np.linalg.lstsq(design, np.sum(local**2, axis=1), rcond=None)[0]
    middle = shape.centroid + shape.axes[:, seen] @ solution[:-1]
    return middle, float(np.sqrt(max(solution[-1] + solution[:-1] @ solution[:-1], 0.0)))

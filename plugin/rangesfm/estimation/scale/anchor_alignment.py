"""Rigid motions from one metric frame to another through the anchors that both have placed."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from rangesfm.arrays import Array
from rangesfm.errors import GeometryError
from rangesfm.measurements.ranges.scale.starts import MAX_NUM_STARTS, each_once
from rangesfm.util.geometry.numerics import MAX_NUM_ROUNDS, ROUNDING
from rangesfm.util.geometry.robust_statistics import CAUCHY
from rangesfm.util.geometry.rotations import cross_matrices
from rangesfm.util.geometry.similarity import Similarity, align_points, path_shape, rmse

# Triples are tried among this many anchors, the best placed ones. More make it slower without a better result.
_MAX_NUM_TRIED = 8
SAME_SHARE = 0.1
"""Two placements of a path are one if its places are no further apart than this, in extents of the path."""
# An anchor this many standard deviations from its place in the other frame is reported as standing elsewhere.
_ELSEWHERE_STDDEVS = 5.0


@dataclass(frozen=True)
class PlacedAnchor:
    """Position of an anchor in a metric frame, with its uncertainty.

    Attributes:
        places_m: (1, 3) position, or (2, 3) with the mirror image that fits the ranges equally well.
        covariance_m2: (3, 3) covariance of the position.
    """

    places_m: Array
    covariance_m2: Array

    @property
    def variance_m2(self) -> float:
        """Mean variance of a coordinate, in square metres."""
        return float(np.trace(self.covariance_m2)) / 3

    @property
    def rank(self) -> tuple[int, float]:
        """Sort key that puts better placed anchors first: those without a mirror image, then by variance."""
        return len(self.places_m), self.variance_m2

    def moved(self, motion: Similarity) -> PlacedAnchor:
        """Return the anchor carried into another frame by a rigid motion."""
        turned = motion.rotation @ self.covariance_m2 @ motion.rotation.T
        return PlacedAnchor(motion.apply(self.places_m), turned)


@dataclass(frozen=True)
class _Pair:
    """One anchor as both frames have it."""

    target: PlacedAnchor
    source: PlacedAnchor

    @property
    def sides(self) -> list[tuple[int, int]]:
        """All combinations of its places: (index in the target, index in the source)."""
        return list(itertools.product(range(len(self.target.places_m)), range(len(self.source.places_m))))

    @property
    def variance_m2(self) -> float:
        return self.target.variance_m2 + self.source.variance_m2

    def difference(self, motion: Similarity, side: tuple[int, int]) -> Array:
        """Return the (3,) difference of positions, metres: the source's place moved, minus the target's."""
        return np.asarray(motion.apply(self.source.places_m[side[1]]) - self.target.places_m[side[0]])

    def information(self, motion: Similarity) -> Array:
        """Return the (3, 3) inverse covariance of the difference."""
        turned = motion.rotation @ self.source.covariance_m2 @ motion.rotation.T
        return np.asarray(np.linalg.inv(self.target.covariance_m2 + turned), dtype=np.float64)


@dataclass(frozen=True)
class AnchorAlignment:
    """A rigid motion, and how well the anchors fit under it.

    Attributes:
        target_from_source: the motion.
        sides: by anchor id, which of its places in the target and in the source fit better, 0 or 1.
        squared: for each anchor, the squared distance between these two places, in standard deviations.
        elsewhere_m: by id of each anchor that does not fit, how far it is from where it should be.
    """

    target_from_source: Similarity
    sides: dict[str, tuple[int, int]]
    squared: Array
    elsewhere_m: dict[str, float]

    @property
    def cost(self) -> float:
        return 0.5 * float(np.sum(CAUCHY.rho(self.squared)[0]))

    @classmethod
    def by_motion(cls, pairs: Mapping[str, _Pair], motion: Similarity) -> AnchorAlignment:
        sides, squared, elsewhere_m = {}, [], {}
        for id_, pair in pairs.items():
            information = pair.information(motion)
            differences = {side: pair.difference(motion, side) for side in pair.sides}
            distances = {side: float(d @ information @ d) for side, d in differences.items()}
            sides[id_] = side = min(distances, key=distances.__getitem__)
            squared.append(distances[side])
            if distances[side] > _ELSEWHERE_STDDEVS**2:
                elsewhere_m[id_] = float(np.linalg.norm(differences[side]))
        return cls(motion, sides, np.array(squared), elsewhere_m)


def align_by_anchors(
    target: Mapping[str, PlacedAnchor], source: Mapping[str, PlacedAnchor], source_path_m: Array
) -> list[AnchorAlignment]:
    """Find the rigid motions that bring the anchors together, best first.

    Each anchor is weighted by its covariance, with a robust loss. Both frames are right-handed, so three anchors that
    are not on a line determine a motion. Either place of an anchor with a mirror image may be the true one.

    Args:
        target, source: anchors by id.
        source_path_m: (n, 3) places along the path to be carried over; motions that do the same to it count as one.

    Raises:
        GeometryError: the anchors are too few, or on a line.
    """
    pairs = {id_: _Pair(target[id_], source[id_]) for id_ in sorted(set(target) & set(source))}
    _refuse_too_few(pairs)
    return _distinct(pairs, source_path_m)


def _refuse_too_few(pairs: Mapping[str, _Pair]) -> None:
    """Raise GeometryError for shared anchors that leave a turn open: fewer than three, or all on a line."""
    ids, names = list(pairs), ", ".join(pairs)
    if not ids:
        raise GeometryError("it shares no anchor with the others")
    if len(ids) < 3:
        about = f"anchor {names}" if len(ids) == 1 else f"the line through {' and '.join(ids)}"
        raise GeometryError(f"of its anchors only {names} also belong to others: every turn about {about} fits")
    for places_m in ([p.target.places_m for p in pairs.values()], [p.source.places_m for p in pairs.values()]):
        if all(path_shape(np.array(some)).is_line for some in itertools.product(*places_m[:_MAX_NUM_TRIED])):
            raise GeometryError(f"the anchors that it shares ({names}) are on a line: every turn about it fits")


def _distinct(pairs: Mapping[str, _Pair], path_m: Array) -> list[AnchorAlignment]:
    """Return the refined fits that start from triples of anchors, best first, each different motion once."""
    tolerance = SAME_SHARE * float(np.linalg.norm(path_shape(path_m).stddevs))

    def best(fits: Iterable[AnchorAlignment]) -> list[AnchorAlignment]:
        return each_once(sorted(fits, key=lambda fit: fit.cost), are_same, MAX_NUM_STARTS)

    def are_same(first: AnchorAlignment, second: AnchorAlignment) -> bool:
        return rmse(first.target_from_source.apply(path_m) - second.target_from_source.apply(path_m)) <= tolerance

    begun = best(AnchorAlignment.by_motion(pairs, motion) for motion in _triple_motions(pairs.values()))
    return best(_refined(pairs, fit) for fit in begun)


def _triple_motions(pairs: Iterable[_Pair]) -> Iterator[Similarity]:
    tried = sorted(pairs, key=lambda pair: pair.variance_m2)[:_MAX_NUM_TRIED]
    for triple in itertools.combinations(tried, 3):
        for sides in itertools.product(*(pair.sides for pair in triple)):
            source = np.array([pair.source.places_m[side[1]] for pair, side in zip(triple, sides, strict=True)])
            target = np.array([pair.target.places_m[side[0]] for pair, side in zip(triple, sides, strict=True)])
            if not path_shape(source).is_line:
                yield align_points(source, target, with_scale=False)


def _refined(pairs: Mapping[str, _Pair], fit: AnchorAlignment) -> AnchorAlignment:
    """Refine a motion by reweighted Gauss-Newton steps, each anchor at the places that fit better."""
    for _ in range(MAX_NUM_ROUNDS):
        middle = np.mean([fit.target_from_source.apply(pair.source.places_m[0]) for pair in pairs.values()], axis=0)
        normal, right = ROUNDING * np.eye(6), np.zeros(6)
        weights = CAUCHY.rho(fit.squared)[1]
        for (id_, pair), weight in zip(pairs.items(), weights, strict=True):
            side = fit.sides[id_]
            weighted = weight * pair.information(fit.target_from_source)
            difference = pair.difference(fit.target_from_source, side)
            place = difference + pair.target.places_m[side[0]] - middle
            jacobian = np.hstack([-cross_matrices(place), np.eye(3)])  # by a small turn and a shift of the source
            normal = normal + jacobian.T @ weighted @ jacobian
            right = right - jacobian.T @ weighted @ difference
        step = np.linalg.solve(normal, right)
        turn = Similarity(1.0, Rotation.from_rotvec(step[:3]).as_matrix(), np.zeros(3))
        shift = middle + step[3:] - turn.rotation @ middle
        better = AnchorAlignment.by_motion(pairs, replace(turn, translation=shift) @ fit.target_from_source)
        if not better.cost < fit.cost:
            break
        fit = better
    return fit

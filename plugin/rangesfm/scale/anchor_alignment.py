"""Rigid motions from one metric frame to another through the anchors that both have placed."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from rangesfm.arrays import Array
from rangesfm.errors import GeometryError
from rangesfm.geometry.rotations import cross_matrices
from rangesfm.geometry.similarity import Similarity, align_points, path_shape, rmse
from rangesfm.ranging.errors.robust_loss import CAUCHY
from rangesfm.scale.anchor_plane import is_line

# Anchors of which triples are tried, the best placed ones: more make it slow, and no better.
_MAX_NUM_TRIED = 8
_NUM_ROUNDS = 30
_NUM_BEST = 6
# A motion that costs so much more than the best is none to consider.
_MAX_COST_GAP = 50.0
# Two motions that carry the path's places no further apart than this, in extents of the path, are one.
_SAME_SHARE = 0.1
# Distances in stddevs from which an anchor does not stand where it stood.
_ELSEWHERE_STDDEVS = 5.0


@dataclass(frozen=True)
class PlacedAnchor:
    """Where an anchor is in a metric frame.

    Attributes:
        places_m: (1, 3), or (2, 3) with the mirror image that fits its ranges as well.
        covariance_m2: (3, 3).
    """

    places_m: Array
    covariance_m2: Array

    @property
    def variance_m2(self) -> float:
        """Of each coordinate, on average."""
        return float(np.trace(self.covariance_m2)) / 3

    def moved(self, motion: Similarity) -> PlacedAnchor:
        """The same in another frame."""
        turned = motion.rotation @ self.covariance_m2 @ motion.rotation.T
        return PlacedAnchor(motion.apply(self.places_m), turned)

    def at(self, side: int) -> PlacedAnchor:
        """At one of its places only."""
        return replace(self, places_m=self.places_m[side : side + 1])


@dataclass(frozen=True)
class AnchorAlignment:
    """A motion, and what it makes of the anchors.

    Attributes:
        target_from_source: rigid.
        sides: by anchor id, which of its places in the target and in the source fit, 0 or 1.
        elsewhere_m: by id, of anchors that do not fit, how far they are from where they should be.
    """

    target_from_source: Similarity
    sides: dict[str, tuple[int, int]]
    elsewhere_m: dict[str, float]


def align_by_anchors(
    target: Mapping[str, PlacedAnchor], source: Mapping[str, PlacedAnchor], source_path_m: Array
) -> list[AnchorAlignment]:
    """Find the motions that bring the anchors together, best first: robust, weighted by their covariances.

    Both frames are right-handed, so that three anchors not on a line are enough; of an anchor with a mirror image
    either place may be the true one.

    Args:
        target, source: anchors by id.
        source_path_m: (n, 3) places along the path that is to be carried over: motions that do the same to it are one.

    Raises:
        GeometryError: the anchors are too few, or on a line.
    """
    ids = sorted(set(target) & set(source))
    pairs = [_Pair(target[id_], source[id_]) for id_ in ids]
    _refuse_too_few(ids, pairs)
    fits = _distinct(pairs, source_path_m)
    return [_alignment(ids, pairs, fit) for fit in fits if fit.cost - fits[0].cost < _MAX_COST_GAP]


def _alignment(ids: Sequence[str], pairs: Sequence[_Pair], fit: _Fit) -> AnchorAlignment:
    elsewhere_m = {
        id_: float(np.linalg.norm(pair.difference(fit.motion, side)))
        for id_, pair, side, squared in zip(ids, pairs, fit.sides, fit.squared, strict=True)
        if squared > _ELSEWHERE_STDDEVS**2
    }
    return AnchorAlignment(fit.motion, dict(zip(ids, fit.sides, strict=True)), elsewhere_m)


@dataclass(frozen=True)
class _Pair:
    """One anchor in both frames."""

    target: PlacedAnchor
    source: PlacedAnchor

    @property
    def sides(self) -> list[tuple[int, int]]:
        """All combinations of its places."""
        return list(itertools.product(range(len(self.target.places_m)), range(len(self.source.places_m))))

    @property
    def variance_m2(self) -> float:
        return self.target.variance_m2 + self.source.variance_m2

    def difference(self, motion: Similarity, side: tuple[int, int]) -> Array:
        """(3,) source moved minus target."""
        return np.asarray(motion.apply(self.source.places_m[side[1]]) - self.target.places_m[side[0]])

    def information(self, motion: Similarity) -> Array:
        """(3, 3) of the difference."""
        turned = motion.rotation @ self.source.covariance_m2 @ motion.rotation.T
        return np.asarray(np.linalg.inv(self.target.covariance_m2 + turned), dtype=np.float64)


@dataclass(frozen=True)
class _Fit:
    """A motion, for each anchor the places that it brings together best, and their squared distance in stddevs."""

    motion: Similarity
    sides: tuple[tuple[int, int], ...]
    squared: Array

    @property
    def cost(self) -> float:
        return 0.5 * float(np.sum(CAUCHY.rho(self.squared)[0]))

    @classmethod
    def of(cls, pairs: Sequence[_Pair], motion: Similarity) -> _Fit:
        sides, squared = [], []
        for pair in pairs:
            information = pair.information(motion)
            differences = {side: pair.difference(motion, side) for side in pair.sides}
            distances = {side: float(d @ information @ d) for side, d in differences.items()}
            sides.append(min(distances, key=distances.__getitem__))
            squared.append(distances[sides[-1]])
        return cls(motion, tuple(sides), np.array(squared))


def _refuse_too_few(ids: Sequence[str], pairs: Sequence[_Pair]) -> None:
    """Of two anchors or of a line nothing fixes the turn, whatever their sides."""
    names = ", ".join(ids)
    if not ids:
        raise GeometryError("it shares no anchor with the others")
    if len(ids) < 3:
        about = f"anchor {names}" if len(ids) == 1 else f"the line through {' and '.join(ids)}"
        raise GeometryError(f"of its anchors only {names} also belong to others: every turn about {about} fits")
    for places_m in ([pair.target.places_m for pair in pairs], [pair.source.places_m for pair in pairs]):
        if all(is_line(path_shape(np.array(some))) for some in itertools.product(*places_m[:_MAX_NUM_TRIED])):
            raise GeometryError(f"the anchors that it shares ({names}) are on a line: every turn about it fits")


def _distinct(pairs: Sequence[_Pair], path_m: Array) -> list[_Fit]:
    """Refined fits from triples of anchors, best first, each once."""
    tolerance = _SAME_SHARE * float(np.linalg.norm(path_shape(path_m).stddevs))

    def differ(first: _Fit, second: _Fit) -> bool:
        return rmse(first.motion.apply(path_m) - second.motion.apply(path_m)) > tolerance

    starts = sorted((_Fit.of(pairs, motion) for motion in _triple_motions(pairs)), key=lambda fit: fit.cost)
    begun = _each_once(starts, differ)[:_NUM_BEST]
    return _each_once(sorted((_refined(pairs, fit) for fit in begun), key=lambda fit: fit.cost), differ)


def _each_once(fits: Sequence[_Fit], differ: Callable[[_Fit, _Fit], bool]) -> list[_Fit]:
    kept: list[_Fit] = []
    for fit in fits:
        if len(kept) < 2 * _NUM_BEST and all(differ(fit, other) for other in kept):
            kept.append(fit)
    return kept


def _triple_motions(pairs: Sequence[_Pair]) -> Iterator[Similarity]:
    tried = sorted(pairs, key=lambda pair: pair.variance_m2)[:_MAX_NUM_TRIED]
    for triple in itertools.combinations(tried, 3):
        for sides in itertools.product(*(pair.sides for pair in triple)):
            source = np.array([pair.source.places_m[side[1]] for pair, side in zip(triple, sides, strict=True)])
            target = np.array([pair.target.places_m[side[0]] for pair, side in zip(triple, sides, strict=True)])
            if not is_line(path_shape(source)):
                yield align_points(source, target, with_scale=False)


def _refined(pairs: Sequence[_Pair], fit: _Fit) -> _Fit:
    """Reweighted Gauss-Newton steps, each anchor at the places that fit better."""
    for _ in range(_NUM_ROUNDS):
        middle = np.mean([fit.motion.apply(pair.source.places_m[0]) for pair in pairs], axis=0)
        normal, right = 1e-12 * np.eye(6), np.zeros(6)
        weights = CAUCHY.rho(fit.squared)[1]
        for pair, side, weight in zip(pairs, fit.sides, weights, strict=True):
            weighted = weight * pair.information(fit.motion)
            difference = pair.difference(fit.motion, side)
            place = difference + pair.target.places_m[side[0]] - middle
            jacobian = np.hstack([-cross_matrices(place), np.eye(3)])  # by a small turn and a shift
            normal = normal + jacobian.T @ weighted @ jacobian
            right = right - jacobian.T @ weighted @ difference
        step = np.linalg.solve(normal, right)
        turn = Similarity(1.0, Rotation.from_rotvec(step[:3]).as_matrix(), np.zeros(3))
        shift = middle + step[3:] - turn.rotation @ middle
        better = _Fit.of(pairs, replace(turn, translation=shift) @ fit.motion)
        if not better.cost < fit.cost:
            break
        fit = better
    return fit

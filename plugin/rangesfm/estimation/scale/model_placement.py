"""Joining of rigid pieces of a map, each scaled on its own, in one metric world with one set of anchors.

A piece is in the site already, or rigid motions bring its anchors to those of the pieces before. The ranges of all
pieces are fitted from each of these places, and decide. What else than ranges has placed in the site stays there.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy.spatial.transform import Rotation

from rangesfm.arrays import Array, Indices
from rangesfm.errors import GeometryError
from rangesfm.estimation.scale.scale_estimate import ScaleEstimate
from rangesfm.measurements.ranges.anchors.anchor import AnchorEstimate
from rangesfm.measurements.ranges.anchors.point_fit import ENOUGH_TO_SEARCH
from rangesfm.measurements.ranges.scale.range_equation import RangeFit, RangeProblem, RangeState, solve
from rangesfm.measurements.ranges.scale.starts import MAX_NUM_STARTS, each_once, spread_subset
from rangesfm.util.geometry.numerics import MAX_NUM_ROUNDS, ROUNDING
from rangesfm.util.geometry.robust_statistics import CAUCHY, MIN_COST_GAP, wider
from rangesfm.util.geometry.similarity import IDENTITY, Similarity, align_points, path_shape, rmse, similarity_motions
from rangesfm.util.geometry.trajectory import Trajectory

# Triples are tried among this many anchors, the best placed ones. More make it slower without a better result.
_MAX_NUM_TRIED = 8
# Two placements of a path are one if its places are no further apart than this, in extents of the path.
_SAME_SHARE = 0.1
# A piece counts as not placed if its path's places have a larger standard deviation than this, in extents of the path.
_MAX_OPEN = 0.25
# An anchor this many standard deviations from its place in the other frame is reported as standing elsewhere.
_ELSEWHERE_STDDEVS = 5.0
# Smallest standard deviation of an anchor's position: antennas err by as much, whatever the ranges say.
_MIN_STDDEV_M = 0.02


@dataclass(frozen=True)
class AnchorAlignment:
    """A rigid motion of one frame into another, and how s anchors with places in both fit under it.

    Attributes:
        ids: of the anchors.
        target_from_source: the motion.
        target_m, source_m: (s, 2, 3) places in each frame, the second one NaN if it is not a mirror image's.
        target_m2, source_m2: (s, 3, 3) covariances of the places.
    """

    ids: tuple[str, ...]
    target_from_source: Similarity
    target_m: Array
    source_m: Array
    target_m2: Array
    source_m2: Array

    @cached_property
    def _apart_m(self) -> Array:
        """(s, 4, 3) the source's places moved, minus the target's, for the four pairs of sides."""
        moved_m = self.target_from_source.apply(self.source_m)
        return np.asarray((moved_m[:, None] - self.target_m[:, :, None]).reshape(-1, 4, 3))

    @cached_property
    def _information(self) -> Array:
        """(s, 3, 3) inverse covariances of these differences."""
        turn = self.target_from_source.rotation
        return np.asarray(np.linalg.inv(self.target_m2 + turn @ self.source_m2 @ turn.T))

    @cached_property
    def _squared(self) -> Array:
        """(s, 4) their squared lengths, in standard deviations; inf without such places."""
        squared = np.einsum("spi,sij,spj->sp", self._apart_m, self._information, self._apart_m)
        return np.where(np.isnan(squared), np.inf, squared)

    @cached_property
    def _pairs(self) -> Indices:
        """(s,) which of the four pairs of sides fits best."""
        return np.asarray(self._squared.argmin(axis=1))

    @property
    def sides(self) -> tuple[Indices, Indices]:
        """(s,) and (s,) which of the places in the target and in the source fit better, 0 or 1."""
        return self._pairs // 2, self._pairs % 2

    @property
    def elsewhere_m(self) -> dict[str, float]:
        """By id of each anchor that does not fit, how far it is from where it should be."""
        far, lengths = self._squared.min(axis=1) > _ELSEWHERE_STDDEVS**2, np.linalg.norm(self._apart_m, axis=2)
        return {self.ids[row]: float(lengths[row, self._pairs[row]]) for row in np.flatnonzero(far)}

    @property
    def cost(self) -> float:
        return 0.5 * float(np.sum(CAUCHY.rho(self._squared.min(axis=1))[0]))

    def refined(self) -> AnchorAlignment:
        """Return the best motion near this one, by reweighted Gauss-Newton steps, anchors where they fit better."""
        found = self
        for _ in range(MAX_NUM_ROUNDS):
            best, rows, motion = found._pairs, np.arange(len(found.ids)), found.target_from_source
            weighted = CAUCHY.rho(found._squared[rows, best])[1][:, None, None] * found._information
            moved_m = motion.apply(found.source_m[rows, found.sides[1]])
            middle = moved_m.mean(axis=0)
            by_step = similarity_motions(moved_m - middle)[:, :, 1:]
            normal = np.einsum("sia,sij,sjb->ab", by_step, weighted, by_step) + ROUNDING * np.eye(6)
            right = np.einsum("sia,sij,sj->a", by_step, weighted, found._apart_m[rows, best])
            step = -np.linalg.solve(normal, right)
            turn = Rotation.from_rotvec(step[:3]).as_matrix()
            moved = Similarity(1.0, turn, middle + step[3:] - turn @ middle) @ motion
            better = replace(found, target_from_source=moved)
            if not better.cost < found.cost:
                break
            found = better
        return found


def align_by_anchors(
    target: Mapping[str, AnchorEstimate], source: Mapping[str, AnchorEstimate], source_path_m: Array
) -> list[AnchorAlignment]:
    """Find the rigid motions that bring the anchors together, best first.

    Each anchor is weighted by its covariance, with a robust loss. Both frames are right-handed, so three anchors that
    are not on a line determine a motion. Either place of an anchor with a mirror image may be the true one.

    Args:
        target, source: anchors by id, which have places.
        source_path_m: (n, 3) places along the path to be carried over; motions that do the same to it count as one.

    Raises:
        GeometryError: the anchors are too few, or on a line.
    """
    ids = tuple(sorted(target.keys() & source.keys()))
    both = [[of[id_] for id_ in ids] for of in (target, source)]
    _refuse_too_few(ids, both)
    places_m = [np.array([(*_places_m(each), np.full(3, np.nan))[:2] for each in anchors]) for anchors in both]
    covariances_m2 = [np.array([_covariance_m2(each) for each in anchors]) for anchors in both]
    tolerance = _SAME_SHARE * float(np.linalg.norm(path_shape(source_path_m).stddevs))

    def are_same(one: AnchorAlignment, other: AnchorAlignment) -> bool:
        places_m = [each.target_from_source.apply(source_path_m) for each in (one, other)]
        return rmse(places_m[0] - places_m[1]) <= tolerance

    def best(fits: Iterable[AnchorAlignment]) -> list[AnchorAlignment]:
        return each_once(sorted(fits, key=lambda fit: fit.cost), are_same, MAX_NUM_STARTS)

    start = AnchorAlignment(ids, IDENTITY, *places_m, *covariances_m2)
    begun = best(replace(start, target_from_source=motion) for motion in _triple_motions(*both))
    return best(fit.refined() for fit in begun)


def _places_m(anchor: AnchorEstimate) -> list[Array]:
    """Return where an anchor stands, and where its mirror image does if it has one."""
    return [anchor.position_m, *([] if anchor.mirror_position_m is None else [anchor.mirror_position_m])]


def _covariance_m2(anchor: AnchorEstimate) -> Array:
    """Return the covariance (3, 3) of an anchor's place."""
    return np.asarray(_MIN_STDDEV_M**2 * np.eye(3) + anchor.position_covariance_m2)


def _rank(anchor: AnchorEstimate) -> tuple[int, float]:
    """Return a key that sorts better placed anchors first: those without a mirror image, then by variance."""
    return len(_places_m(anchor)), float(np.trace(_covariance_m2(anchor)))


def _refuse_too_few(ids: Sequence[str], both: Sequence[Sequence[AnchorEstimate]]) -> None:
    """Raise GeometryError for shared anchors that leave a turn open: fewer than three, or all on a line."""
    names = ", ".join(ids)
    if not ids:
        raise GeometryError("it shares no anchor with the others")
    if len(ids) < 3:
        about = f"anchor {names}" if len(ids) == 1 else f"the line through {' and '.join(ids)}"
        raise GeometryError(f"of its anchors only {names} also belong to others: every turn about {about} fits")
    for anchors in both:
        places_m = [_places_m(anchor) for anchor in anchors[:_MAX_NUM_TRIED]]
        if all(path_shape(np.array(some)).is_line for some in itertools.product(*places_m)):
            raise GeometryError(f"the anchors that it shares ({names}) are on a line: every turn about it fits")


def _triple_motions(target: Sequence[AnchorEstimate], source: Sequence[AnchorEstimate]) -> Iterator[Similarity]:
    """Yield the motions that bring three anchors together, of the best placed ones."""
    pairs = zip(target, source, strict=True)
    tried = sorted(pairs, key=lambda pair: sum(float(np.trace(_covariance_m2(each))) for each in pair))
    for triple in itertools.combinations(tried[:_MAX_NUM_TRIED], 3):
        targets_m, sources_m = (itertools.product(*map(_places_m, anchors)) for anchors in zip(*triple, strict=True))
        for target_m, source_m in itertools.product(map(np.array, targets_m), map(np.array, sources_m)):
            if not path_shape(source_m).is_line:
                yield align_points(source_m, target_m, with_scale=False)


@dataclass(frozen=True)
class Piece:
    """A rigid model with the scale estimate from its own measurements.

    Attributes:
        trajectory: of the unscaled model.
        estimate: of its scale, in a frame of its own or in that of given positions.
        in_site: whether it is in the frame of given positions.
        metric_from_sfm: where it is placed, first as by the estimate.
        elsewhere_m: how far anchors are from where other pieces have them, by id of those that do not fit; they are
            none in common with these.
    """

    trajectory: Trajectory
    estimate: ScaleEstimate
    in_site: bool
    metric_from_sfm: Similarity
    elsewhere_m: Mapping[str, float] = field(default_factory=dict)

    @property
    def is_placed(self) -> bool:
        """Whether it has its place in the site by more than ranges."""
        by_others = any(each.is_used and each.places_map and not each.is_solved for each in self.estimate.on_map.kinds)
        return self.in_site and (by_others or self.estimate.frame == "first_camera")

    @property
    def path_m(self) -> Array:
        """(n, 3) places along the path."""
        return self.metric_from_sfm.apply(self.trajectory.centers)

    @property
    def anchors(self) -> dict[str, AnchorEstimate]:
        """Estimates of the anchors in common that have a place, by id."""
        moved = replace(self.metric_from_sfm @ self.estimate.metric_from_sfm.inverse(), scale=1.0)
        own = (each for each in self.estimate.ranges.anchors if each.anchor_id not in self.elsewhere_m)
        return {each.anchor_id: each.moved(moved) for each in own if np.isfinite(each.position_m).all()}

    def problem(self, anchors: Sequence[AnchorEstimate], *, frame_is_free: bool) -> RangeProblem:
        """Return the problem of the ranges that its estimate used, in the model's unit, with its weights.

        Errors are correlated by different amounts in different models, while the priors are common to all. So the
        ranges get less weight here; in a problem of one model, the priors get more instead.

        Args:
            anchors: of the log, with the priors that are common to all pieces.
        """
        observations, log = self.estimate.ranges.observations, self.estimate.ranges.observations.log
        is_in_common = np.array([each not in self.elsewhere_m for each in log.anchor_ids], dtype=bool)[log.anchor_index]
        is_used = observations.has_place & np.isfinite(self.estimate.ranges.errors.stddev_m) & is_in_common
        rows, no_place = np.flatnonzero(is_used), np.full(3, np.nan)
        errors = self.estimate.ranges.errors.subset(rows)
        return RangeProblem(
            centers=observations.centers[rows],
            tag_from_center=observations.tag_from_center[rows],
            anchor_index=log.anchor_index[rows],
            range_m=log.range_m[rows],
            stddev_m=errors.stddev_m,
            share=errors.worth,
            anchor_mean_m=np.array([no_place if a.prior_position_m is None else a.prior_position_m for a in anchors]),
            anchor_stddev_m=np.array([anchor.prior_position_stddev_m for anchor in anchors]),
            bias_mean_m=np.array([anchor.prior_bias_m for anchor in anchors]),
            bias_stddev_m=np.array([anchor.prior_bias_stddev_m for anchor in anchors]),
            common_bias_stddev_m=errors.common_bias_stddev_m,
            frame_is_free=frame_is_free,
        )


def place_pieces(pieces: Mapping[int, Piece]) -> tuple[dict[int, Similarity], dict[int, str], list[str]]:
    """Place each piece that the measurements determine in the world of the first, directly or through other pieces.

    Every piece has a scale and a place of its own; all share one set of anchors. Where the anchors alone allow several
    places for a piece, the ranges of all pieces decide; if they cannot, the piece is left out. Each range keeps the
    weight that it has in its piece alone.

    Args:
        pieces: by number.

    Returns:
        By number, the place of each piece in the unscaled world of the first; by number of each piece that has none,
        why; and what does not fit.
    """
    first, waiting, num_before = next(iter(pieces)), dict(pieces), len(pieces)
    world = {first: waiting.pop(first)}
    while len(waiting) < num_before:
        num_before, reasons = len(waiting), dict[int, str]()
        for k, piece in tuple(waiting.items()):
            try:
                joined = _joined(list(world.values()), piece)
            except GeometryError as error:
                reasons[k] = str(error)
            else:
                del waiting[k]
                world = dict(zip((*world, k), joined, strict=True))
    placed = [*world.values()]
    if len(placed) > 1 and not all(piece.is_placed for piece in placed):
        placed = _fitted(_fit(placed, _positions_m(_best_placed(placed)), None), placed)
    into_first = placed[0].metric_from_sfm.inverse()
    notes = [
        f"anchor {id_} is {off_m:.2g} m elsewhere by another model"
        for piece in placed
        for id_, off_m in piece.elsewhere_m.items()
    ]
    first_from_sfm = [into_first @ piece.metric_from_sfm for piece in placed]
    return dict(zip(world, first_from_sfm, strict=True)), reasons, notes


def _fitted(fit: RangeFit, pieces: Sequence[Piece]) -> list[Piece]:
    """Return the pieces where a fit has them."""
    return [replace(piece, metric_from_sfm=at) for piece, at in zip(pieces, fit.state.similarities, strict=True)]


def _best_placed(pieces: Sequence[Piece]) -> dict[str, AnchorEstimate]:
    """Return each anchor as that piece has it by which it is placed best."""
    ranked = sorted((anchor for piece in pieces for anchor in piece.anchors.values()), key=_rank, reverse=True)
    return {anchor.anchor_id: anchor for anchor in ranked}


def _positions_m(anchors: Mapping[str, AnchorEstimate]) -> dict[str, Array]:
    return {id_: anchor.position_m for id_, anchor in anchors.items()}


def _joined(world: Sequence[Piece], piece: Piece) -> list[Piece]:
    """Return the pieces placed so far and one more, where the ranges of all have them.

    Raises:
        GeometryError: the place of the piece is not determined.
    """
    if all(each.is_placed for each in (*world, piece)):
        return [*world, piece]
    known, starts = _best_placed(world), [(piece, dict[str, Array]())]
    if not (world[0].in_site and piece.in_site):
        found = align_by_anchors(known, piece.anchors, piece.path_m)
        piece, starts = replace(piece, elsewhere_m=found[0].elsewhere_m), []
        for each in found:
            sides = zip(each.ids, each.target_m, each.sides[0], strict=True)
            moved = replace(piece, metric_from_sfm=each.target_from_source @ piece.metric_from_sfm)
            starts.append((moved, {id_: places_m[side] for id_, places_m, side in sides}))
    fits = []
    for start, chosen in starts:
        anchors_m = _positions_m(start.anchors) | _positions_m(known) | chosen
        fit = _fit([*world, start], anchors_m, ENOUGH_TO_SEARCH)
        fits.append((fit, _fitted(fit, [*world, start])))
    (fit, joined), *rivals = sorted(fits, key=lambda each: each[0].cost)
    path_m = joined[-1].path_m
    extent_m = float(np.linalg.norm(path_shape(path_m).stddevs))
    for rival, there in rivals:
        apart_m = rmse(path_m - there[-1].path_m)
        if apart_m > _SAME_SHARE * extent_m and rival.cost - fit.cost < MIN_COST_GAP:
            raise GeometryError(f"two places of it, {apart_m:.2g} m apart, fit all ranges equally well")
    of_map = fit.columns[-1].of_map
    motions = similarity_motions(path_m - joined[-1].metric_from_sfm.translation)[:, :, : len(of_map)]
    covariance = fit.covariance[np.ix_(of_map, of_map)]
    stddev_m = float(np.sqrt(np.mean(np.einsum("nij,jk,nik->n", motions, covariance, motions))))
    if stddev_m > _MAX_OPEN * extent_m:
        raise GeometryError(
            f"the anchors place it only to {stddev_m:.2g} m, of an extent of {extent_m:.2g} m: those it shares are too "
            "few, near a line, or badly placed"
        )
    return joined


def _fit(pieces: Sequence[Piece], anchors_m: Mapping[str, Array], num_per_anchor: int | None) -> RangeFit:
    """Fit all pieces from where they are to the ranges of all.

    The first piece's frame is fixed, unless it is that of the site, in which some are placed or anchors are known.

    Args:
        anchors_m: where anchors begin, by id; anchors without a place are left out.
        num_per_anchor: number of ranges of each piece to each anchor that are used; None: all.
    """
    anchors, loss, in_site = _common_anchors(pieces), pieces[0].estimate.ranges.errors.loss, pieces[0].in_site
    start_m = np.array([anchors_m.get(each.anchor_id, np.full(3, np.nan)) for each in anchors]).reshape(-1, 3)
    has_place, parts = np.isfinite(start_m).all(axis=1), list[RangeProblem]()
    for k, piece in enumerate(pieces):
        part = piece.problem(anchors, frame_is_free=not piece.is_placed if in_site else k > 0)
        part = part if num_per_anchor is None else spread_subset(part, num_per_anchor)
        parts.append(part.subset(np.flatnonzero(has_place[part.anchor_index])))
    placed, *others = (piece.metric_from_sfm for piece in pieces)
    state = RangeState(placed, start_m, parts[0].bias_mean_m, tuple(others))
    # The wide loss converges from further away, then the bounded loss decides, as for a single model.
    begun = solve(parts[0], state, others=parts[1:], loss=wider(loss))
    return solve(parts[0], begun.state, others=parts[1:], loss=loss)


def _common_anchors(pieces: Sequence[Piece]) -> list[AnchorEstimate]:
    """Return the anchors with their priors, each from a piece that has ranges to it if there is one."""
    anchors = []
    for estimates in zip(*(piece.estimate.ranges.anchors for piece in pieces), strict=True):
        heard = max(estimates, key=lambda anchor: anchor.prior_bias_stddev_m)
        given = [each for each, piece in zip(estimates, pieces, strict=True) if pieces[0].in_site and piece.in_site]
        known = [each for each in given if each.prior_position_m is not None]
        anchors.append(
            replace(
                heard,
                prior_position_m=known[0].prior_position_m if known else None,
                prior_position_stddev_m=max(each.prior_position_stddev_m for each in known) if known else np.inf,
            )
        )
    return anchors

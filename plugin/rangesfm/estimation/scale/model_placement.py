"""Placement of several models, each scaled on its own, in one metric world by the anchors that they share.

Rigid motions bring the anchors of two models together. The ranges of all models then decide among those that fit alike.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from rangesfm.arrays import Array
from rangesfm.errors import GeometryError
from rangesfm.estimation.scale.scale_estimate import ScaleEstimate
from rangesfm.measurements.ranges.anchors.anchor import AnchorEstimate
from rangesfm.measurements.ranges.anchors.point_fit import ENOUGH_TO_SEARCH
from rangesfm.measurements.ranges.scale.range_equation import RangeFit, RangeProblem, RangeState, solve
from rangesfm.measurements.ranges.scale.starts import MAX_NUM_STARTS, each_once, spread_subset
from rangesfm.util.geometry.numerics import MAX_NUM_ROUNDS, ROUNDING
from rangesfm.util.geometry.robust_statistics import CAUCHY, MIN_COST_GAP, wider
from rangesfm.util.geometry.rotations import cross_matrices
from rangesfm.util.geometry.similarity import Similarity, align_points, path_shape, rmse
from rangesfm.util.geometry.trajectory import Trajectory

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


# Smallest standard deviation of an anchor's position: antennas err by as much, whatever the ranges say.
_MIN_STDDEV_M = 0.02
# A model counts as not placed if its path's places have a larger standard deviation than this, in extents of the path.
_MAX_OPEN = 0.25


@dataclass(frozen=True)
class ScaledModel:
    """A model with the scale estimate from its own ranges.

    Attributes:
        trajectory: of the unscaled model.
        estimate: of its scale, in a frame of its own or in the anchors' frame.
        is_in_anchor_frame: whether the estimate is in the frame in which positions of anchors were given.
        frame_is_given: whether these positions were given in the frame of this model's first camera.
    """

    trajectory: Trajectory
    estimate: ScaleEstimate
    is_in_anchor_frame: bool
    frame_is_given: bool = False


def place_models(
    models: Sequence[ScaledModel],
) -> tuple[tuple[Similarity | None, ...], tuple[str, ...], tuple[str, ...]]:
    """Place each model that the anchors determine in the world of the first, directly or through other models.

    Every model has a scale and a place of its own; all share one set of anchors. Where the anchors alone allow several
    places for a model, the ranges of all models decide; if they cannot, the model is left out. Each range keeps the
    weight that it has in its model alone.

    Returns:
        For each model its place in the unscaled world of the first, None if it could not be placed; for each model why
        it could not, or an empty text; and what does not fit.
    """
    world = _World(models)
    reasons = [""] * len(models)
    waiting, num_before = list(range(1, len(models))), len(models)
    while len(waiting) < num_before:
        num_before = len(waiting)
        for k in tuple(waiting):
            try:
                world.add(k)
            except GeometryError as error:
                reasons[k] = str(error)
            else:
                reasons[k] = ""
                waiting.remove(k)
    metric_from_sfm = world.solved()
    into_first = metric_from_sfm[0].inverse()
    placed = tuple(into_first @ metric_from_sfm[k] if k in metric_from_sfm else None for k in range(len(models)))
    return placed, tuple(reasons), tuple(world.notes)


class _World:
    """The models placed so far.

    Attributes:
        metric_from_sfm: of each placed model, by its index.
        anchors: their positions in the metric world, by id.
        notes: anchors that another model has in another place.
    """

    def __init__(self, models: Sequence[ScaledModel]):
        self._models = models
        self.metric_from_sfm = {0: models[0].estimate.metric_from_sfm}
        self.anchors = _placed_anchors(models[0])
        self.notes: list[str] = []

    def add(self, k: int) -> None:
        """Place a model; raise GeometryError where the models placed so far do not determine its place."""
        model, anchors = self._models[k], _placed_anchors(self._models[k])
        own = model.estimate.metric_from_sfm
        path = model.trajectory.centers
        if any(self._models[j].is_in_anchor_frame and model.is_in_anchor_frame for j in self.metric_from_sfm):
            # Both are in the frame in which the anchors were given.
            starts, elsewhere_m = [(own, {**_chosen(anchors), **_chosen(self.anchors)})], {}
        else:
            found = align_by_anchors(self.anchors, anchors, own.apply(path))
            starts = [
                (
                    alignment.target_from_source @ own,
                    {
                        **_chosen({i: a.moved(alignment.target_from_source) for i, a in anchors.items()}),
                        **_chosen(self.anchors, {id_: side for id_, (side, _) in alignment.sides.items()}),
                    },
                )
                for alignment in found
            ]
            elsewhere_m = found[0].elsewhere_m
        fit = self._best(k, starts)
        moved = fit.state.similarities[-1] @ own.inverse()
        rigid = replace(moved, scale=1.0)
        self.metric_from_sfm = dict(zip((*self.metric_from_sfm, k), fit.state.similarities, strict=True))
        for id_, anchor in anchors.items():
            known = self.anchors.get(id_)
            if known is None or anchor.rank < known.rank:
                self.anchors[id_] = anchor.moved(rigid)
        self.notes += [f"anchor {id_} is {off:.2g} m elsewhere by another model" for id_, off in elsewhere_m.items()]

    def _best(self, k: int, starts: Sequence[tuple[Similarity, Mapping[str, Array]]]) -> RangeFit:
        """Choose among possible places of a model by the ranges of all; raise GeometryError if they cannot decide."""
        members = [*self.metric_from_sfm, k]
        group = _Group([self._models[j] for j in members], ENOUGH_TO_SEARCH)
        fits = sorted(
            (group.solve([*self.metric_from_sfm.values(), metric], at) for metric, at in starts),
            key=lambda fit: fit.cost,
        )
        path, best = self._models[k].trajectory.centers, fits[0]
        placed = best.state.similarities[-1]
        extent = float(np.linalg.norm(placed.scale * path_shape(path).stddevs))
        for rival in fits[1:]:
            apart = placed.apply(path) - rival.state.similarities[-1].apply(path)
            if rmse(apart) > SAME_SHARE * extent and rival.cost - best.cost < MIN_COST_GAP:
                raise GeometryError(f"two places of it, {rmse(apart):.2g} m apart, fit all ranges equally well")
        stddev = _path_stddev_m(best, path)
        if stddev > _MAX_OPEN * extent:
            raise GeometryError(
                f"the anchors place it only to {stddev:.2g} m, of an extent of {extent:.2g} m: those it shares are too "
                "few, near a line, or badly placed"
            )
        return best

    def solved(self) -> dict[int, Similarity]:
        """Return metric_from_sfm of all placed models, estimated from all their ranges."""
        if len(self.metric_from_sfm) == 1:
            return self.metric_from_sfm
        group = _Group([self._models[k] for k in self.metric_from_sfm], None)
        fit = group.solve(list(self.metric_from_sfm.values()), _chosen(self.anchors))
        return dict(zip(self.metric_from_sfm, fit.state.similarities, strict=True))


class _Group:
    """The joint problem of several models. The first model's frame is fixed, unless given anchors fix the frames."""

    def __init__(self, models: Sequence[ScaledModel], num_per_anchor: int | None):
        self._anchors = _common_anchors(models)
        self._loss = models[0].estimate.errors.loss
        parts = [_problem(model, self._anchors) for model in models]
        if num_per_anchor is not None:
            parts = [spread_subset(part, num_per_anchor) for part in parts]
        frames_are_given = models[0].is_in_anchor_frame
        held = [model.frame_is_given if frames_are_given else k == 0 for k, model in enumerate(models)]
        self._parts = [replace(part, frame_is_free=not stays) for part, stays in zip(parts, held, strict=True)]

    def solve(self, metric_from_sfm: Sequence[Similarity], anchors_m: Mapping[str, Array]) -> RangeFit:
        """Solve from a start; anchors that have no place in it are left out."""
        start_m = np.array([anchors_m.get(a.anchor_id, np.full(3, np.nan)) for a in self._anchors]).reshape(-1, 3)
        has_place = np.isfinite(start_m).all(axis=1)
        first, *others = (part.subset(np.flatnonzero(has_place[part.anchor_index])) for part in self._parts)
        state = RangeState(metric_from_sfm[0], start_m, first.bias_mean_m, tuple(metric_from_sfm[1:]))
        # The wide loss converges from further away, then the bounded loss decides, as for a single model.
        for loss in (wider(self._loss), self._loss):
            fit = solve(first, state, others=others, loss=loss)
            state = fit.state
        return fit


def _path_stddev_m(fit: RangeFit, centers: Array) -> float:
    """Return the formal standard deviation, root mean square, of places of the last model, in metres.

    Args:
        fit: of several models; the frame of the last is free. centers: (n, 3) places in its unit.
    """
    similarity, first = fit.state.similarities[-1], fit.columns[-1].scale
    grown = similarity.scale * centers @ similarity.rotation.T
    identity = np.broadcast_to(np.eye(3), (len(centers), 3, 3))
    jacobian = np.concatenate([grown[:, :, None], -cross_matrices(grown), identity], axis=2)
    covariance = fit.covariance[first : first + 7, first : first + 7]
    return float(np.sqrt(np.mean(np.einsum("nij,jk,nik->n", jacobian, covariance, jacobian))))


def _common_anchors(models: Sequence[ScaledModel]) -> list[AnchorEstimate]:
    """Return the anchors with their priors, each from a model that has ranges to it if there is one."""
    in_frame = models[0].is_in_anchor_frame
    anchors = []
    for estimates in zip(*(model.estimate.anchors for model in models), strict=True):
        heard = max(estimates, key=lambda anchor: anchor.prior_bias_stddev_m)
        given = [a for a, model in zip(estimates, models, strict=True) if model.is_in_anchor_frame and in_frame]
        known = [a for a in given if a.prior_position_m is not None]
        anchors.append(
            replace(
                heard,
                prior_position_m=known[0].prior_position_m if known else None,
                prior_position_stddev_m=max(a.prior_position_stddev_m for a in known) if known else np.inf,
            )
        )
    return anchors


def _problem(model: ScaledModel, anchors: Sequence[AnchorEstimate]) -> RangeProblem:
    """Return the problem of the ranges that the model's own estimate used, in the model's unit, with its weights.

    Errors are correlated by different amounts in different models, while the priors are common to all. So the ranges
    get less weight here; in a problem of one model, the priors get more instead.
    """
    observations, log = model.estimate.observations, model.estimate.observations.log
    rows = np.flatnonzero(observations.has_place & np.isfinite(model.estimate.errors.stddev_m))
    errors, no_place = model.estimate.errors.subset(rows), np.full(3, np.nan)
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
        frame_is_free=True,
    )


def _placed_anchors(model: ScaledModel) -> dict[str, PlacedAnchor]:
    path_m = model.estimate.metric_from_sfm.apply(model.trajectory.centers)
    relative, placed = model.estimate.uncertainty.empirical, {}
    for anchor in model.estimate.anchors:
        if not np.isfinite(anchor.position_m).all():
            continue
        covariance = _MIN_STDDEV_M**2 * np.eye(3)
        if anchor.position_covariance_m2 is not None:
            covariance = covariance + anchor.position_covariance_m2
        if anchor.prior_position_m is None:  # its position may be off together with the model's scale
            by_scale_m = relative * (anchor.position_m - path_m.mean(axis=0))
            covariance = covariance + np.outer(by_scale_m, by_scale_m)
        mirror = anchor.mirror_position_m
        places = [anchor.position_m] if mirror is None else [anchor.position_m, mirror]
        placed[anchor.anchor_id] = PlacedAnchor(np.array(places), covariance)
    return placed


def _chosen(anchors: Mapping[str, PlacedAnchor], sides: Mapping[str, int] | None = None) -> dict[str, Array]:
    """Return the (3,) place of each anchor: the first of its places unless ``sides`` names another."""
    return {id_: anchor.places_m[(sides or {}).get(id_, 0)] for id_, anchor in anchors.items()}

"""Placement of several models, each scaled on its own, in one metric world by the anchors that they share."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from rangesfm.arrays import Array
from rangesfm.errors import GeometryError
from rangesfm.estimation.scale.anchor_alignment import SAME_SHARE, PlacedAnchor, align_by_anchors
from rangesfm.estimation.scale.scale_estimate import ScaleEstimate
from rangesfm.measurements.ranges.anchors.anchor import AnchorEstimate
from rangesfm.measurements.ranges.anchors.point_fit import ENOUGH_TO_SEARCH
from rangesfm.measurements.ranges.scale.range_equation import RangeFit, RangeProblem, RangeState, solve
from rangesfm.measurements.ranges.scale.starts import spread_subset
from rangesfm.util.geometry.robust_statistics import MIN_COST_GAP, wider
from rangesfm.util.geometry.rotations import cross_matrices
from rangesfm.util.geometry.similarity import Similarity, path_shape, rmse
from rangesfm.util.geometry.trajectory import Trajectory

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

"""Choice of the side of a path on which an unknown anchor stands, where the bending of the map decides it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from rangesfm.arrays import Array
from rangesfm.measurements.ranges.anchors.anchor import AnchorEstimate
from rangesfm.measurements.ranges.mistakes.hypothesis_tests import Factorization
from rangesfm.measurements.ranges.mistakes.linearized import (
    Linearized,
    RangesOnMap,
    after_step,
    at_state,
    is_nearly_at,
    linearized,
)
from rangesfm.measurements.ranges.scale.range_equation import RangeState, antenna_positions
from rangesfm.util.geometry.numerics import MAX_NUM_ROUNDS, SIGNIFICANT_STDDEVS
from rangesfm.util.geometry.similarity import Similarity, path_shape


@dataclass(frozen=True)
class AnchorSides:
    """Sides of the path's plane on which unknown anchors stand.

    Attributes:
        on_map: with each anchor on its likelier side.
        has_crossed: whether an anchor is likelier on the other side than where it was before.
        mirrors_m: by id of each unknown anchor, its (3,) place on the other side if that is about as likely, or None.
    """

    on_map: RangesOnMap
    has_crossed: bool
    mirrors_m: Mapping[str, Array | None]

    def moved(self, change: Similarity) -> AnchorSides:
        """Return them with the places on the other sides where the map was moved."""
        places = {id_: None if at is None else change.apply(at) for id_, at in self.mirrors_m.items()}
        return replace(self, mirrors_m=places)

    def applied_to(self, anchors: Iterable[AnchorEstimate]) -> tuple[AnchorEstimate, ...]:
        """Return estimates of anchors with the unknown ones on these sides."""
        at_m = dict(zip(self.on_map.anchor_ids, self.on_map.state.anchors_m, strict=True))
        return tuple(
            replace(
                anchor,
                position_m=at_m[anchor.anchor_id] if self.has_crossed else anchor.position_m,
                mirror_position_m=self.mirrors_m[anchor.anchor_id],
            )
            if anchor.anchor_id in self.mirrors_m
            else anchor
            for anchor in anchors
        )


def likelier_sides(on_map: RangesOnMap) -> AnchorSides:
    """Find for each unknown anchor the side of its path where the ranges are likelier.

    On a nearly flat path, an anchor and its mirror image fit alike, and which of them fits a map of one piece better
    may depend on how the map drifts. Here the map may bend as its photos allow.
    """
    heard = np.unique(on_map.problem.anchor_index)
    unknown = heard[np.isinf(on_map.problem.anchor_stddev_m[heard])].tolist()
    nowhere_else = AnchorSides(on_map, False, {on_map.anchor_ids[k]: None for k in unknown})
    if not unknown:
        return nowhere_else
    try:
        return _likelier_sides(on_map, unknown)
    except np.linalg.LinAlgError:  # the ranges determine too little to tell
        return nowhere_else


def _likelier_sides(on_map: RangesOnMap, unknown: Sequence[int]) -> AnchorSides:
    mirrors_m: dict[str, Array | None] = {on_map.anchor_ids[k]: None for k in unknown}
    has_crossed = False
    problem = linearized(on_map).with_learnt_errors()
    problem = _settled(problem, on_map.state).with_learnt_errors()
    for k in unknown:
        other = _on_other_side(problem, k)
        if np.linalg.norm(_place_m(other, k) - _place_m(problem, k)) < problem.scatter_m:  # there is one place only
            continue
        gain = _misfit(problem) - _misfit(other)
        if gain > 0:  # learning the errors takes time, and it hardly changes which side fits better
            other = other.with_learnt_errors()
            gain = Factorization(problem).deviance() - Factorization(other).deviance()
        likelier, less_likely = (other, problem) if gain > 0 else (problem, other)
        is_open = abs(gain) < SIGNIFICANT_STDDEVS**2
        mirrors_m[on_map.anchor_ids[k]] = _place_m(less_likely, k) if is_open else None
        problem, has_crossed = likelier, has_crossed or gain > 0
    return AnchorSides(problem.on_map if has_crossed else on_map, has_crossed, mirrors_m)


def _place_m(problem: Linearized, k: int) -> Array:
    return np.asarray(problem.on_map.state.anchors_m[k])


def _on_other_side(problem: Linearized, k: int) -> Linearized:
    """Return the problem at the likeliest state with an anchor on the other side of the plane of its path."""
    on_map = problem.on_map
    anchors_m, tags_m = on_map.state.anchors_m.copy(), antenna_positions(on_map.problem, on_map.state.metric_from_model)
    path = path_shape(tags_m[on_map.problem.anchor_index == k])
    normal = path.axes[:, 2]
    anchors_m[k] -= 2 * ((anchors_m[k] - path.centroid) @ normal) * normal
    return _settled(problem, replace(on_map.state, anchors_m=anchors_m))


def _settled(problem: Linearized, state: RangeState) -> Linearized:
    """Return the problem at the likeliest state near another one."""
    problem = at_state(problem, replace(problem.on_map, state=state))
    for _ in range(MAX_NUM_ROUNDS):
        before, problem = problem, after_step(problem)
        if is_nearly_at(problem.on_map, before.on_map, problem.scatter_m):
            break
    return problem


def _misfit(problem: Linearized) -> float:
    left = Factorization(problem).residual
    return float(left @ left)

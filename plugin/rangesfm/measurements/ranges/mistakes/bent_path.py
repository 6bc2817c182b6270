"""Where ranges have a map that may bend: its path, bent as maps of poses drift, and the sides of its anchors."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import reduce

import numpy as np
from scipy.linalg import cho_solve

from rangesfm.arrays import Array
from rangesfm.measurements.ranges.anchors.anchor import AnchorEstimate
from rangesfm.measurements.ranges.mistakes.linearized import Linearized, is_nearly_at, linearized
from rangesfm.measurements.ranges.scale.range_equation import RangeState, antenna_positions
from rangesfm.measurements.ranges.scale.ranges_on_map import RangesOnMap
from rangesfm.solver.bending import BENDS, WalkBending
from rangesfm.util.geometry.numerics import MAX_NUM_ROUNDS, SIGNIFICANT_STDDEVS
from rangesfm.util.geometry.similarity import Similarity, path_shape, rmse

# Number of Gauss-Newton steps after which the bins are kept: with bins and outliers chosen anew each time, a map may
# swing to and fro for ever.
_NUM_BINNED_ANEW = 3


def bent_to_ranges(on_map: RangesOnMap, rivals: Sequence[RangeState] = ()) -> RangesOnMap:
    """Return the map where ranges and the random-walk model of drift together put it, by Gauss-Newton steps.

    A map that does not drift as a random walk is returned unchanged. The steps make the linear tests valid even for a
    path that has drifted far.

    Args:
        rivals: other states that fit the ranges nearly as well, or better if the path drifts. A path of one piece that
            drifts by metres may fit better turned over, with its anchors on the wrong side. So each is bent, too, and
            one that is then much likelier is taken.
    """
    if not isinstance(on_map.posed.bending, WalkBending):
        return on_map
    problem, bent = linearized(on_map), _bent(on_map)
    if not drifts(problem.at_other_map(bent)):
        return bent

    def with_deviance(bent: RangesOnMap) -> tuple[float, RangesOnMap]:
        return problem.at_other_map(bent).with_learnt_errors().deviance, bent

    def likelier(best: tuple[float, RangesOnMap], start: RangesOnMap) -> tuple[float, RangesOnMap]:
        other = with_deviance(_bent(start))
        return other if other[0] < best[0] - SIGNIFICANT_STDDEVS**2 else best

    best = reduce(likelier, (replace(on_map, state=state) for state in rivals), with_deviance(bent))
    # The place of the bent path is a better start than that of a path of one piece.
    return likelier(best, as_given(best[1]))[1]


def _bent(on_map: RangesOnMap) -> RangesOnMap:
    problem = linearized(on_map).with_learnt_errors()
    for num in range(MAX_NUM_ROUNDS):
        if num:
            again = linearized(on_map) if num < _NUM_BINNED_ANEW else problem.at_other_map(on_map)
            problem = again.with_learnt_errors(near=problem.noise.stddev_of_component)
        before, on_map = on_map, _bent_once(problem)
        if is_nearly_at(on_map, before, problem.scatter_m):
            break
    return on_map


def as_given(on_map: RangesOnMap) -> RangesOnMap:
    """Return the map before it was bent to the ranges, at the same state."""
    walk = on_map.posed.bending
    if not isinstance(walk, WalkBending) or not walk.is_corrected:
        return on_map
    return _on_path(on_map, walk, WalkBending(walk.given))


def bends_m(on_map: RangesOnMap) -> Array:
    """Return (k,) how far the ranges moved each pose from the given path, metres; (0,) for a map that is no walk."""
    walk, scale = on_map.posed.bending, on_map.metric_from_path.scale
    if not isinstance(walk, WalkBending) or not walk.is_corrected:
        return np.zeros(0)
    return np.asarray(scale * np.linalg.norm(walk.path.centers - walk.given.centers, axis=1))


def drifts(problem: Linearized) -> bool:
    """Return whether the ranges moved the poses by more than single ranges scatter: a rigid path then fits worse."""
    return rmse(bends_m(problem.on_map)[:, None]) > problem.scatter_m


def _bent_once(problem: Linearized) -> RangesOnMap:
    on_map, walk = problem.on_map, problem.on_map.posed.bending
    assert isinstance(walk, WalkBending)
    is_free = on_map.problem.frame_is_free
    moved, stddevs_m = problem.after_step(), problem.noise.stddev_of_component
    pulls = cho_solve((problem.solution.lower, True), moved.residual_m)
    by_pose = problem.bins.by_pose(on_map.by_poses, len(walk.path))
    sizes = {part.name: stddevs_m[part.name] / part.median for part in problem.components if part.name in BENDS}
    bent = walk.bent_back(pulls @ by_pose, sizes, frame_is_free=is_free)
    return _on_path(moved.on_map, walk, bent)


def _on_path(on_map: RangesOnMap, before: WalkBending, after: WalkBending) -> RangesOnMap:
    """Return the ranges moved along from one path to another."""
    turns = after.path.world_from_cam @ np.swapaxes(before.path.world_from_cam, 1, 2)
    posed = on_map.posed.carried(turns, after.path.centers - before.path.centers)
    return replace(on_map, posed=replace(posed, bending=after))


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
    problem = problem.settled(on_map.state).with_learnt_errors()
    for k in unknown:
        other = _on_other_side(problem, k)
        if np.linalg.norm(_place_m(other, k) - _place_m(problem, k)) < problem.scatter_m:  # there is one place only
            continue
        gain = problem.solution.misfit - other.solution.misfit
        if gain > 0:  # learning the errors takes time, and it hardly changes which side fits better
            other = other.with_learnt_errors()
            gain = problem.deviance - other.deviance
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
    return problem.settled(replace(on_map.state, anchors_m=anchors_m))

"""Correction of a drifting path of poses by its ranges, so that tests see it where it probably was."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import reduce

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from rangesfm.arrays import Array
from rangesfm.measurements.ranges.mistakes.hypothesis_tests import Factorization
from rangesfm.measurements.ranges.mistakes.linearized import (
    Linearized,
    RangesOnMap,
    after_step,
    at_other_map,
    is_nearly_at,
    linearized,
    slopes_by_poses,
)
from rangesfm.measurements.ranges.scale.range_equation import RangeState
from rangesfm.solver.bending import BENDS, WalkBending
from rangesfm.solver.linear_map import regular
from rangesfm.util.geometry.numerics import MAX_NUM_ROUNDS, SIGNIFICANT_STDDEVS
from rangesfm.util.geometry.similarity import rmse

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
    if not isinstance(on_map.bending, WalkBending):
        return on_map
    problem, bent = linearized(on_map), _bent(on_map)
    if not drifts(at_other_map(problem, bent)):
        return bent

    def with_deviance(bent: RangesOnMap) -> tuple[float, RangesOnMap]:
        return Factorization(at_other_map(problem, bent).with_learnt_errors()).deviance(), bent

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
            again = linearized(on_map) if num < _NUM_BINNED_ANEW else at_other_map(problem, on_map)
            problem = again.with_learnt_errors(near=problem.errors)
        before, on_map = on_map, _bent_once(problem)
        if is_nearly_at(on_map, before, problem.scatter_m):
            break
    return on_map


def as_given(on_map: RangesOnMap) -> RangesOnMap:
    """Return the map before it was bent to the ranges, at the same state."""
    walk = on_map.bending
    if not isinstance(walk, WalkBending) or walk.steps is None:
        return on_map
    return _on_path(on_map, walk, WalkBending(walk.given))


def bends_m(on_map: RangesOnMap) -> Array:
    """Return (k,) how far the ranges moved each pose from the given path, metres; (0,) for a map that is no walk."""
    walk, scale = on_map.bending, on_map.state.metric_from_model.scale
    if not isinstance(walk, WalkBending) or walk.steps is None:
        return np.zeros(0)
    return np.asarray(scale * np.linalg.norm(walk.path.centers - walk.given.centers, axis=1))


def drifts(problem: Linearized) -> bool:
    """Return whether the ranges moved the poses by more than single ranges scatter: a rigid path then fits worse."""
    return rmse(bends_m(problem.on_map)[:, None]) > problem.scatter_m


def _bent_once(problem: Linearized) -> RangesOnMap:
    on_map, walk = problem.on_map, problem.on_map.bending
    assert isinstance(walk, WalkBending)
    is_free = on_map.problem.frame_is_free
    moved, stddevs_m = after_step(problem), problem.errors.stddev_of_component
    pulls = cho_solve(cho_factor(regular(problem.errors.covariance_m2)), moved.residual_m)
    by_pose = problem.bins.by_pose(slopes_by_poses(on_map), len(walk.path))
    sizes = {part.name: stddevs_m[part.name] / part.median for part in problem.components if part.name in BENDS}
    bent = walk.bent_back(pulls @ by_pose, sizes, frame_is_free=is_free)
    return _on_path(moved.on_map, walk, bent)


def _on_path(on_map: RangesOnMap, before: WalkBending, after: WalkBending) -> RangesOnMap:
    """Return the ranges moved along from one path to another."""
    at, turned = on_map.on_path, after.path.world_from_cam @ np.swapaxes(before.path.world_from_cam, 1, 2)
    turn = turned[at.nearest]
    return replace(
        on_map,
        problem=on_map.problem.carried(at, turned, after.path.centers - before.path.centers),
        model_from_cam=turn @ on_map.model_from_cam,
        velocity=None if on_map.velocity is None else np.einsum("nij,nj->ni", turn, on_map.velocity),
        bending=after,
    )

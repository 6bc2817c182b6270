"""The best solution of a survey's range problem, and the check that no other solution fits as well."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from rangesfm.arrays import Array
from rangesfm.errors import GeometryError
from rangesfm.measurements.ranges.anchors.anchor_distances import NO_DISTANCES
from rangesfm.measurements.ranges.anchors.point_fit import ENOUGH_TO_JUDGE, ENOUGH_TO_SEARCH
from rangesfm.measurements.ranges.errors.noise import shared_stddev
from rangesfm.measurements.ranges.errors.range_errors import RangeErrors
from rangesfm.measurements.ranges.range_observations import OUTLIER_BELOW
from rangesfm.measurements.ranges.scale.anchor_plane import is_on_side, mirrored_map, on_side
from rangesfm.measurements.ranges.scale.range_equation import (
    RangeFit,
    RangeProblem,
    RangeState,
    antenna_positions,
    cost_at,
    predicted_ranges,
    prior_cost,
    range_gradient,
    solve,
)
from rangesfm.measurements.ranges.scale.ranges_on_map import RangesOnMap
from rangesfm.measurements.ranges.scale.scale_problem import ScaleProblem
from rangesfm.measurements.ranges.scale.starts import (
    complete_unknown_anchors,
    each_once,
    first_camera_starts,
    site_starts,
    sphere_swaps,
    spread_rows,
    spread_subset,
    unknown_anchor_starts,
)
from rangesfm.util.geometry.numerics import MAX_NUM_ROUNDS
from rangesfm.util.geometry.robust_statistics import MIN_COST_GAP
from rangesfm.util.geometry.similarity import NEARLY_STRAIGHT, path_kind, path_shape

# Number of fits, each with the errors that the one before shows.
_NUM_ROUNDS = 2
# Noise that falls to less than this share of what a fit assumed: another fit is made.
_FALLS = 0.5
# Number of different maps that are compared. Two maps are the same if the logarithms of their scales, their rotations
# (degrees) and the places of the path's middle (extents of the path) are no further apart than this.
_NUM_ALTERNATIVES = 4
_SAME_LOG_SCALE, _SAME_ROTATION_DEG, _SAME_SHIFT = 0.03, 5.0, 0.05
MANY_OUTLIERS = 0.3
"""Share of outliers above which a map is doubted, so that rivals are not compared any more."""

WHY_SCALE_IS_OPEN = {
    "straight": ("the path is straight", "walk a bend"),
    "circular": (
        "the path is a flat circle, and its radius and the anchors' heights can make up for each other",
        "walk another shape, or survey an anchor",
    ),
    "spherical": (
        "the path lies on a sphere, and its radius and the anchor's distance from its centre can change places",
        "walk another shape, or add an anchor",
    ),
    "flat": ("the path is flat", "go up and down too, or add an anchor"),
    "general": ("the path is too short or runs round the anchor", "vary it, or add an anchor"),
}
"""Reasons why another scale fits as well, and what to do about it, by the kind of path."""


def solve_scale(posed: ScaleProblem) -> RangesOnMap:
    """Solve from all starts, estimate the noise, and refuse if two different maps fit equally well.

    Raises:
        GeometryError: nothing fits, or two maps of different scales fit.
    """
    problem, errors = posed.ranges, posed.prior_errors
    if problem.placement is not None:  # known positions say where the map is, so that there is nothing to search for
        start = RangeState(problem.placement.mean, problem.anchor_mean_m.copy(), problem.bias_mean_m.copy())
        return solution_from(posed, complete_unknown_anchors(problem, start))
    camera_side = posed.given.camera_side if problem.frame_is_free else None
    starts = on_side(problem, [fit.state for fit in _distinct_fits(problem, posed.given.seed)], camera_side)
    if problem.has_known_anchors and not problem.frame_is_free:
        # States with the highest consensus, not refined: a fit from there may be drawn away by outliers.
        agreed = first_camera_starts(_known_only(problem))[:_NUM_ALTERNATIVES]
        is_complete = not np.isinf(problem.anchor_stddev_m).any()
        starts += agreed if is_complete else [complete_unknown_anchors(problem, start) for start in agreed]
    starts.sort(key=lambda state: _unlikeliness(problem, errors, state))
    likeliest = each_once(starts, lambda *both: _are_same(problem, *both), _NUM_ALTERNATIVES)
    best, *others = sorted(
        (solution_from(posed, start) for start in likeliest),
        key=lambda each: _unlikeliness(problem, errors, each.state),
    )
    on_side(problem, [best.state], camera_side)
    why_open = refuse_ambiguity(best, [each.state for each in others], camera_side)
    rivals = tuple(each.state for each in others if is_on_side(problem, each.state, camera_side))
    return replace(best, rivals=rivals, why_open=why_open)


def _unlikeliness(problem: RangeProblem, errors: RangeErrors, state: RangeState) -> float:
    """Return the negative logarithm of the posterior, up to a constant."""
    residuals = predicted_ranges(problem, state) - problem.range_m
    return prior_cost(problem, state) - errors.noise_of_all(residuals).log_likelihood


def _distinct_fits(problem: RangeProblem, seed: int) -> list[RangeFit]:
    """Return the local minima, best first, each different map once.

    They are searched with few ranges per anchor and ranked with more.
    """
    small, anchors_are_known = spread_subset(problem, ENOUGH_TO_SEARCH), problem.has_known_anchors
    if not anchors_are_known:
        starts = unknown_anchor_starts(problem)
    else:
        starts = site_starts(problem, seed) if problem.frame_is_free else first_camera_starts(_known_only(problem))
    fits = [solve(_known_only(small) if anchors_are_known else small, start, tolerance=1e-8) for start in starts]
    fits = [fit for fit in fits if np.isfinite(fit.cost)]
    if not fits:
        raise GeometryError("the scale is not determined: no scale explains the ranges")
    distinct = _each_once(small, fits)
    if problem.frame_is_free:
        mirrored = [mirrored_map(problem, fit.state) for fit in distinct]
        again = [solve(_known_only(small), state, tolerance=1e-8) for state in mirrored if state is not None]
        distinct = _each_once(small, distinct + again)
    if anchors_are_known and np.isinf(problem.anchor_stddev_m).any():
        distinct = [solve(small, complete_unknown_anchors(small, fit.state)) for fit in distinct]
    if not anchors_are_known:
        swapped = [solve(small, state, tolerance=1e-8) for state in sphere_swaps(small, distinct[0].state)]
        distinct = _each_once(small, distinct + swapped)
    enough = spread_subset(problem, ENOUGH_TO_JUDGE)
    return _each_once(enough, [solve(enough, fit.state, tolerance=1e-8) for fit in distinct])


def _each_once(problem: RangeProblem, fits: list[RangeFit]) -> list[RangeFit]:
    """Return the best fits, best first, each different map once."""
    ranked = sorted(fits, key=lambda f: f.cost)
    return each_once(ranked, lambda a, b: _are_same(problem, a.state, b.state), _NUM_ALTERNATIVES)


def _known_only(problem: RangeProblem) -> RangeProblem:
    """Return the ranges to anchors with a given position; all other anchors are held fixed."""
    known = np.isfinite(problem.anchor_stddev_m)
    part = problem.subset(np.flatnonzero(known[problem.anchor_index]))
    return replace(
        part,
        anchor_stddev_m=np.where(known, problem.anchor_stddev_m, 0.0),
        bias_stddev_m=np.where(known, problem.bias_stddev_m, 0.0),
        distances=NO_DISTANCES,
    )


def _are_same(problem: RangeProblem, first: RangeState, second: RangeState) -> bool:
    """Return True if two states are the same map, up to the tolerances above."""
    a, b = first.metric_from_model, second.metric_from_model
    scales_differ = bool(abs(np.log(a.scale / b.scale)) > _SAME_LOG_SCALE)
    if scales_differ or not problem.frame_is_free:
        return not scales_differ
    turn = np.rad2deg(Rotation.from_matrix(a.rotation.T @ b.rotation).magnitude())
    shape = path_shape(problem.centers)
    shift = np.linalg.norm(a.apply(shape.centroid) - b.apply(shape.centroid)) / np.linalg.norm(a.scale * shape.stddevs)
    return not (turn > _SAME_ROTATION_DEG or shift > _SAME_SHIFT)


def solution_from(posed: ScaleProblem, start: RangeState) -> RangesOnMap:
    """Alternate between fitting and estimating the errors, from one start; the last fit uses all ranges."""
    given = posed.ranges
    rows = spread_rows(given, ENOUGH_TO_JUDGE)

    def residuals_m(state: RangeState) -> Array:
        return predicted_ranges(given, state) - given.range_m

    def seen(errors: RangeErrors, state: RangeState) -> RangeErrors:
        placed = state.metric_from_model
        errors = errors.at(antenna_positions(given, placed), posed.placing_stddev_m(placed.scale))
        # By the distance on the map: garbage that reads short is none of the short ranges that err together.
        distance_m = range_gradient(given, state).distance_m
        errors = replace(errors, shared_m=shared_stddev(distance_m, posed.curve_stddev_m))
        return errors.seen_by_rigid_map(residuals_m(state), prior_cost(given, state))

    def shown(errors: RangeErrors, state: RangeState) -> RangeErrors:
        return seen(errors.inflated(residuals_m(state)), state)

    state, used = start, seen(posed.prior_errors, start)
    for _ in range(_NUM_ROUNDS):
        state = solve(posed.weighted(used).by_some(rows), state, loss=used.loss).state
        used = shown(used, state)
    for _ in range(MAX_NUM_ROUNDS):
        fit = solve(posed.weighted(used), state, loss=used.loss)
        last = shown(used, fit.state)
        # The first rounds may have taken garbage for noise, which the last fit does not any more.
        if last.noise_m > _FALLS * used.noise_m:
            break
        used, state = last, fit.state
    return RangesOnMap(posed, fit.state, fit.weights, used, last.noise_m)


def with_unknown_anchors(on_map: RangesOnMap) -> RangesOnMap:
    """Return the ranges at the solution that they would have if no place of an anchor were known.

    The map then stays in a frame of its own, unless known positions place it.
    """
    problem = on_map.problem
    unknown, is_placed = np.full(problem.num_anchors, np.inf), problem.placement is not None
    unplaced = on_map.with_problem(replace(problem, anchor_stddev_m=unknown, frame_is_free=is_placed))
    return solution_from(unplaced.posed, on_map.state)


def refuse_ambiguity(best: RangesOnMap, rivals: Sequence[RangeState], camera_side: str | None) -> str:
    """Raise GeometryError if the map of a rival of another scale fits as well.

    Where even the best map explains too few ranges, that is the reason to doubt it, and no rival is looked at.

    Returns:
        why the map of a rival of the same scale fits as well; empty if none does.
    """
    problem, loss = best.weighted, best.errors.loss
    if np.mean(best.weights < OUTLIER_BELOW) > MANY_OUTLIERS:
        return ""
    for rival in rivals:
        other = solve(problem, rival, loss=loss, tolerance=1e-8)
        if not is_on_side(problem, other.state, camera_side) or _are_same(problem, other.state, best.state):
            continue
        gap = (other.cost - cost_at(problem, best.state, loss)) / best.errors.inflation**2
        if gap < MIN_COST_GAP:
            ours, theirs = best.state.metric_from_model.scale, other.state.metric_from_model.scale
            extent = float(np.linalg.norm(path_shape(problem.centers).stddevs))
            if min(ours, theirs) * extent < best.noise_stddev_m:
                raise GeometryError("the scale is not determined: a camera that stands still fits the ranges as well")
            if abs(np.log(ours / theirs)) <= _SAME_LOG_SCALE:
                return _another_place(problem)
            raise GeometryError(
                f"two scales fit the ranges equally well ({ours:.4g} and {theirs:.4g} m per unit): "
                f"{'; '.join(WHY_SCALE_IS_OPEN[path_kind(problem.centers)])}"
            )
    return ""


def _another_place(problem: RangeProblem) -> str:
    """Return why two maps of the same scale fit in the site frame; raise GeometryError if their turn is open."""
    stddevs = path_shape(problem.centers).stddevs
    if stddevs[1] < NEARLY_STRAIGHT * stddevs[0]:
        raise GeometryError(
            "the path is nearly straight, and the map fits the ranges as well if it is turned about it: walk a bend"
        )
    return (
        "the map and its mirror image in the anchors' plane fit the ranges equally well, as the path is flat too: "
        "add an anchor at another height, or say on which side of that plane the camera went (camera_side)"
    )

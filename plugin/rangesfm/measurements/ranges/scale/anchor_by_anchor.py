"""Estimates for each anchor: its position, and the scale that its ranges alone would give."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rangesfm.arrays import Array
from rangesfm.measurements.ranges.anchors.anchor import AnchorEstimate
from rangesfm.measurements.ranges.scale.range_equation import RangeProblem, RangeState, solve
from rangesfm.measurements.ranges.scale.scale_problem import MIN_RANGES
from rangesfm.measurements.ranges.scale.solution import Solution
from rangesfm.measurements.ranges.scale.starts import choose_sides
from rangesfm.util.geometry.robust_statistics import GEMAN_MCCLURE, MIN_COST_GAP

# An anchor gives no scale of its own if the standard deviation of the scale's logarithm is larger than this.
_MAX_LOG_SCALE_STDDEV = 0.5


def scale_per_anchor(solution: Solution, anchor_ids: tuple[str, ...]) -> dict[str, float]:
    """Estimate the scale from the ranges of one anchor at a time; by anchor id.

    With a known anchor the path is stretched about its centre, or about the first camera where that is the frame's
    origin. An unknown anchor is estimated along with the scale.
    """
    problem, state, scales = solution.problem, solution.fit.state, {}
    middle = problem.centers.mean(axis=0) if problem.frame_is_free else np.zeros(3)
    placed = replace(state.metric_from_model, translation=state.metric_from_model.apply(middle))
    for k, anchor_id in enumerate(anchor_ids):
        part = problem.of_anchor(k)
        if len(part.range_m) < MIN_RANGES:
            continue
        alone = replace(part, centers=part.centers - middle)
        start = RangeState(placed, state.anchors_m[k : k + 1], state.bias_m[k : k + 1])
        fit = solve(alone, start, loss=GEMAN_MCCLURE)
        if fit.log_scale_stddev * solution.errors.inflation < _MAX_LOG_SCALE_STDDEV:
            scales[anchor_id] = fit.state.metric_from_model.scale
    return scales


def anchor_estimates(solution: Solution, anchor_ids: tuple[str, ...], covariance: Array) -> tuple[AnchorEstimate, ...]:
    """Return the estimates of all anchors of the log, mirror places included.

    Args:
        covariance: (p, p) covariance of the map and its anchors, as in ``KnownMap``.
    """
    problem, state = solution.problem, solution.fit.state
    of_anchors = solution.fit.of_anchors(covariance)
    stddev = np.sqrt(np.trace(of_anchors, axis1=1, axis2=2) / 3)
    mirrors = _mirror_places(solution)
    common_bias_m = _common_bias(problem, state)
    estimates = []
    for k, anchor_id in enumerate(anchor_ids):
        known = bool(np.isfinite(problem.anchor_mean_m[k]).all())
        heard = bool(np.any(problem.anchor_index == k))
        estimates.append(
            AnchorEstimate(
                anchor_id=anchor_id,
                position_m=state.anchors_m[k] if heard else problem.anchor_mean_m[k],
                position_stddev_m=float(stddev[k]),
                prior_position_m=problem.anchor_mean_m[k] if known else None,
                prior_position_stddev_m=float(problem.anchor_stddev_m[k]),
                range_bias_m=float(state.bias_m[k] if heard else problem.bias_mean_m[k] + common_bias_m),
                prior_bias_m=float(problem.bias_mean_m[k]),
                prior_bias_stddev_m=float(problem.bias_stddev_m[k] * solution.errors.inflation),
                mirror_position_m=mirrors.get(k),
                position_covariance_m2=of_anchors[k],
            )
        )
    return tuple(estimates)


def _common_bias(problem: RangeProblem, state: RangeState) -> float:
    """Return the most likely bias, metres, that all free biases share, given their deviations from the prior means."""
    free = problem.bias_stddev_m > 0
    if not free.any() or problem.common_bias_stddev_m == 0:
        return 0.0
    weights = 1 / problem.bias_stddev_m[free] ** 2
    off = (state.bias_m - problem.bias_mean_m)[free]
    return float(weights @ off / (weights.sum() + 1 / problem.common_bias_stddev_m**2))


def _mirror_places(solution: Solution) -> dict[int, Array]:
    """Return the mirror places, by index, of unknown anchors that may stand on either side of the path's plane."""
    found_m = solution.fit.state.anchors_m
    chosen, others_m, rise = choose_sides(solution.problem, solution.fit.state)
    sides_m = np.stack([chosen.anchors_m, others_m])
    is_open = rise / solution.errors.inflation**2 < MIN_COST_GAP
    farther = np.argmax(np.linalg.norm(sides_m - found_m, axis=2), axis=0)
    return {int(k): sides_m[farther[k], k] for k in np.flatnonzero(is_open)}

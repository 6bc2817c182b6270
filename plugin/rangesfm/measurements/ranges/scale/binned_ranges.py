"""Ranges as observations of a map: averaged in bins, with the errors of a radio (sections 2, 4 of ``model.md``)."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from rangesfm.arrays import Array, Indices
from rangesfm.measurements.ranges.errors.components import CLOCKS, PLACES, OtherError
from rangesfm.measurements.ranges.errors.learned import LearnedErrors, radio_components, widened
from rangesfm.measurements.ranges.errors.range_bins import RangeBins, by_poses, noisiness, range_bins
from rangesfm.measurements.ranges.scale.range_equation import (
    RangeProblem,
    columns_of,
    fit_at,
    predicted_ranges,
    prior_jacobian,
    prior_residuals,
    range_gradient,
    range_jacobian,
    state_after,
)
from rangesfm.measurements.ranges.scale.scale_problem import ScaleProblem
from rangesfm.measurements.ranges.scale.solution import Solution
from rangesfm.solver.bending import BENDS
from rangesfm.solver.posterior import MAX_NUM_OBSERVATIONS, Observations, Posterior

RANGES = "ranges"


@dataclass(frozen=True)
class BinnedRanges(Observations):
    """Ranges in bins, about a solution of their problem; the biases of anchors are among their errors.

    Attributes:
        bins: of the ranges.
    """

    bins: RangeBins = field(kw_only=True)


def binned_ranges(
    posed: ScaleProblem,
    solution: Solution,
    max_num_bins: int = MAX_NUM_OBSERVATIONS,
    noise_m: float | None = None,
) -> BinnedRanges:
    """Average the ranges of a problem, and linearise them about its solution.

    Lengths between points and known positions in the problem, which help to solve it, are observations of their own
    here.

    Args:
        max_num_bins: fewer bins are coarser and take less time.
        noise_m: standard deviation of single ranges; None: that of the solution.
    """
    given, state, errors = without_others(posed.ranges), solution.fit.state, solution.errors
    unbiased = replace(state, bias_m=given.bias_mean_m)
    only_map = replace(given, bias_stddev_m=np.zeros(given.num_anchors), stddev_m=np.ones(len(given.range_m)))
    columns, bins = columns_of([only_map])[0], _bins(posed, solution, max_num_bins)
    robust = solution.fit.weights / errors.stddev_m**2
    gradient, on_path = range_gradient(posed.ranges, state), posed.observations.on_path(posed.rows)
    slopes = by_poses(gradient, state.metric_from_model, posed.model_from_cam, given.tag_from_center, on_path)
    components = radio_components(
        bins, posed.curve_stddev_m, ruled_out(solution.problem), _others_m2(posed, solution, bins)
    )
    return BinnedRanges(
        kind=RANGES,
        columns=columns,
        design=bins.mean(range_jacobian(only_map, columns, state, state)),
        residual_m=bins.mean(predicted_ranges(given, unbiased) - given.range_m),
        by_pose=bins.by_pose(slopes, len(posed.trajectory)),
        components=widened(components, solution.noise_stddev_m if noise_m is None else noise_m),
        alone_m2=np.diag(1 / np.maximum(bins.total(robust), 1e-12)),
        is_used=np.ones(len(bins), dtype=bool),
        bins=bins,
        prior_residual=prior_residuals(only_map, columns, state),
        prior_design=prior_jacobian(only_map, columns, state, state),
    )


def without_others(problem: RangeProblem) -> RangeProblem:
    """Return the problem without lengths between points and known positions."""
    distances = problem.distances
    return replace(problem, distances=distances.subset(~distances.is_between_points), placement=None)


def _others_m2(posed: ScaleProblem, solution: Solution, bins: RangeBins) -> dict[OtherError, Array]:
    """Return the covariances of the bins due to uncertain places of the antenna, and clocks, by name; without none."""
    placed, found = solution.fit.state.metric_from_model, dict[OtherError, Array]()
    observations, velocity = posed.observations, posed.velocity
    by = range_gradient(solution.problem, solution.fit.state)
    if np.any((placing_m := posed.placing_stddev_m(placed.scale)) > 0):
        found[PLACES] = bins.shared_by_places(by.by_tag, placing_m, observations.before[posed.rows])
    if velocity is not None and observations.time_offset_stddev_s:
        rates = bins.mean(placed.scale * np.sum(by.by_tag * (velocity @ placed.rotation.T), axis=1))
        found[CLOCKS] = observations.time_offset_stddev_s**2 * np.outer(rates, rates)
    return found


def ruled_out(problem: RangeProblem) -> list[str]:
    """Return the names of bias components that are absent, because their standard deviation is 0."""
    stddevs = {"bias": float(problem.bias_stddev_m.max()), "common_bias": problem.common_bias_stddev_m}
    return [name for name, stddev in stddevs.items() if stddev == 0]


def _bins(posed: ScaleProblem, solution: Solution, max_num: int) -> RangeBins:
    problem, state = solution.problem, solution.fit.state
    by = range_gradient(problem, state)
    world_from_cam = state.metric_from_model.rotation @ posed.model_from_cam
    return range_bins(
        problem.anchor_index,
        posed.observations.log.tag_index[posed.rows],
        posed.times_s(state.metric_from_model.scale),
        by.by_tag * by.distance_m[:, None],
        np.swapaxes(world_from_cam, 1, 2),
        solution.fit.weights,
        noisiness(problem.anchor_index, solution.fit.residuals_m, problem.num_anchors),
        max_num,
    )


def moved(solution: Solution, known: Posterior) -> Solution:
    """Return the solution moved to the estimate of a posterior about it, with the same robust weights."""
    state = state_after((known.columns,), solution.fit.state, known.step)
    return replace(solution, fit=fit_at(solution.problem, state, solution.fit.weights))


def shared_errors_m(solution: Solution, learned: LearnedErrors, of_range: Indices) -> Array:
    """Return the errors (n, k) that ranges share, for k independent standard deviations.

    They are the principal axes of the learnt errors, in units of what a bin's ranges scatter by themselves; axes along
    which the errors are smaller than that are noise to the bins anyway.

    Args:
        solution: by the ranges. learned: their errors; those of the map are left out, as photos see them.
        of_range: (n,) bins of the ranges; -1 for a range that took no part, which has none of the errors.
    """
    covariance_m2 = learned.without("white", *BENDS).covariance_m2
    errors, bins = solution.errors, learned.bins
    worth = bins.total(errors.worth * solution.fit.weights / errors.stddev_m**2)
    scatter_m = 1 / np.sqrt(np.maximum(worth, 1e-12))
    variances, axes = np.linalg.eigh(covariance_m2 / np.outer(scatter_m, scatter_m))
    matters = variances > 1
    of_bins = scatter_m[:, None] * axes[:, matters] * np.sqrt(variances[matters])
    return np.where(of_range[:, None] >= 0, of_bins[of_range], 0.0)

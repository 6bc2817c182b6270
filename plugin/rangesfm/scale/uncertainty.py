"""Uncertainty of the scale: the effect of each component of the ranges' errors on it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from rangesfm.arrays import Array, Indices
from rangesfm.ranging.errors.bending import BendingOfBins, MapBending, bending_in_bins, by_poses
from rangesfm.ranging.errors.components import BENDS, CLOCKS, GIVEN, PLACES, REWEIGHTING, OtherError
from rangesfm.ranging.errors.learned import ErrorParts, ExpectedErrors, LearnedErrors, learn_errors
from rangesfm.ranging.errors.range_bins import MAX_NUM_BINS, RangeBins, noisiness, range_bins
from rangesfm.scale.linear_map import LinearMap, Solved
from rangesfm.scale.range_equation import (
    Columns,
    RangeProblem,
    RangeState,
    columns_of,
    fit_at,
    predicted_ranges,
    prior_jacobian,
    prior_residuals,
    range_gradient,
    range_jacobian,
    state_after,
)
from rangesfm.scale.scale_estimate import ScaleUncertainty
from rangesfm.scale.scale_problem import ScaleProblem
from rangesfm.scale.solution import Solution


def learned_errors(posed: ScaleProblem, solution: Solution, bending: MapBending | None = None) -> LearnedErrors:
    """Estimate the errors of the ranges from the residuals of a solution.

    Args:
        bending: of the map; None: the map is not bent.
    """
    linear, observations, velocity = _linear(posed, solution), posed.observations, posed.velocity
    of_ranges = _bins(posed, solution, MAX_NUM_BINS)
    others_m2 = _by_places(posed, solution, of_ranges)
    if velocity is not None and observations.time_offset_stddev_s:
        placed, by = solution.fit.state.metric_from_model, range_gradient(solution.problem, solution.fit.state)
        rates = of_ranges.mean(placed.scale * np.sum(by.by_tag * (velocity @ placed.rotation.T), axis=1))
        others_m2[CLOCKS] = observations.time_offset_stddev_s**2 * np.outer(rates, rates)
    return learn_errors(
        of_ranges,
        off_m=-linear.residual_m,
        design=linear.design,
        prior_design=linear.prior_design,
        noise_m=solution.noise_stddev_m,
        curve_stddev_m=posed.curve_stddev_m,
        ruled_out=ruled_out(solution.problem),
        others_m2=others_m2,
        bending=bending_of_bins(bending, of_ranges, posed, solution.fit.state),
    )


def bending_of_bins(
    bending: MapBending | None, of_ranges: RangeBins, posed: ScaleProblem, state: RangeState
) -> BendingOfBins | None:
    """Return the bending in the bins of a problem's ranges at a state; None for a map that is not bent."""
    if bending is None:
        return None
    problem, on_path = posed.ranges, posed.observations.on_path(posed.rows)
    gradient, arms_m = range_gradient(problem, state), problem.tag_from_center
    slopes = by_poses(gradient, state.metric_from_model, posed.model_from_cam, arms_m, on_path)
    return bending_in_bins(bending, of_ranges, slopes, frame_is_free=problem.frame_is_free)


def _linear(posed: ScaleProblem, solution: Solution) -> LinearMap:
    """Return the linear equations of the single ranges about a solution; biases are among the errors here."""
    given, state = posed.ranges, solution.fit.state
    unbiased = replace(state, bias_m=given.bias_mean_m)
    only_map = replace(given, bias_stddev_m=np.zeros(given.num_anchors), stddev_m=np.ones(len(given.range_m)))
    columns = columns_of([only_map])[0]
    return LinearMap(
        predicted_ranges(given, unbiased) - given.range_m,
        range_jacobian(only_map, columns, state, state),
        prior_residuals(only_map, columns, state),
        prior_jacobian(only_map, columns, state, state),
        columns,
    )


def errors_to_expect(
    posed: ScaleProblem,
    solution: Solution,
    stddevs: Mapping[str, float],
    max_num_bins: int = MAX_NUM_BINS,
) -> LearnedErrors:
    """Return the errors to expect before anything is measured, from what is usual for radios; the map is not bent.

    Args:
        stddevs: by name, standard deviations of components of which more is known.
        max_num_bins: fewer bins are coarser and take less time.
    """
    of_ranges = _bins(posed, solution, max_num_bins)
    placed_m2 = _by_places(posed, solution, of_ranges)
    return ExpectedErrors.of(of_ranges, posed.curve_stddev_m, ruled_out(solution.problem), placed_m2).usual(stddevs)


def _by_places(posed: ScaleProblem, solution: Solution, of_ranges: RangeBins) -> dict[OtherError, Array]:
    """Return the bins' covariance due to uncertain antenna places, by name; empty where places are certain."""
    placing_m = posed.placing_stddev_m(solution.fit.state.metric_from_model.scale)
    if not np.any(placing_m > 0):
        return {}
    towards = range_gradient(solution.problem, solution.fit.state).by_tag
    return {PLACES: of_ranges.shared_by_places(towards, placing_m, posed.observations.before[posed.rows])}


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


@dataclass(frozen=True)
class KnownMap:
    """Uncertainty of a map as a whole and of its anchors.

    Attributes:
        uncertainty: of the scale.
        covariance: (p, p) of the scale's logarithm, the map's turn and shift, and the anchors, as in ``columns``.
        half_way: (p,) step of the unknowns from where the map is to the middle between two estimates, to which
            everything else refers.
        best_by_bins: (c,) change of the scale's logarithm, with the best weights, per metre that each bin is longer.
    """

    uncertainty: ScaleUncertainty
    covariance: Array
    columns: Columns
    half_way: Array
    best_by_bins: Array

    @classmethod
    def of(cls, best: Solved, learned: ErrorParts, formal: float, columns: Columns, half_way: Array) -> KnownMap:
        """Return what is known at the middle between two estimates, which are twice ``half_way`` (p,) apart."""
        of_bins, of_priors = best.gains
        components = learned.stddev_of_bins(of_bins[0])
        if (given := float(np.linalg.norm(of_priors[0]))) > 0:
            components[GIVEN] = given
        components[REWEIGHTING] = abs(float(half_way[0]))
        covariance = best.covariance + np.outer(half_way, half_way)
        return cls(ScaleUncertainty(formal, components), covariance, columns, half_way, of_bins[0])

    @classmethod
    def between(
        cls,
        linear: LinearMap,
        learned: ErrorParts,
        formal: float,
        by_others: Array,
        change_by_others: Array | None = None,
    ) -> KnownMap:
        """Combine the estimate with the best weights for the errors and the estimate with other weights.

        Best weights (Gauss-Markov) are only as good as the model of the errors, which real radios do not always follow.
        Robust weights depend less on the model. The truth is taken to be equally likely at either estimate: the map is
        best placed half-way between them, and its interval is wider by as much. The variance of the difference is the
        difference of the variances (Hausman, "Specification tests in econometrics", 1978). A difference of the scale of
        more than one standard deviation is evidence against the model, so only one standard deviation of it is used.

        Args:
            formal: relative standard deviation of the scale, as if all ranges erred independently.
            by_others: (p, p) covariance of the unknowns with the other weights.
            change_by_others: (p,) change from the estimate with the best weights, at which the map is, to the estimate
                with the other weights; None: the map is at the estimate with the other weights.
        """
        best = linear.solved(learned.covariance_m2)
        change = best.step if change_by_others is None else change_by_others
        chance = chance_differences(by_others, best.covariance)[0]
        # The whole step is shortened, because a shorter one of the scale alone would not fit the anchors' places.
        share = min(1.0, chance / max(abs(float(change[0])), 1e-300))
        return cls.of(best, learned, formal, linear.columns, share * change / 2)

    def moved(self, solution: Solution) -> Solution:
        """Return the solution from which this was computed, moved half-way, with the same robust weights."""
        state = state_after((self.columns,), solution.fit.state, self.half_way)
        return replace(solution, fit=fit_at(solution.problem, state, solution.fit.weights))


def chance_differences(by_others: Array, by_best: Array) -> Array:
    """Return the (p,) standard deviations of the difference of two estimates with these covariances (p, p)."""
    return np.sqrt(np.maximum(np.diag(by_others - by_best), 0.0))


def known_map(
    posed: ScaleProblem,
    solution: Solution,
    learned: LearnedErrors,
    bending: BendingOfBins | None = None,
    shared_m: Array | None = None,
) -> KnownMap:
    """Return the uncertainty of a map at the solution of its ranges with robust weights.

    Args:
        posed: its measured lengths must have the uncertainty that the map's bending gives them.
        bending: of a refined map, in its bins; None: the map was scaled as one piece.
        shared_m: (n, k) errors of the ranges that a refinement took for shared ones, as ``shared_errors_m``.
    """
    errors, bins, given = solution.errors, learned.bins, posed.ranges
    linear, robust = linear_map(posed, solution, bins), solution.fit.weights / errors.stddev_m**2
    bent_m2 = np.zeros_like(learned.covariance_m2) if bending is None else bending.formal_m2
    alone, weighed = (np.diag(1 / np.maximum(bins.total(each), 1e-12)) for each in (robust, errors.worth * robust))
    formal = solution.fit.log_scale_stddev
    if bending is not None:
        formal = float(np.sqrt(linear.solved(alone + bent_m2).covariance[0, 0]))
    shared = np.zeros((len(bins), 0)) if shared_m is None else bins.mean(shared_m)
    assumed_m2 = weighed + bent_m2 + bias_covariance(bins, given) + shared @ shared.T
    by_others, _ = linear.with_weights(assumed_m2, learned.covariance_m2)
    at_optimum = linear if bending is None else replace(linear, residual_m=linear.residual_m + bending.shift_m)
    return KnownMap.between(at_optimum, learned, formal, by_others)


def linear_map(posed: ScaleProblem, solution: Solution, bins: RangeBins) -> LinearMap:
    """Return the linear equations of bins of a problem's ranges about its solution."""
    linear = _linear(posed, solution)
    return replace(linear, residual_m=bins.mean(linear.residual_m), design=bins.mean(linear.design))


def bias_covariance(bins: RangeBins, given: RangeProblem) -> Array:
    """Return the (c, c) covariance of bins by the priors of the anchors' biases."""
    index = bins.anchor_index
    return np.asarray(
        given.bias_stddev_m[index] ** 2 * (index[:, None] == index) + given.common_bias_stddev_m**2, dtype=np.float64
    )


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

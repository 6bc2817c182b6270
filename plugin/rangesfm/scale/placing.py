"""Where the map lies in the site, given its scale: by all that the survey has learnt of its ranges' errors."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rangesfm.arrays import Array
from rangesfm.ranging.errors.learned import LearnedErrors
from rangesfm.scale.range_equation import (
    RangeProblem,
    RangeState,
    columns_of,
    fit_at,
    predicted_ranges,
    prior_jacobian,
    prior_residuals,
    range_jacobian,
    state_after,
)
from rangesfm.scale.solution import Solution

_NUM_STEPS = 5


@dataclass(frozen=True)
class Placing:
    """A solution at its best place.

    Attributes:
        solution: with rotation, translation, anchors and biases by generalised least squares.
        frame_covariance: (6, 6) of a turn of the world (rad) about its origin and a shift (m).
    """

    solution: Solution
    frame_covariance: Array


def place_in_site(solution: Solution, learned: LearnedErrors, relative_scale_stddev: float) -> Placing:
    """Generalised least squares with the scale held.

    The scale itself comes from plainer weights: on real radios it errs less so, as it hangs on the contrasts between
    ranges that their errors' model knows least of, while biases and antennas are what moves a map as a whole.

    Args:
        solution: in the site frame.
    """
    problem, fit = solution.problem, solution.fit
    only_map = without_biases(problem)
    (columns,) = columns_of([only_map])
    state = replace(fit.state, bias_m=problem.bias_mean_m)
    weight = np.linalg.inv(learned.covariance_m2 + 1e-10 * np.eye(len(learned.cells)))
    rest = np.setdiff1d(np.arange(columns.num), [columns.scale])
    for _ in range(_NUM_STEPS):
        design = learned.cells.mean(range_jacobian(only_map, columns, state, state))
        off = learned.cells.mean(problem.range_m - predicted_ranges(problem, state))
        of_priors = prior_jacobian(only_map, columns, state, state)
        information = design.T @ weight @ design + of_priors.T @ of_priors
        pull = design.T @ weight @ off - of_priors.T @ prior_residuals(only_map, columns, state)
        step = np.zeros(columns.num)
        step[rest] = np.linalg.lstsq(information[np.ix_(rest, rest)], pull[rest], rcond=1e-12)[0]
        state = state_after([columns], state, step)
    off = learned.cells.mean(problem.range_m - predicted_ranges(problem, state))
    state = replace(state, bias_m=problem.bias_mean_m + learned.biases_m(weight @ off, problem.num_anchors))
    inverse = np.linalg.pinv(information[np.ix_(rest, rest)], rcond=1e-12, hermitian=True)
    by_scale = -inverse @ information[rest, columns.scale]
    covariance = inverse + np.outer(by_scale, by_scale) * relative_scale_stddev**2
    frame = np.searchsorted(rest, columns.frame) + np.arange(6)
    placed = fit_at(problem, state, solution.errors.loss)
    return Placing(replace(solution, fit=placed), covariance[np.ix_(frame, frame)])


def without_biases(problem: RangeProblem) -> RangeProblem:
    """The same unknowns of the map; ranges in metres, their biases among their errors."""
    ones = np.ones(len(problem.range_m))
    return replace(problem, bias_stddev_m=np.zeros(problem.num_anchors), stddev_m=ones, share=None)

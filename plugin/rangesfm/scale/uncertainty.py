"""How wrong the scale may be: what each component of the ranges' errors does to it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from rangesfm.arrays import Array
from rangesfm.ranging.errors.cells import MAX_NUM_CELLS, Cells, cells, noisiness
from rangesfm.ranging.errors.components import GIVEN
from rangesfm.ranging.errors.learned import LearnedErrors, learn_errors, usual_errors
from rangesfm.ranging.observations import RangeObservations
from rangesfm.scale.estimate import ScaleUncertainty
from rangesfm.scale.problem import ScaleProblem
from rangesfm.scale.range_equation import (
    RangeFit,
    RangeProblem,
    RangeState,
    columns_of,
    invert_information,
    predicted_ranges,
    prior_jacobian,
    range_gradient,
    range_jacobian,
)
from rangesfm.scale.solution import Solution

# Where ranges have no times: a path of so many metres is walked in a second.
_WALKING_M_PER_S = 1.0


def learned_errors(
    posed: ScaleProblem, solution: Solution, observations: RangeObservations, model_from_cam: Array
) -> LearnedErrors:
    """What the residuals of a solution say of the ranges' errors.

    Args:
        model_from_cam: (n, 3, 3) rotation of the camera at each range, into the world of the problem.
    """
    problem, state, log = solution.problem, solution.fit.state, observations.log
    unbiased = replace(state, bias_m=problem.bias_mean_m)
    ones = np.ones(len(problem.range_m))
    # Biases are among the errors here.
    only_map = replace(problem, bias_stddev_m=np.zeros(problem.num_anchors), stddev_m=ones, share=None)
    columns = columns_of([only_map])[0]
    taken_off = log.shared_stddev_m
    return learn_errors(
        _cells(posed, solution, observations, model_from_cam),
        off_m=problem.range_m - predicted_ranges(problem, unbiased),
        design=range_jacobian(only_map, columns, state, state),
        prior_design=prior_jacobian(only_map, columns, state, state),
        noise_m=solution.noise_stddev_m,
        curve_stddev_m=None if taken_off is None else taken_off[posed.rows],
        ruled_out=_ruled_out(problem),
    )


def errors_to_expect(
    posed: ScaleProblem,
    solution: Solution,
    observations: RangeObservations,
    model_from_cam: Array,
    stddevs: Mapping[str, float],
    max_num_cells: int = MAX_NUM_CELLS,
) -> LearnedErrors:
    """The same before anything is measured, as radios let expect.

    Args:
        stddevs: of components of which more is known, by name.
        max_num_cells: fewer are coarser, and sooner computed.
    """
    taken_off = observations.log.shared_stddev_m
    return usual_errors(
        _cells(posed, solution, observations, model_from_cam, max_num_cells),
        curve_stddev_m=None if taken_off is None else taken_off[posed.rows],
        ruled_out=_ruled_out(solution.problem),
        stddevs=stddevs,
    )


def _ruled_out(problem: RangeProblem) -> list[str]:
    """Biases of a stddev of 0 are none."""
    stddevs = {"bias": float(problem.bias_stddev_m.max()), "common_bias": problem.common_bias_stddev_m}
    return [name for name, stddev in stddevs.items() if stddev == 0]


def _cells(
    posed: ScaleProblem,
    solution: Solution,
    observations: RangeObservations,
    model_from_cam: Array,
    max_num: int = MAX_NUM_CELLS,
) -> Cells:
    problem, state, log = solution.problem, solution.fit.state, observations.log
    by = range_gradient(problem, state)
    world_from_cam = state.metric_from_model.rotation @ model_from_cam
    return cells(
        problem.anchor_index,
        log.tag_index[posed.rows],
        _times(posed, problem, state, observations),
        by.by_tag * by.distance_m[:, None],
        np.swapaxes(world_from_cam, 1, 2),
        solution.fit.weights,
        noisiness(problem.anchor_index, solution.fit.residuals_m, problem.num_anchors),
        max_num,
    )


def _times(posed: ScaleProblem, problem: RangeProblem, state: RangeState, observations: RangeObservations) -> Array:
    """(n,) seconds; where the log names photos, by the way from photo to photo."""
    if observations.log.timestamp_s is not None:
        return observations.log.timestamp_s[posed.rows]
    _, first, of_range = np.unique(observations.before[posed.rows], return_index=True, return_inverse=True)
    steps_m = np.linalg.norm(np.diff(state.metric_from_model.scale * problem.centers[first], axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps_m)])[of_range] / _WALKING_M_PER_S


def scale_uncertainty(solution: Solution, learned: LearnedErrors, bending_of_lengths: float = 0.0) -> ScaleUncertainty:
    """Relative stddevs of the scale.

    Args:
        bending_of_lengths: relative, of the scale by measured lengths.
    """
    components = learned.stddev_of(scale_influence(solution.fit, solution.problem))
    given = np.hypot(_by_what_was_given(solution), _say_of_lengths(solution) * bending_of_lengths)
    if given > 0:
        components[GIVEN] = float(given)
    return ScaleUncertainty(formal=solution.fit.log_scale_stddev, components=components)


def _say_of_lengths(solution: Solution) -> float:
    """By how much the scale changes, relative to a change of all lengths between points."""
    distances, fit = solution.problem.distances, solution.fit
    if distances is None:
        return 0.0
    of_points = distances.subset(distances.is_between_points)
    slopes = fit.state.metric_from_model.scale * of_points.model_length / of_points.stddev_m
    return float(invert_information(fit.information)[0, 0] * (slopes @ slopes))


def _by_what_was_given(solution: Solution) -> float:
    """What taped distances, positions of anchors and the upward direction do to the scale by not being exact.

    Biases are among the ranges' errors. All priors weigh as against independent ranges: their stddevs were divided by
    the inflation.
    """
    fit = solution.fit
    given = fit.prior_information.copy()
    biases = fit.columns[0].bias[fit.columns[0].bias >= 0]
    given[biases] = given[:, biases] = 0.0
    to_scale = np.linalg.lstsq(fit.information, np.eye(len(fit.information))[0], rcond=1e-12)[0]
    return float(solution.errors.inflation * np.sqrt(max(to_scale @ given @ to_scale, 0.0)))


def parameter_covariance(fit: RangeFit, problem: RangeProblem, learned: LearnedErrors) -> Array:
    """(p, p) of all that a fit estimates, in the parameters of its columns: what the ranges' errors do to it."""
    of_cells = parameter_influence(fit, problem, learned)
    inverse = invert_information(fit.information)
    of_priors = inverse @ fit.prior_information @ inverse
    covariance: Array = of_cells @ learned.covariance_m2 @ of_cells.T + of_priors
    return covariance


def parameter_influence(fit: RangeFit, problem: RangeProblem, learned: LearnedErrors) -> Array:
    """(p, c) change of all that a fit estimates for each metre by which the ranges of a cell are longer."""
    influence = np.linalg.lstsq(fit.information, fit.gradients.T, rcond=1e-12)[0] / problem.stddev_m
    return np.stack([learned.cells.total(row) for row in influence])


def scale_influence(fit: RangeFit, problem: RangeProblem) -> Array:
    """(n,) relative change of the scale for each metre by which a range is longer."""
    to_scale = np.linalg.lstsq(fit.information, np.eye(len(fit.information))[0], rcond=1e-12)[0]
    influence: Array = fit.gradients @ to_scale / problem.stddev_m
    return influence

"""Sensitivity of the scale to errors of the range model and to leaving out short ranges.

Leaving out short ranges tests the radio without any ground truth.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rangesfm.arrays import Array
from rangesfm.scale.range_equation import predicted_ranges, range_gradient, solve
from rangesfm.scale.scale_estimate import CutoffTest, ScaleSensitivity
from rangesfm.scale.solution import Solution
from rangesfm.scale.starts import spread_subset
from rangesfm.scale.uncertainty import scale_influence

_CM = 0.01
# Ranges must be shorter than the median by this factor to count as the shorter half: rounding spreads equal ranges.
_SHORTER = 1 - 1e-9
_CUTOFFS_M = (0.0, 1.0, 1.5, 2.0, 2.5, 3.0)
_MAX_RANGES_PER_ANCHOR = 1000
_MIN_RANGES_PER_ANCHOR = 20
_MIN_SHARE = 0.4
# Two-sided 99 % quantile of the normal distribution.
_SIGNIFICANT = 2.58
# Smallest standard deviation of a change of the scale, as a share of the standard deviation after leaving out ranges.
# With robust weights the difference of two variances is uncertain, and may be too small.
_MIN_NEW_SHARE = 0.2


def scale_sensitivity(solution: Solution, model_from_cam: Array, anchor_ids: tuple[str, ...]) -> ScaleSensitivity:
    """Return the changes of the scale in percent, to first order.

    Args:
        model_from_cam: (n, 3, 3) rotation of the camera at each range, into the problem's model world.
    """
    problem, state = solution.problem, solution.fit.state

    influence = scale_influence(solution.fit, problem)

    def percent(range_error_m: Array) -> float:
        return 100 * float(influence @ range_error_m)

    distance = predicted_ranges(problem, state)
    world_from_cam = state.metric_from_model.rotation @ model_from_cam
    along_x, along_y, along_z = range_gradient(problem, state).by_tag_in_cam(world_from_cam).T
    return ScaleSensitivity(
        common_bias_per_cm=percent(np.full(len(distance), _CM)),
        short_range_per_cm=percent(np.where(distance < _SHORTER * np.median(distance), _CM, 0.0)),
        anchor_bias_per_cm={
            anchor_id: percent(np.where(problem.anchor_index == k, _CM, 0.0)) for k, anchor_id in enumerate(anchor_ids)
        },
        range_slope_per_percent=percent(0.01 * distance),
        # A tag further out than assumed lengthens the measured ranges, which then stretch the map.
        lever_arm_per_cm=(percent(_CM * along_x), percent(_CM * along_y), percent(_CM * along_z)),
    )


def cutoff_test(solution: Solution) -> tuple[CutoffTest, ...]:
    """Estimate the scale for increasing minimum ranges, as long as enough ranges are left.

    Short ranges are weighted like all others here, so that their error becomes visible.
    """
    noise = np.sqrt(np.maximum(solution.errors.stddev_m**2 - solution.errors.shared_m**2, 1e-18))
    problem = spread_subset(replace(solution.problem, stddev_m=noise), _MAX_RANGES_PER_ANCHOR)
    thinning = len(solution.problem.range_m) / len(problem.range_m)
    # The squared inflation decreases with thinning by the same factor as the number of ranges.
    inflation = max(solution.errors.inflation / np.sqrt(thinning), 1.0)
    heard = np.unique(problem.anchor_index)
    tests: list[CutoffTest] = []
    for cutoff in _CUTOFFS_M:
        rows = np.flatnonzero(problem.range_m >= cutoff)
        left = np.bincount(problem.anchor_index[rows], minlength=problem.num_anchors)
        is_enough = len(rows) >= _MIN_SHARE * len(problem.range_m) and np.all(left[heard] >= _MIN_RANGES_PER_ANCHOR)
        if tests and (len(rows) == len(problem.range_m) or not is_enough):
            continue
        fit = solve(problem.subset(rows), solution.fit.state, tolerance=1e-8)
        scale = fit.state.metric_from_model.scale
        tests.append(CutoffTest(cutoff, scale, scale * fit.log_scale_stddev * inflation))
    return tuple(tests)


def scale_drift(tests: tuple[CutoffTest, ...]) -> CutoffTest | None:
    """Return the test whose scale differs most from that with all ranges; None if no difference is significant.

    The ranges that both estimates use make both err alike, so the variance of the difference is the difference of the
    variances (Hausman, "Specification tests in econometrics", 1978).
    """
    drifted: list[tuple[float, CutoffTest]] = []
    for test in tests[1:]:
        variance = max(test.stddev**2 - tests[0].stddev ** 2, (_MIN_NEW_SHARE * test.stddev) ** 2)
        change = abs(test.scale - tests[0].scale)
        if change > _SIGNIFICANT * np.sqrt(variance):
            drifted.append((change, test))
    return max(drifted, key=lambda pair: pair[0], default=(0.0, None))[1]

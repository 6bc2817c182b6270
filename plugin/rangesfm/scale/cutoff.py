"""Whether the scale moves as short ranges are left out: a test of the radio without any truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rangesfm.arrays import Indices
from rangesfm.scale.estimate import CutoffTest
from rangesfm.scale.range_equation import RangeProblem, solve
from rangesfm.scale.solution import Solution
from rangesfm.scale.starts import spread_subset

_CUTOFFS_M = (0.0, 1.0, 1.5, 2.0, 2.5, 3.0)
_MAX_RANGES_PER_ANCHOR = 1000
_MIN_RANGES_PER_ANCHOR = 20
_MIN_SHARE = 0.4
# Of two-sided normal errors one in a hundred is larger.
_SIGNIFICANT = 2.58
# Of the stddev that leaving out adds, in stddevs: robust weights make it less than certain.
_MIN_NEW_SHARE = 0.2


def cutoff_test(solution: Solution) -> tuple[CutoffTest, ...]:
    """The scale for each least range, as long as enough ranges are left.

    Short ranges weigh as much as others here, so that their error shows.
    """
    noise = np.sqrt(np.maximum(solution.errors.stddev_m**2 - solution.errors.shared_m**2, 1e-18))
    problem = spread_subset(replace(solution.problem, stddev_m=noise), _MAX_RANGES_PER_ANCHOR)
    thinning = len(solution.problem.range_m) / len(problem.range_m)
    # Thinned ranges are less correlated by as much as there are fewer of them.
    inflation = max(solution.errors.inflation / np.sqrt(thinning), 1.0)
    tests: list[CutoffTest] = []
    for cutoff in _CUTOFFS_M:
        rows = np.flatnonzero(problem.range_m >= cutoff)
        if tests and (len(rows) == len(problem.range_m) or not _enough(problem, rows)):
            continue
        fit = solve(problem.subset(rows), solution.fit.state, tolerance=1e-8)
        scale = fit.state.metric_from_model.scale
        tests.append(CutoffTest(cutoff, scale, scale * fit.log_scale_stddev * inflation))
    return tuple(tests)


def scale_drift(tests: tuple[CutoffTest, ...]) -> CutoffTest | None:
    """The test whose scale is farthest from that with all ranges, of those where it is by more than chance.

    Ranges that both share make both err alike, so the variance of a difference is that of the variances
    (Hausman, "Specification tests in econometrics", 1978).
    """
    drifted: list[tuple[float, CutoffTest]] = []
    for test in tests[1:]:
        variance = max(test.stddev**2 - tests[0].stddev ** 2, (_MIN_NEW_SHARE * test.stddev) ** 2)
        change = abs(test.scale - tests[0].scale)
        if change > _SIGNIFICANT * np.sqrt(variance):
            drifted.append((change, test))
    return max(drifted, key=lambda pair: pair[0], default=(0.0, None))[1]


def _enough(problem: RangeProblem, rows: Indices) -> bool:
    heard = np.bincount(problem.anchor_index, minlength=problem.num_anchors) > 0
    left = np.bincount(problem.anchor_index[rows], minlength=problem.num_anchors)
    return bool(len(rows) >= _MIN_SHARE * len(problem.range_m) and np.all(left[heard] >= _MIN_RANGES_PER_ANCHOR))

"""Bursts of erring ranges: for seconds all ranges to an anchor err alike, and then they are right again.

Somebody stands between, an echo is taken for the signal, or a logger hangs for a moment. Single outliers differ from
the ranges right before and after. Those of a burst agree with each other, so that they would count like all others, and
a mistake of the same size at that time would explain them. They are no mistake.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy import special

from rangesfm.arrays import Indices
from rangesfm.measurements.mistakes import FALSE_ALARM_RATE, Mistake
from rangesfm.measurements.ranges.errors.components import BURSTS, LASTING_S
from rangesfm.measurements.ranges.errors.range_bins import RangeBins
from rangesfm.measurements.ranges.mistakes.effects import longest_m
from rangesfm.measurements.ranges.mistakes.linearized import Linearized
from rangesfm.measurements.ranges.mistakes.thresholds import estimates
from rangesfm.solver.noise import Component

# Most bursts that are left out. More of them are no exception, and are seen as noise.
_MAX_NUM_BURSTS = 8


def without_bursts(problem: Linearized, standing: Sequence[Mistake], mistakes: Sequence[Mistake]) -> Linearized:
    """Leave out the bursts that explain the residuals better than any mistake.

    Their ranges may then err by as much as a range can. The errors are learnt while the standing mistakes explain what
    they can.
    """
    num, windows, explaining = len(problem.bins), _windows(problem.bins), [h.columns for h in standing]
    within = np.zeros((num, len(windows)))
    for column, window in enumerate(windows):
        within[window, column] = 1.0
    threshold = float(special.chdtri(1, FALSE_ALARM_RATE / len(windows)))
    problem = problem.with_learnt_errors(explaining)
    for _ in range(_MAX_NUM_BURSTS):
        solution = problem.solution
        left = solution.left(solution.whitened(within))
        statistics = (left.T @ solution.residual / np.maximum(np.linalg.norm(left, axis=0), 1e-12)) ** 2
        best = int(np.argmax(statistics))
        if statistics[best] < threshold:
            break
        possible = (test for test in estimates(problem, mistakes) if test.is_possible)
        likeliest = max((test.statistic - test.penalty(num) for test in possible), default=0.0)
        if statistics[best] - float(np.log(num)) < likeliest:
            break
        burst = Component(BURSTS, np.diag(longest_m(problem, problem.heard) ** 2 * within[:, best]))
        problem = replace(problem, components=(*problem.components, burst)).with_learnt_errors(explaining)
    return problem


def _windows(bins: RangeBins) -> list[Indices]:
    """Return the bins of all possible bursts: consecutive ones of one anchor and tag that are over in seconds."""
    found = []
    order = np.lexsort((bins.time_s, bins.tag_index, bins.anchor_index))
    link, time_s = np.stack([bins.anchor_index, bins.tag_index])[:, order], bins.time_s[order]
    for first in range(len(order)):
        for end in range(first + 1, len(order) + 1):
            # What lasts longer than errors do that last for seconds is a mistake.
            if np.any(link[:, end - 1] != link[:, first]) or time_s[end - 1] - time_s[first] > LASTING_S:
                break
            found.append(order[first:end])
    return found

"""Bursts of erring ranges: for seconds all ranges to an anchor err alike, and then they are right again.

Somebody stands between, an echo is taken for the signal, or a logger hangs for a moment. Single outliers differ from
the ranges right before and after. Those of a burst agree with each other, so that they would count like all others, and
a mistake of the same size at that time would explain them. They are no mistake.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import special

from rangesfm.arrays import Indices
from rangesfm.measurements.ranges.errors.components import BURSTS, LASTING_S
from rangesfm.measurements.ranges.mistakes.hypothesis import longest_m
from rangesfm.measurements.ranges.mistakes.hypothesis_tests import Factorization
from rangesfm.measurements.ranges.mistakes.linearized import Linearized
from rangesfm.solver.linear_map import FALSE_ALARM_RATE
from rangesfm.solver.noise import Component


@dataclass(frozen=True)
class Burst:
    """A burst, as the residuals show it.

    Attributes:
        bins: of its ranges. statistic: chi-square distributed with one degree of freedom where there is no burst.
        threshold: of the statistic, for all possible bursts together.
    """

    bins: Indices
    statistic: float
    threshold: float


def likeliest_burst(solved: Factorization) -> Burst:
    """Return the burst that explains the residuals best."""
    windows = _windows(solved.problem)
    columns = np.zeros((len(solved.problem.bins), len(windows)))
    for column, window in enumerate(windows):
        columns[window, column] = 1.0
    left = solved.left(solved.whitened(columns, np.zeros((solved.num_priors, len(windows)))))
    statistics = (left.T @ solved.residual / np.maximum(np.linalg.norm(left, axis=0), 1e-12)) ** 2
    best = int(np.argmax(statistics))
    threshold = float(special.chdtri(1, FALSE_ALARM_RATE / len(windows)))
    return Burst(windows[best], float(statistics[best]), threshold)


def without(problem: Linearized, burst: Burst) -> Linearized:
    """Return the problem with the ranges of a burst left out: they may err by as much as a range can."""
    variances_m2 = np.bincount(burst.bins, np.full(len(burst.bins), longest_m(problem) ** 2), len(problem.bins))
    return replace(problem, components=(*problem.components, Component(BURSTS, np.diag(variances_m2))))


def _windows(problem: Linearized) -> list[Indices]:
    """Return the bins of all possible bursts: consecutive ones of one anchor and tag that are over in seconds."""
    bins, found = problem.bins, []
    order = np.lexsort((bins.time_s, bins.tag_index, bins.anchor_index))
    link, time_s = np.stack([bins.anchor_index, bins.tag_index])[:, order], bins.time_s[order]
    for first in range(len(order)):
        for end in range(first + 1, len(order) + 1):
            # What lasts longer than errors do that last for seconds is a mistake.
            if np.any(link[:, end - 1] != link[:, first]) or time_s[end - 1] - time_s[first] > LASTING_S:
                break
            found.append(order[first:end])
    return found

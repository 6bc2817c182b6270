"""Tests of all mistakes in ranges together: how much better each explains the observations than chance would."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy import special

from rangesfm.arrays import Array
from rangesfm.measurements.mistakes import FALSE_ALARM_RATE, EstimatedMistake, Mistake, estimated, noncentrality
from rangesfm.measurements.ranges.mistakes.linearized import Linearized

# Random surveys from which the thresholds come: 20 of them exceed one.
_NUM_DRAWS = 1000


def judged(problem: Linearized, mistakes: Sequence[Mistake], seed: int) -> list[EstimatedMistake]:
    """Estimate each mistake alone, with thresholds that hold for all together."""
    tests = estimates(problem, mistakes)
    thresholds = _thresholds([t.basis for t in tests], np.array([t.num for t in tests]), seed)
    return [replace(t, threshold=threshold) for t, threshold in zip(tests, thresholds.tolist(), strict=True)]


def estimates(problem: Linearized, mistakes: Sequence[Mistake]) -> list[EstimatedMistake]:
    """Estimate each mistake alone, with its effect on the places of the tags, without thresholds."""
    place = problem.place.reshape(-1, problem.columns.num)
    # Quadratic form of the path's mean square displacement in the unknowns.
    of_place = place.T @ place / len(problem.place)

    def effect_on_place_m(found: EstimatedMistake) -> float:
        if not found.is_seen:
            return np.inf
        of_unit = found.by_unknowns @ found.root
        worst = np.linalg.eigvalsh(of_unit.T @ of_place @ of_unit)[-1]
        return float(np.sqrt(noncentrality(found.num) * max(worst, 0.0)))

    return [replace(each, effect_on_place_m=effect_on_place_m(each)) for each in estimated(problem, mistakes)]


def _thresholds(bases: Sequence[Array], nums: Array, seed: int) -> Array:
    """Return thresholds (h,) with which all tests together keep their false alarm rate (Westfall and Young, 1993).

    It comes from random residuals without a mistake, and the smallest p-value of all tests for each.
    """
    draws = np.random.default_rng(seed).standard_normal((_NUM_DRAWS, len(bases[0])))
    projected = (draws @ np.hstack(bases)) ** 2
    ends = np.cumsum(nums)
    statistics = np.add.reduceat(np.hstack([projected, np.zeros((_NUM_DRAWS, 1))]), np.append(ends - nums, ends[-1]), 1)
    statistics = np.where(nums > 0, statistics[:, :-1], 0.0)
    smallest = np.ones(_NUM_DRAWS)
    for num in np.unique(nums[nums > 0]):
        smallest = np.minimum(smallest, special.chdtrc(num, statistics[:, nums == num].max(axis=1)))
    alpha = float(np.quantile(smallest, FALSE_ALARM_RATE))
    of_num = {num: special.chdtri(num, alpha) if num else np.inf for num in np.unique(nums).tolist()}
    return np.array([of_num[num] for num in nums.tolist()])


def overlap(first: EstimatedMistake, second: EstimatedMistake) -> float:
    """Return how much of the smaller mistake the other explains; 1: all of it, so that nothing tells them apart."""
    if not first.num or not second.num:
        return 0.0
    return float(np.linalg.norm(first.basis.T @ second.basis) / np.sqrt(min(first.num, second.num)))

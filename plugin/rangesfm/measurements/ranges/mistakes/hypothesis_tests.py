"""Tests of all hypotheses together: how much better each explains the observations than chance would."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import special

from rangesfm.arrays import Array
from rangesfm.measurements.mistake_words import mistake_in_words
from rangesfm.measurements.ranges.mistakes.hypothesis import Hypothesis
from rangesfm.measurements.ranges.mistakes.linearized import Linearized
from rangesfm.solver.linear_map import FALSE_ALARM_RATE, EstimatedMistake, noncentrality
from rangesfm.solver.mistakes import HiddenMistake, MistakeTest, row_of_mistake

# Random surveys from which the thresholds come: 20 of them exceed one.
_NUM_DRAWS = 1000


@dataclass(frozen=True)
class Test(EstimatedMistake):
    """The result of the test of one hypothesis.

    Attributes:
        threshold: of the statistic, for all hypotheses together.
        redundancy: how much of the mistake the other observations check, 0 to 1.
        effect_on_place_m: largest effect of an undetected mistake of the smallest detectable size.
    """

    hypothesis: Hypothesis
    threshold: float
    redundancy: float
    effect_on_place_m: float

    @property
    def log_scale_by_unit(self) -> float:
        """Largest change of the scale's logarithm per unit of the mistake, also where none is found."""
        return float(np.linalg.norm(self.by_unknowns[0]))

    def penalty(self, num_bins: int) -> float:
        """Return the cost of the numbers that a hypothesis may choose (Schwarz, 1978)."""
        return self.num * float(np.log(num_bins))

    @property
    def is_possible(self) -> bool:
        """True if a mistake of the estimated size is possible."""
        return self.hypothesis.can_be(self.sizes)

    @property
    def is_checked(self) -> bool:
        """True if some mistake of this kind that is possible would be found."""
        return self.smallest_detectable <= self.hypothesis.most

    @property
    def is_rejected(self) -> bool:
        """True if the estimated size is possible and chance alone does not explain the observations."""
        return self.is_possible and self.statistic > self.threshold


def judged(problem: Linearized, hypotheses: Sequence[Hypothesis], seed: int) -> list[Test]:
    """Test all hypotheses, with thresholds that hold for all together."""
    tests = estimates(problem, hypotheses)
    thresholds = _thresholds([t.basis for t in tests], np.array([t.num for t in tests]), seed)
    return [replace(t, threshold=threshold) for t, threshold in zip(tests, thresholds.tolist(), strict=True)]


def estimates(problem: Linearized, hypotheses: Sequence[Hypothesis]) -> list[Test]:
    """Test all hypotheses without thresholds."""
    solution, place = problem.solution, problem.place.reshape(-1, problem.columns.num)
    # Quadratic form of the path's mean square displacement in the unknowns.
    of_place = place.T @ place / len(problem.place)
    found = solution.mistakes([each.columns for each in hypotheses])
    effects = (each.columns[: len(problem.bins)] if each.seen is None else each.seen for each in hypotheses)
    seen = np.split(solution.whitened(*effects), np.cumsum([h.num for h in hypotheses])[:-1], axis=1)
    return [
        Test(
            **vars(one),
            hypothesis=hypothesis,
            threshold=np.inf,
            redundancy=one.redundancy_against(on_known_map),
            effect_on_place_m=_effect_on_place_m(one, of_place),
        )
        for hypothesis, one, on_known_map in zip(hypotheses, found, seen, strict=True)
    ]


def _effect_on_place_m(found: EstimatedMistake, of_place: Array) -> float:
    if not found.is_seen:
        return np.inf
    of_unit = found.by_unknowns @ found.root
    worst = np.linalg.eigvalsh(of_unit.T @ of_place @ of_unit)[-1]
    return float(np.sqrt(noncentrality(found.num) * max(worst, 0.0)))


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


def overlap(first: Test, second: Test) -> float:
    """Return how much of the smaller hypothesis the other explains; 1: all of it, so that nothing tells them apart."""
    if not first.num or not second.num:
        return 0.0
    return float(np.linalg.norm(first.basis.T @ second.basis) / np.sqrt(min(first.num, second.num)))


def row_of(test: Test) -> MistakeTest:
    """Return the row of the table; an impossible estimate is shown without its size."""
    hypothesis, words, shown = test.hypothesis, "", test
    if not test.is_possible:
        shown = replace(test, statistic=0.0)
        name, unit = " ".join(hypothesis.key).strip(), hypothesis.unit.replace("1", "")
        most = f"{hypothesis.most:.2g} {unit}".rstrip()
        words = f"no {name} that can happen ({most} at most) explains the ranges"
    row = row_of_mistake(
        *hypothesis.key,
        shown,
        test.threshold if np.isfinite(test.threshold) else 0.0,
        words or hypothesis.words(test.sizes),
        hypothesis.remedy,
        hypothesis.unit,
    )
    if words:
        row = replace(row, size=np.nan, stddev=np.nan)
    place_m, redundancy = test.effect_on_place_m, test.redundancy
    return replace(row, effect_on_place_m=place_m, redundancy=redundancy, is_checked=test.is_checked)


def hidden_among(tests: Iterable[Test]) -> tuple[HiddenMistake, ...]:
    """Return the mistakes behind tests, without those whose usual size is already in the interval of the scale."""
    return tuple(
        HiddenMistake(
            words=mistake_in_words(*test.hypothesis.key),
            slope=test.effect_on_log_scale / float(np.sqrt(noncentrality(max(test.num, 1)))),
            threshold=test.threshold,
            num=test.num,
            most=test.log_scale_by_unit * test.hypothesis.most_unnoticed,
        )
        for test in tests
        if not test.hypothesis.is_in_interval
    )

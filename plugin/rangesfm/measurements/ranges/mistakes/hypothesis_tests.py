"""Tests of all hypotheses together: how much better each explains the observations than chance would."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import special
from scipy.linalg import solve_triangular

from rangesfm.arrays import Array
from rangesfm.measurements.mistake_words import mistake_in_words
from rangesfm.measurements.ranges.mistakes.hypothesis import Hypothesis
from rangesfm.measurements.ranges.mistakes.linearized import Linearized
from rangesfm.solver.linear_map import FALSE_ALARM_RATE, EstimatedMistake, Solved, noncentrality
from rangesfm.solver.mistakes import HiddenMistake, MistakeTest, row_of_mistake
from rangesfm.util.geometry.numerics import UNDETERMINED

# Random surveys from which the thresholds come: 20 of them exceed one.
_NUM_DRAWS = 1000


@dataclass(frozen=True)
class Test(EstimatedMistake):
    """The result of the test of one hypothesis.

    Attributes:
        threshold: of the statistic, for all hypotheses together.
        redundancy: how much of the mistake the other observations check, 0 to 1: the share of its information in the
            ranges that the unknowns leave, in the worst direction (Baarda's redundancy number, for several numbers).
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


class Factorization(Solved):
    """The solution of a problem, with the tests of all mistakes in it."""

    def __init__(self, problem: Linearized):
        super().__init__(problem.noise.covariance_m2, problem.jacobian, problem.residual)
        self.problem = problem
        # Quadratic form of the path's mean square displacement in the unknowns.
        place = problem.place.reshape(-1, problem.columns.num)
        self._place = place.T @ place / len(problem.place)

    def deviance(self, explained: float = 0.0) -> float:
        """Return -2 times the log-likelihood of observations and errors, up to a constant.

        It compares two explanations of the same bins, each with the errors that it leaves.

        Args:
            explained: the part of the sum of squares that a mistake explains, its statistic.
        """
        return (
            float(self.residual @ self.residual)
            - explained
            + 2 * float(np.sum(np.log(np.diag(self.lower))))
            + self.problem.unlikeliness
        )

    def step_with(self, mistake: Array) -> Array:
        """Return the (p,) step from the state to the likeliest one, given the effect (c + r,) of a mistake."""
        return self.step - self.by_unknowns(self.whitened(mistake[:, None]))[:, 0]

    def test(self, hypotheses: Sequence[Hypothesis], seed: int) -> list[Test]:
        """Test all hypotheses, with thresholds that hold for all together."""
        tests = self.estimates(hypotheses)
        thresholds = _thresholds([t.basis for t in tests], np.array([t.num for t in tests]), seed)
        return [replace(t, threshold=threshold) for t, threshold in zip(tests, thresholds.tolist(), strict=True)]

    def estimates(self, hypotheses: Sequence[Hypothesis]) -> list[Test]:
        """Test all hypotheses without thresholds."""
        whitened = self.whitened(np.hstack([h.columns for h in hypotheses]))
        left, by_unknowns = self.left(whitened), self.by_unknowns(whitened)
        ends = np.cumsum([h.num for h in hypotheses])
        parts = [slice(end - h.num, end) for end, h in zip(ends, hypotheses, strict=True)]
        return [
            self._test(h, whitened[:, part], left[:, part], by_unknowns[:, part])
            for h, part in zip(hypotheses, parts, strict=True)
        ]

    def _test(self, hypothesis: Hypothesis, whitened: Array, left: Array, by_unknowns: Array) -> Test:
        found, on_place, redundancy = self.estimated(whitened, left, by_unknowns), np.inf, 0.0
        if found.is_seen:
            of_unit = by_unknowns @ found.root
            worst = np.linalg.eigvalsh(of_unit.T @ self._place @ of_unit)[-1]
            on_place = float(np.sqrt(noncentrality(found.num) * max(worst, 0.0)))
            # The effect on the ranges of a map that is known.
            seen = whitened[: len(self.lower)]
            if hypothesis.seen is not None:
                seen = solve_triangular(self.lower, hypothesis.seen, lower=True)
            redundancy = _redundancy(left, seen)
        return Test(
            **vars(found), hypothesis=hypothesis, threshold=np.inf, redundancy=redundancy, effect_on_place_m=on_place
        )


def _redundancy(left: Array, seen: Array) -> float:
    """Return the smallest share, over all directions, of an effect's squared length that is left.

    Args:
        left, seen: (c + r, k) and (c, k) whitened effects, with all unknowns projected off, and with all of them known.
    """
    of_left, of_seen = left.T @ left, seen.T @ seen
    values, vectors = np.linalg.eigh(of_seen)
    if values[0] <= UNDETERMINED * values[-1]:
        return 0.0
    root = vectors / np.sqrt(values)
    return float(np.clip(np.linalg.eigvalsh(root.T @ of_left @ root)[0], 0.0, 1.0))


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

"""Search for the mistakes that were made: learn the noise, test every hypothesis and name the likeliest cause."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from rangesfm.arrays import Array
from rangesfm.measurements.ranges.mistakes.alternatives import (
    Alternative,
    Refits,
    alternatives,
    lever_arms_in_other_axes,
)
from rangesfm.measurements.ranges.mistakes.bent_path import as_given, bent_to_ranges, drifts
from rangesfm.measurements.ranges.mistakes.catalogue import STANDING
from rangesfm.measurements.ranges.mistakes.error_bursts import likeliest_burst, without
from rangesfm.measurements.ranges.mistakes.hypothesis import Effect, Hypothesis, corrected
from rangesfm.measurements.ranges.mistakes.hypothesis_tests import Factorization, Test, hidden_among, overlap
from rangesfm.measurements.ranges.mistakes.linearized import Linearized, RangesOnMap, at_other_map, at_state, linearized
from rangesfm.measurements.ranges.mistakes.timed_hypotheses import SCANNING
from rangesfm.measurements.ranges.scale.range_equation import RangeState, state_after
from rangesfm.solver.bending import WalkBending
from rangesfm.solver.mistakes import HiddenMistake
from rangesfm.util.geometry.numerics import MAX_NUM_ROUNDS

# Numbers of explanations that are tried, each with the noise that it leaves: in all, of one kind, and when no test
# exceeds its threshold.
_NUM_TRIED, _NUM_OF_KIND, _NUM_NEARLY = 6, 2, 3
# Number of alternatives that are fitted. The right one starts near its minimum, where the map itself sees the anchors.
_NUM_FITTED = 12
# Number of alternatives to which a path without points is bent; the right one is likely before, but for its bending.
_NUM_BENT = 2
# Smallest difference of scores (twice a log-likelihood, less a penalty) that tells two explanations apart.
_AS_LIKELY = 6.0
# The same where no test exceeds its threshold. By Markov's inequality a likelihood ratio is as large
# by chance in one of 100 surveys at most: the mean of each ratio is 1, and the penalty counts what is tried.
_BEYOND_CHANCE = 2 * float(np.log(100))
# Overlap of two hypotheses from which on nothing tells them apart, and most causes that are named beside the likeliest.
_SAME, _MAX_NUM_RIVALS = 0.95, 2
# Relative change of a mistake's size at which the steps to the likeliest state stop.
_SETTLED = 0.05
# Most bursts that are left out. More of them are no exception, and are seen as noise.
_MAX_NUM_BURSTS = 8


@dataclass(frozen=True)
class Cause(Alternative):
    """An explanation that is more likely than chance; its words include the size that was found.

    Attributes:
        gain: increase of twice the log-likelihood of the ranges, with the errors that are left with it.
        penalty: for the numbers or alternatives to choose from.
        state: the likeliest state of the map with it.
        test: None for an alternative.
    """

    gain: float
    penalty: float
    state: RangeState
    test: Test | None

    @property
    def score(self) -> float:
        return self.gain - self.penalty

    def undone(self, on_map: RangesOnMap) -> RangesOnMap:
        """Return the ranges as they would be without the mistake."""
        correction = self.correction if self.test is None else self.test.hypothesis.correction(self.test.sizes)
        return corrected(replace(on_map, state=self.state), correction)


@dataclass(frozen=True)
class Findings:
    """The results for one map.

    Attributes:
        problem: with the errors that are left with the likeliest cause.
        tests: for each kind and subject the one that fits best, the likeliest first.
        causes: the likeliest, and those that cannot be told from it; empty if nothing was found.
        hidden: all mistakes that the tests may miss, at all times.
    """

    problem: Linearized
    tests: tuple[Test, ...]
    causes: tuple[Cause, ...]
    hidden: tuple[HiddenMistake, ...]


def find_mistakes(on_map: RangesOnMap, *, seed: int = 0) -> Findings:
    """Test all hypotheses with the noise that is left when all lasting mistakes explain what they can.

    A mistake with a time, such as a step, may have been learnt as noise instead. So if no test exceeds its threshold,
    the likeliest hypotheses are tried again, each with the noise that it leaves, and kept if they make the ranges
    likelier by enough.
    """
    problem = linearized(on_map)
    standing = [hypothesis for of_kind in STANDING for hypothesis in of_kind(problem)]
    hypotheses = standing + [hypothesis for of_kind in SCANNING for hypothesis in of_kind(problem)]
    problem = _without_bursts(problem, standing, hypotheses)
    all_tests = Factorization(problem).test(hypotheses, seed)
    tests = _best_of_each(all_tests, problem)
    possible = [test for test in tests if test.is_possible]
    rejected = [test for test in possible if test.is_rejected]
    causes = _causes(problem, rejected or possible[:_NUM_NEARLY], len(all_tests), is_sure=bool(rejected))
    if causes and causes[0].test is not None:
        problem = _learnt(problem, [*standing, causes[0].test.hypothesis])
        tests = _best_of_each(Factorization(problem).test(hypotheses, seed), problem)
    return Findings(problem, tuple(tests), tuple(causes), hidden_among(all_tests))


def _without_bursts(
    problem: Linearized, standing: Sequence[Hypothesis], hypotheses: Sequence[Hypothesis]
) -> Linearized:
    """Leave out the bursts of erring ranges that explain the residuals better than any hypothesis.

    The errors are learnt while the standing mistakes explain what they can.
    """
    problem, num = _learnt(problem, standing), len(problem.residual_m)
    for _ in range(_MAX_NUM_BURSTS):
        factorized = Factorization(problem)
        burst = likeliest_burst(factorized)
        if burst.statistic < burst.threshold:
            break
        possible = (test for test in factorized.estimates(hypotheses) if test.is_possible)
        likeliest = max((test.statistic - _penalty(test, num) for test in possible), default=0.0)
        if burst.statistic - float(np.log(num)) < likeliest:
            break
        problem = _learnt(without(problem, burst), standing)
    return problem


def _learnt(problem: Linearized, explaining: Sequence[Hypothesis]) -> Linearized:
    """Return the problem with the errors learnt while some mistakes explain what they can."""
    effects = Effect.of_all([h.effect for h in explaining])
    return problem.with_learnt_errors(effects.columns, effects.priors)


def _causes(problem: Linearized, nominated: Sequence[Test], num_tests: int, *, is_sure: bool) -> list[Cause]:
    """Return the likeliest explanation and those as good; empty if none is better than chance.

    Args:
        nominated: tests whose hypotheses are tried. num_tests: number of all tests.
        is_sure: whether the nominated tests exceed their thresholds.
    """
    before = Factorization(_settled(problem).with_learnt_errors()).deviance()
    num = len(problem.residual_m)
    causes = []
    factorized = Factorization(problem)
    for test in _varied(nominated):
        again, deviance, state = _settled_test(problem, _at_best_time(factorized, test.hypothesis))
        gain = before - deviance
        is_found = again.is_possible and bool(np.isfinite(deviance))
        # The first step of a nonlinear hypothesis says little about a large mistake, so it needs more than the penalty.
        # An explanation fails if the errors alone explain as much once no other mistake takes part of it.
        penalty = _penalty(again, num)
        enough = penalty if test.hypothesis.is_linear else test.threshold
        if not is_sure:
            enough = penalty + 2 * float(np.log(num_tests)) + _BEYOND_CHANCE
        if is_found and gain > enough:
            causes.append(_cause(replace(again, threshold=test.threshold), state, gain, penalty))
    if not causes and not is_sure:
        # A lever arm is so short that one with the wrong sign may change the ranges less than the other tests can see.
        # A path that drifts is bent to any mistake, so that no test sees one.
        unseen = alternatives if drifts(problem) else lever_arms_in_other_axes
        tried = list(unseen(as_given(problem.on_map)))
        causes += [cause for cause in _alternatives(problem, before, tried) if cause.score > _BEYOND_CHANCE]
    else:
        causes += _alternatives(problem, before, list(alternatives(as_given(problem.on_map))))
    causes.sort(key=lambda cause: -cause.score)
    likeliest = [cause for k, cause in enumerate(causes) if not k or _is_rival(causes[0], cause)]
    return [_narrowed(problem, cause, before) for cause in likeliest[: 1 + _MAX_NUM_RIVALS]]


def _at_best_time(factorized: Factorization, hypothesis: Hypothesis) -> Hypothesis:
    """Return a hypothesis at the time that fits best; ranges between its true time and a tried one fit neither way."""
    if hypothesis.refine_time is None:
        return hypothesis
    tests = factorized.estimates([hypothesis, *hypothesis.refine_time()])
    return max(tests, key=lambda test: test.statistic).hypothesis


def _varied(tests: Sequence[Test]) -> list[Test]:
    """Return the first tests, at most a few of each kind."""
    kinds = [test.hypothesis.name for test in tests]
    return [test for k, test in enumerate(tests) if kinds[:k].count(kinds[k]) < _NUM_OF_KIND][:_NUM_TRIED]


def _is_rival(best: Cause, other: Cause) -> bool:
    if best.score - other.score < _AS_LIKELY:
        return True
    return best.test is not None and other.test is not None and overlap(best.test, other.test) > _SAME


def _settled_test(problem: Linearized, hypothesis: Hypothesis) -> tuple[Test, float, RangeState]:
    """Return the test of a hypothesis, its deviance and its state, with the errors that it leaves.

    The deviance is infinite if the steps diverge: then no size fits.
    """
    found = (_linear_settled if hypothesis.is_linear else _settled_in_steps)(problem, hypothesis)
    factorized = Factorization(_learnt(found.at, [found.hypothesis]))
    [test] = factorized.estimates([found.hypothesis])
    deviance = np.inf if found.diverges else factorized.deviance(test)
    return replace(test, hypothesis=hypothesis, sizes=found.sizes + test.sizes), deviance, found.at.on_map.state


@dataclass(frozen=True)
class _Settled:
    """The end of the steps to the likeliest size of a mistake.

    Attributes:
        at: the problem with the ranges corrected by ``sizes``, at the state that is then likeliest.
        hypothesis: linearised there. sizes: (k,) by which the ranges are corrected.
        diverges: whether the steps never become short, or lead to impossible sizes.
    """

    at: Linearized
    hypothesis: Hypothesis
    sizes: Array
    diverges: bool


def _linear_settled(problem: Linearized, hypothesis: Hypothesis) -> _Settled:
    """Find the likeliest state with a linear mistake, whose size is left free."""
    at, before, nothing = problem, np.zeros(hypothesis.num), np.zeros(hypothesis.num)
    for _ in range(MAX_NUM_ROUNDS):
        factorized = Factorization(at)
        [test] = factorized.estimates([hypothesis])
        if np.linalg.norm(test.sizes - before) <= _SETTLED * np.linalg.norm(test.sizes):
            return _Settled(at, hypothesis, nothing, diverges=False)
        if not test.is_possible:
            break
        at, before = at_state(at, _stepped(at, factorized, hypothesis, test.sizes)), test.sizes
    return _Settled(at, hypothesis, nothing, diverges=True)


def _settled_in_steps(problem: Linearized, original: Hypothesis) -> _Settled:
    """Find the likeliest size of a mistake by repeated correction; the steps may diverge if the data hardly fix it."""
    at, hypothesis, sizes = problem, original, np.zeros(original.num)
    for _ in range(MAX_NUM_ROUNDS):
        factorized = Factorization(at)
        [test] = factorized.estimates([hypothesis])
        if not original.can_be(sizes + test.sizes):
            break
        if np.linalg.norm(test.sizes) <= _SETTLED * np.linalg.norm(sizes + test.sizes):
            return _Settled(at, hypothesis, sizes, diverges=False)
        sizes = sizes + test.sizes
        moved = replace(problem.on_map, state=_stepped(at, factorized, hypothesis, test.sizes).state)
        at = at_state(at, corrected(moved, original.correction(sizes)))
        found = (each for of_kind in STANDING for h in of_kind(at) for each in (h, *h.sub_hypotheses))
        hypothesis = next((each for each in found if each.key == original.key), None) or original.at_size(at, sizes)
    return _Settled(at, hypothesis, sizes, diverges=True)


def _stepped(at: Linearized, factorized: Factorization, hypothesis: Hypothesis, sizes: Array) -> RangesOnMap:
    """Return the ranges on the map that is likeliest with a mistake of some size."""
    step = factorized.step_with(hypothesis.effect, sizes)
    return replace(at.on_map, state=state_after((at.columns,), at.on_map.state, step))


def _narrowed(problem: Linearized, cause: Cause, before: float) -> Cause:
    """Return a cause with fewer numbers if one explains as much; otherwise the cause itself."""
    if cause.test is None or not cause.test.hypothesis.sub_hypotheses:
        return cause
    tried = [_settled_test(problem, h) for h in cause.test.hypothesis.sub_hypotheses]
    tried = [each for each in tried if each[0].is_possible]
    if not tried:
        return cause
    best, deviance, state = min(tried, key=lambda each: each[1])
    test = replace(best, threshold=cause.test.threshold)
    narrow = _cause(test, state, before - deviance, _penalty(best, len(problem.residual_m)))
    return narrow if narrow.score > cause.score else cause


def _cause(test: Test, state: RangeState, gain: float, penalty: float) -> Cause:
    h = test.hypothesis
    adoption = (h.adoption or h.correction)(test.sizes)
    return Cause(h.name, h.subject, h.words(test.sizes), h.remedy, adoption, gain, penalty, state, test)


def _alternatives(problem: Linearized, before: float, tried: Sequence[Alternative]) -> Iterator[Cause]:
    """Yield those of the alternatives that make the ranges likelier than chance would."""
    if not tried:
        return
    refits = Refits(as_given(problem.on_map), problem.scatter_m)
    starts = sorted(((*refits.start(each.correction), each) for each in tried), key=lambda start: start[0])
    fits = sorted(((*refits.fitted(start), each) for _, start, each in starts[:_NUM_FITTED]), key=lambda fit: fit[0])
    # Its squares do not decide: by the errors that last, an explanation with larger squares may be the likelier one.
    found = [(_likeliest_near(problem, refitted), each) for _, refitted, each in fits[:_NUM_TRIED]]
    if isinstance(problem.on_map.bending, WalkBending):
        found.sort(key=lambda one: Factorization(one[0]).deviance())
        found = [(_bent_anew(problem, near), each) for near, each in found[:_NUM_BENT]]
    for near, each in found:
        gain = before - Factorization(near).deviance()
        num_free = 3 * sum(place is None for place in each.correction.anchors_m.values())
        penalty = 2 * float(np.log(len(tried))) + num_free * float(np.log(len(problem.residual_m)))
        if gain > penalty + _AS_LIKELY:
            yield Cause(**vars(each), gain=gain, penalty=penalty, state=near.on_map.state, test=None)


def _likeliest_near(problem: Linearized, corrected_map: RangesOnMap) -> Linearized:
    """Move to the likeliest state of corrected ranges near a state, and learn their errors."""
    is_walk = isinstance(corrected_map.bending, WalkBending)
    at = at_other_map(problem, corrected_map) if is_walk else at_state(problem, corrected_map)
    return _settled(at).with_learnt_errors()


def _bent_anew(problem: Linearized, near: Linearized) -> Linearized:
    return at_other_map(problem, bent_to_ranges(near.on_map)).with_learnt_errors()


def _settled(problem: Linearized) -> Linearized:
    """Move to the likeliest state if a linear step improves it; from far away it does not."""
    here = Factorization(problem.with_usual_errors())
    state = state_after((problem.columns,), problem.on_map.state, here.step)
    there = at_state(problem, replace(problem.on_map, state=state))
    return min(problem, there, key=lambda each: Factorization(each.with_usual_errors()).deviance())


def _best_of_each(tests: Sequence[Test], problem: Linearized) -> list[Test]:
    """Return for each kind and subject the test that fits best, the likeliest first."""
    of_key: dict[tuple[str, str], list[Test]] = {}
    for test in tests:
        of_key.setdefault(test.hypothesis.key, []).append(test)
    # The smallest detectable size is the median over all times, because a mistake does not happen at the best time.
    best = {
        key: replace(
            max(group, key=lambda test: (test.is_possible, test.statistic)),
            smallest_detectable=float(np.median([test.smallest_detectable for test in group])),
        )
        for key, group in of_key.items()
    }
    num = len(problem.residual_m)
    return sorted(best.values(), key=lambda test: _penalty(test, num) - test.statistic)


def _penalty(test: Test, num: int) -> float:
    """Return the cost of the numbers that a hypothesis may choose (Schwarz, 1978)."""
    return test.num * float(np.log(num))

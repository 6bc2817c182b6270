"""Which mistakes were made: the noise is learnt, every hypothesis tested, the likeliest one named."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from rangesfm.arrays import Array
from rangesfm.scale.range_equation import RangeState, state_after
from rangesfm.trust.alternatives import Alternative, Refits, alternatives
from rangesfm.trust.catalogue import STANDING
from rangesfm.trust.hypothesis import Correction, Effect, Hypothesis, corrected, of_cells
from rangesfm.trust.linearized import Linearized, RangesOnMap, at_state, linearized
from rangesfm.trust.scanning import SCANNING
from rangesfm.trust.testing import Factorization, Test, overlap

# Explanations that are tried with the noise that each of them leaves.
_NUM_TRIED, _NUM_OF_KIND, _NUM_NEARLY = 6, 2, 3
# Alternatives that are fitted: where the map itself sees the anchors, the right one begins near its end.
_NUM_FITTED = 12
# Of two that differ by less in twice the logarithm of their likelihood, neither is named alone.
_AS_LIKELY = 6.0
_SAME = 0.95
_MAX_NUM_RIVALS = 2
_NUM_SETTLING, _SETTLED = 6, 0.05
# Steps in a row that are longer than the one before: the first may fall short, as of a large mistake.
_NUM_LONGER = 2
# Of what is not linear.
_NUM_STEPS = 10


@dataclass(frozen=True)
class Cause(Alternative):
    """An explanation that beats chance; its words are with the size that was found.

    Attributes:
        gain: by how much it makes the ranges likelier, as twice a logarithm, with the noise that it leaves.
        penalty: for what it may choose.
        state: the likeliest with it.
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
        """The ranges as they would be without it."""
        correction = self.correction if self.test is None else self.test.hypothesis.correction(self.test.sizes)
        return corrected(replace(on_map, state=self.state), correction)


@dataclass(frozen=True)
class Findings:
    """What was found of one map.

    Attributes:
        tests: of each kind and subject the one that fits best, the likeliest first.
        causes: the likeliest, and those that cannot be told from it; empty if nothing was found.
    """

    problem: Linearized
    tests: tuple[Test, ...]
    causes: tuple[Cause, ...]


def find_mistakes(on_map: RangesOnMap, *, seed: int = 0) -> Findings:
    """Test all hypotheses with the noise that is left when those that stand explain what they can.

    A mistake that does not stand, as a step, may have passed for noise instead: where nothing is found, the likeliest
    are believed that make the ranges likelier with the noise that each of them leaves.
    """
    problem = linearized(on_map)
    standing = [hypothesis for of_kind in STANDING for hypothesis in of_kind(problem)]
    hypotheses = standing + [hypothesis for of_kind in SCANNING for hypothesis in of_kind(problem)]
    problem = _learnt(problem, standing)
    tests = _best_of_each(Factorization(problem).test(hypotheses, seed), problem)
    possible = [test for test in tests if test.is_possible]
    rejected = [test for test in possible if test.is_rejected]
    causes = _causes(problem, rejected or possible[:_NUM_NEARLY], is_sure=bool(rejected))
    if causes and causes[0].test is not None:
        problem = _learnt(problem, [*standing, causes[0].test.hypothesis])
        tests = _best_of_each(Factorization(problem).test(hypotheses, seed), problem)
    return Findings(problem, tuple(tests), tuple(causes))


def _learnt(problem: Linearized, explaining: Sequence[Hypothesis]) -> Linearized:
    """With the errors that are left when some mistakes explain what they can."""
    effects = Effect.of_all([of_cells(problem, problem.design[:, :0]), *(h.effect for h in explaining)])
    return problem.with_learnt_errors(effects.columns, effects.priors)


def _causes(problem: Linearized, nominated: Sequence[Test], *, is_sure: bool) -> list[Cause]:
    """The likeliest explanation, and those as good; none if even that is no better than chance."""
    before = Factorization(_learnt(_settled(problem), [])).deviance()
    num = len(problem.residual_m)
    causes = []
    factorized = Factorization(problem)
    for test in _varied(nominated):
        again, deviance, state = _settled_test(problem, _at_best_time(factorized, test.hypothesis))
        gain = before - deviance
        is_found = again.is_possible and bool(np.isfinite(deviance))
        # What is not linear was tested by its first step, which says little of a large mistake. What the errors explain
        # as well, where they need not share with all other mistakes, is none.
        penalty = _penalty(again, num)
        enough = penalty if is_sure and test.hypothesis.is_linear else test.threshold
        if is_found and gain > enough:
            causes.append(_cause(replace(again, threshold=test.threshold), state, gain, penalty))
    if not causes and not is_sure:
        return []
    causes += _alternatives(problem, before)
    causes.sort(key=lambda cause: -cause.score)
    likeliest = [cause for k, cause in enumerate(causes) if not k or _is_rival(causes[0], cause)]
    return [_narrowed(problem, cause, before) for cause in likeliest[: 1 + _MAX_NUM_RIVALS]]


def _at_best_time(factorized: Factorization, hypothesis: Hypothesis) -> Hypothesis:
    """Ranges between the true time of a step and the one that was looked at fit neither way."""
    if hypothesis.finer is None:
        return hypothesis
    tests = factorized.estimates([hypothesis, *hypothesis.finer()])
    return max(tests, key=lambda test: test.statistic).hypothesis


def _varied(tests: Sequence[Test]) -> list[Test]:
    """The first ones, of each kind a few."""
    kinds = [test.hypothesis.name for test in tests]
    return [test for k, test in enumerate(tests) if kinds[:k].count(kinds[k]) < _NUM_OF_KIND][:_NUM_TRIED]


def _is_rival(best: Cause, other: Cause) -> bool:
    if best.score - other.score < _AS_LIKELY:
        return True
    return best.test is not None and other.test is not None and overlap(best.test, other.test) > _SAME


def _settled_test(problem: Linearized, hypothesis: Hypothesis) -> tuple[Test, float, RangeState]:
    """Return the test of a hypothesis, its deviance and its state, with the errors that it leaves.

    Where steps diverge the deviance is infinite: there is no size that fits.
    """
    found = (_linear_settled if hypothesis.is_linear else _settled_in_steps)(problem, hypothesis)
    factorized = Factorization(_learnt(found.at, [found.hypothesis]))
    [test] = factorized.estimates([found.hypothesis])
    # What a step promises counts only where steps keep what they promise.
    sizes = found.sizes + test.sizes if found.is_settled else found.sizes
    deviance = np.inf if found.diverges else factorized.deviance(test if found.is_settled else None)
    return replace(test, hypothesis=hypothesis, sizes=sizes), deviance, found.at.on_map.state


@dataclass(frozen=True)
class _Settled:
    """Where steps to the likeliest size of a mistake ended.

    Attributes:
        at: with the ranges corrected by the size, and the state that is likeliest then.
        hypothesis: as it is there. sizes: (k,) by which the ranges are corrected.
        is_settled: whether the next step is short.
        diverges: whether steps grow, or lead beyond what can happen.
    """

    at: Linearized
    hypothesis: Hypothesis
    sizes: Array
    is_settled: bool
    diverges: bool = False


class _Steps:
    """Whether steps shrink: twice in a row longer than the one before, they lead nowhere."""

    def __init__(self) -> None:
        self._last, self._num_longer = np.inf, 0

    def grow(self, step: float) -> bool:
        """Return whether steps grow, after one more of this length."""
        self._num_longer = self._num_longer + 1 if step > self._last or not np.isfinite(step) else 0
        self._last = step
        return self._num_longer >= _NUM_LONGER


def _linear_settled(problem: Linearized, hypothesis: Hypothesis) -> _Settled:
    """At the likeliest state if the mistake was made, of whatever size it has there."""
    at, before, nothing, steps = problem, np.zeros(hypothesis.num), np.zeros(hypothesis.num), _Steps()
    for _ in range(_NUM_SETTLING):
        factorized = Factorization(at)
        [test] = factorized.estimates([hypothesis])
        change = float(np.linalg.norm(test.sizes - before))
        if change < _SETTLED * np.linalg.norm(test.sizes):
            break
        if steps.grow(change) or not test.is_possible:
            return _Settled(at, hypothesis, nothing, is_settled=True, diverges=True)
        at, before = at_state(at, _stepped(at, factorized, hypothesis, test.sizes)), test.sizes
    return _Settled(at, hypothesis, nothing, is_settled=True)


def _settled_in_steps(problem: Linearized, original: Hypothesis) -> _Settled:
    """Where the ranges are corrected by the likeliest size; where little holds a mistake, steps may grow instead."""
    at, hypothesis, sizes, steps = problem, original, np.zeros(original.num), _Steps()
    for _ in range(_NUM_STEPS):
        factorized = Factorization(at)
        [test] = factorized.estimates([hypothesis])
        step, size = (float(np.linalg.norm(each)) for each in (test.sizes, sizes + test.sizes))
        if steps.grow(step) or not original.can_be(sizes + test.sizes):
            return _Settled(at, hypothesis, sizes, is_settled=False, diverges=True)
        if step < _SETTLED * size:
            return _Settled(at, hypothesis, sizes, is_settled=True)
        sizes = sizes + test.sizes
        moved = replace(problem.on_map, state=_stepped(at, factorized, hypothesis, test.sizes).state)
        at = at_state(at, corrected(moved, original.correction(sizes)))
        found = (each for of_kind in STANDING for h in of_kind(at) for each in (h, *h.narrower))
        hypothesis = next((each for each in found if each.key == original.key), None) or original.at_size(at, sizes)
    return _Settled(at, hypothesis, sizes, is_settled=False)


def _stepped(at: Linearized, factorized: Factorization, hypothesis: Hypothesis, sizes: Array) -> RangesOnMap:
    """The ranges with the map as it is likeliest if a mistake of some size was made."""
    step = factorized.step((hypothesis.effect, sizes))
    return replace(at.on_map, state=state_after((at.columns,), at.on_map.state, step))


def _narrowed(problem: Linearized, cause: Cause, before: float) -> Cause:
    """The one of fewer numbers that does as well, if there is one."""
    if cause.test is None or not cause.test.hypothesis.narrower:
        return cause
    tried = [_settled_test(problem, h) for h in cause.test.hypothesis.narrower]
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


def _alternatives(problem: Linearized, before: float) -> Iterator[Cause]:
    """Those that make the ranges likelier than chance would."""
    on_map = problem.on_map
    tried = list(alternatives(on_map))
    if not tried:
        return
    refits = Refits(on_map, problem.scatter_m)
    as_given, _ = refits.of(refits.start(Correction())[1])
    starts = sorted(((*refits.start(each.correction), each) for each in tried), key=lambda start: start[0])
    fits = sorted(((*refits.of(start), each) for _, start, each in starts[:_NUM_FITTED]), key=lambda fit: fit[0])
    for _, refitted, each in [fit for fit in fits if fit[0] < as_given][:_NUM_TRIED]:
        moved = _settled(at_state(problem, refitted))
        gain = before - Factorization(_learnt(moved, [])).deviance()
        penalty = 2 * float(np.log(len(tried)))
        if gain > penalty + _AS_LIKELY:
            yield Cause(**vars(each), gain=gain, penalty=penalty, state=moved.on_map.state, test=None)


def _settled(problem: Linearized) -> Linearized:
    """At the likeliest state, if a step of the linearised problem leads there: from far away it does not."""
    here = Factorization(problem.with_usual_errors())
    state = state_after((problem.columns,), problem.on_map.state, here.step())
    there = at_state(problem, replace(problem.on_map, state=state))
    return min(problem, there, key=lambda each: Factorization(each.with_usual_errors()).deviance())


def _best_of_each(tests: Sequence[Test], problem: Linearized) -> list[Test]:
    """Of each kind and subject the one that fits best; the likeliest first."""
    of_key: dict[tuple[str, str], list[Test]] = {}
    for test in tests:
        of_key.setdefault(test.hypothesis.key, []).append(test)
    # Whoever makes such a mistake does not choose the time at which it is found best.
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
    """Each number that a hypothesis may choose costs (Schwarz, 1978)."""
    return test.num * float(np.log(num))

"""Search for the mistakes that were made: learn the noise, test every mistake and name the likeliest cause."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from rangesfm.arrays import Array
from rangesfm.measurements.mistakes import Correction, EstimatedMistake, Mistake, MistakeTest
from rangesfm.measurements.ranges.mistakes.alternatives import alternatives, best_refits, lever_arms_in_other_axes
from rangesfm.measurements.ranges.mistakes.bent_path import as_given, bent_to_ranges, drifts
from rangesfm.measurements.ranges.mistakes.catalogue import STANDING
from rangesfm.measurements.ranges.mistakes.effects import at_size, corrected
from rangesfm.measurements.ranges.mistakes.error_bursts import without_bursts
from rangesfm.measurements.ranges.mistakes.linearized import Linearized, linearized
from rangesfm.measurements.ranges.mistakes.thresholds import estimates, judged, overlap
from rangesfm.measurements.ranges.mistakes.timed_mistakes import SCANNING
from rangesfm.measurements.ranges.scale.range_equation import RangeState, state_after
from rangesfm.measurements.ranges.scale.ranges_on_map import RangesOnMap
from rangesfm.solver.bending import WalkBending
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
# Overlap of two mistakes from which on nothing tells them apart, and most causes that are named beside the likeliest.
_SAME, _MAX_NUM_RIVALS = 0.95, 2
# Relative change of a mistake's size at which the steps to the likeliest state stop.
_SETTLED = 0.05


@dataclass(frozen=True)
class Cause:
    """An explanation that is more likely than chance.

    Attributes:
        mistake: the mistake. sizes: (k,) of it.
        gain: increase of twice the log-likelihood of the ranges, with the errors that are left with it.
        penalty: for the numbers or alternatives to choose from.
        state: the likeliest state of the map with it.
        test: None for a mistake without a size.
    """

    mistake: Mistake
    sizes: Array
    gain: float
    penalty: float
    state: RangeState
    test: EstimatedMistake | None

    @property
    def name(self) -> str:
        """Of its kind."""
        return self.mistake.name

    @property
    def subject(self) -> str:
        """What it is about, such as an anchor's id; may be empty."""
        return self.mistake.subject

    @property
    def words(self) -> str:
        """What is probably the case, with the size that was found."""
        return self.mistake.words(self.sizes)

    @property
    def correction(self) -> Correction:
        """Changes of the input if the mistake is adopted."""
        return (self.mistake.adoption or self.mistake.correction)(self.sizes)

    @property
    def score(self) -> float:
        return self.gain - self.penalty

    def undone(self, on_map: RangesOnMap) -> RangesOnMap:
        """Return the ranges as they would be without the mistake."""
        return corrected(replace(on_map, state=self.state), self.mistake.correction(self.sizes))


@dataclass(frozen=True)
class Findings:
    """The results for one map.

    Attributes:
        problem: with the errors that are left with the likeliest cause.
        tests: for each kind and subject the one that fits best, the likeliest first.
        causes: the likeliest, and those that cannot be told from it; empty if nothing was found.
        hidden: rows of all mistakes that the tests may miss, at all times, without those whose usual size is already in
            the interval of the scale.
    """

    problem: Linearized
    tests: tuple[EstimatedMistake, ...]
    causes: tuple[Cause, ...]
    hidden: tuple[MistakeTest, ...]


def find_mistakes(on_map: RangesOnMap, *, seed: int = 0) -> Findings:
    """Test all mistakes with the noise that is left when all lasting mistakes explain what they can.

    A mistake with a time, such as a step, may have been learnt as noise instead. So if no test exceeds its threshold,
    the likeliest mistakes are tried again, each with the noise that it leaves, and kept if they make the ranges
    likelier by enough.
    """
    problem = linearized(on_map)
    standing = [mistake for of_kind in STANDING for mistake in of_kind(problem)]
    mistakes = standing + [mistake for of_kind in SCANNING for mistake in of_kind(problem)]
    problem = without_bursts(problem, standing, mistakes)
    all_tests = judged(problem, mistakes, seed)
    tests = _best_of_each(all_tests, problem)
    possible = [test for test in tests if test.is_possible]
    rejected = [test for test in possible if test.is_rejected]
    causes = _causes(problem, rejected or possible[:_NUM_NEARLY], len(all_tests), is_sure=bool(rejected))
    if causes and causes[0].test is not None:
        problem = problem.with_learnt_errors([h.columns for h in (*standing, causes[0].test.mistake)])
        tests = _best_of_each(judged(problem, mistakes, seed), problem)
    hidden = tuple(test.row for test in all_tests if not test.mistake.is_in_interval)
    return Findings(problem, tuple(tests), tuple(causes), hidden)


def _causes(
    problem: Linearized, nominated: Sequence[EstimatedMistake], num_tests: int, *, is_sure: bool
) -> list[Cause]:
    """Return the likeliest explanation and those as good; empty if none is better than chance.

    Args:
        nominated: tests whose mistakes are tried. num_tests: number of all tests.
        is_sure: whether the nominated tests exceed their thresholds.
    """
    before = _near_likeliest(problem).with_learnt_errors().deviance
    num = len(problem.bins)
    causes = []
    for test in _varied(nominated):
        # Ranges between the true time of a mistake and a tried one fit neither way.
        at_times = estimates(problem, [test.mistake, *test.mistake.refine_time()])
        best = max(at_times, key=lambda each: each.statistic).mistake
        again, deviance, state = _settled_test(problem, best)
        gain = before - deviance
        is_found = again.is_possible and bool(np.isfinite(deviance))
        # The first step of a nonlinear mistake says little about a large mistake, so it needs more than the penalty.
        # An explanation fails if the errors alone explain as much once no other mistake takes part of it.
        penalty = again.penalty(num)
        enough = penalty if test.mistake.is_linear else test.threshold
        if not is_sure:
            enough = penalty + 2 * float(np.log(num_tests)) + _BEYOND_CHANCE
        if is_found and gain > enough:
            again = replace(again, threshold=test.threshold)
            causes.append(Cause(again.mistake, again.sizes, gain, penalty, state, again))
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


def _varied(tests: Sequence[EstimatedMistake]) -> list[EstimatedMistake]:
    """Return the first tests, at most a few of each kind."""
    kinds = [test.mistake.name for test in tests]
    return [test for k, test in enumerate(tests) if kinds[:k].count(kinds[k]) < _NUM_OF_KIND][:_NUM_TRIED]


def _is_rival(best: Cause, other: Cause) -> bool:
    if best.score - other.score < _AS_LIKELY:
        return True
    return best.test is not None and other.test is not None and overlap(best.test, other.test) > _SAME


def _settled_test(problem: Linearized, original: Mistake) -> tuple[EstimatedMistake, float, RangeState]:
    """Return the test of a mistake, its deviance and its state, with the errors that it leaves.

    It is tested at its likeliest size and state. The ranges are corrected again and again by the size that is found,
    but for a linear mistake, whose size is left free. The deviance is infinite if the steps diverge, or lead to
    impossible sizes: then no size fits.
    """
    at, mistake, undone, before, diverges = problem, original, *np.zeros((2, original.num)), True
    for _ in range(MAX_NUM_ROUNDS):
        [test] = estimates(at, [mistake])
        sizes = undone + test.sizes
        if np.linalg.norm(sizes - before) <= _SETTLED * np.linalg.norm(sizes):
            diverges = False
            break
        if not original.can_be(sizes):
            break
        step = at.solution.step - test.by_unknowns @ test.sizes
        moved, before = replace(problem.on_map, state=state_after((at.columns,), at.on_map.state, step)), sizes
        if original.is_linear:
            at = at.at_state(moved)
        else:
            at, undone = at.at_state(corrected(moved, original.correction(sizes))), sizes
            found = (each for of_kind in STANDING for h in of_kind(at) for each in (h, *h.narrower))
            mistake = next((each for each in found if each.key == original.key), None) or at_size(original, at, sizes)
    at = at.with_learnt_errors([mistake.columns])
    [test] = estimates(at, [mistake])
    deviance = np.inf if diverges else at.deviance - test.statistic
    return replace(test, mistake=original, sizes=undone + test.sizes), deviance, at.on_map.state


def _narrowed(problem: Linearized, cause: Cause, before: float) -> Cause:
    """Return a cause with fewer numbers if one explains as much; otherwise the cause itself."""
    if cause.test is None or not cause.test.mistake.narrower:
        return cause
    tried = [_settled_test(problem, h) for h in cause.test.mistake.narrower]
    tried = [each for each in tried if each[0].is_possible]
    if not tried:
        return cause
    best, deviance, state = min(tried, key=lambda each: each[1])
    test = replace(best, threshold=cause.test.threshold)
    penalty = best.penalty(len(problem.bins))
    narrow = Cause(test.mistake, test.sizes, before - deviance, penalty, state, test)
    return narrow if narrow.score > cause.score else cause


def _alternatives(problem: Linearized, before: float, tried: Sequence[Mistake]) -> Iterator[Cause]:
    """Yield those mistakes without a size that make the ranges likelier than chance would."""
    if not tried:
        return
    is_walk = isinstance(problem.on_map.posed.bending, WalkBending)
    fits = best_refits(as_given(problem.on_map), problem.scatter_m, tried, _NUM_FITTED)
    # Its squares do not decide: by the errors that last, an explanation with larger squares may be the likelier one.
    found = []
    for each, refitted in fits[:_NUM_TRIED]:
        at = problem.at_other_map(refitted) if is_walk else problem.at_state(refitted)
        found.append((_near_likeliest(at).with_learnt_errors(), each))
    if is_walk:
        found.sort(key=lambda one: one[0].deviance)
        bent = ((bent_to_ranges(near.on_map), each) for near, each in found[:_NUM_BENT])
        found = [(problem.at_other_map(on_map).with_learnt_errors(), each) for on_map, each in bent]
    for near, each in found:
        gain, nothing = before - near.deviance, np.zeros(0)
        num_free = 3 * sum(place is None for place in each.correction(nothing).anchors_m.values())
        penalty = 2 * float(np.log(len(tried))) + num_free * float(np.log(len(problem.bins)))
        if gain > penalty + _AS_LIKELY:
            yield Cause(each, nothing, gain, penalty, near.on_map.state, None)


def _near_likeliest(problem: Linearized) -> Linearized:
    """Move to the likeliest state if a linear step improves it; from far away it does not."""
    step = problem.with_usual_errors().solution.step
    state = state_after((problem.columns,), problem.on_map.state, step)
    there = problem.at_state(replace(problem.on_map, state=state))
    return min(problem, there, key=lambda each: each.with_usual_errors().deviance)


def _best_of_each(tests: Sequence[EstimatedMistake], problem: Linearized) -> list[EstimatedMistake]:
    """Return for each kind and subject the test that fits best, the likeliest first."""
    of_key: dict[tuple[str, str], list[EstimatedMistake]] = {}
    for test in tests:
        of_key.setdefault(test.mistake.key, []).append(test)
    # The smallest detectable size is the median over all times, because a mistake does not happen at the best time.
    best = {
        key: replace(
            max(group, key=lambda test: (test.is_possible, test.statistic)),
            smallest_detectable=float(np.median([test.smallest_detectable for test in group])),
        )
        for key, group in of_key.items()
    }
    num = len(problem.bins)
    return sorted(best.values(), key=lambda test: test.penalty(num) - test.statistic)

"""What the tests of a map say, for people: the table, and a sentence that names the likeliest cause."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from rangesfm.arrays import Indices
from rangesfm.scale.verdict import DOUBTFUL_ABOVE
from rangesfm.trust.evidence import MIXED_UP, OF_SINGLE_RANGES, evidence
from rangesfm.trust.linearized import linearized
from rangesfm.trust.mistakes import Cause, Findings, find_mistakes
from rangesfm.trust.ranges_on_map import RangesOnMap
from rangesfm.trust.testing import MistakeTest, Test, row_of


@dataclass(frozen=True)
class TrustVerdict:
    """What was tested, and what speaks against the map.

    Attributes:
        tests: the table; what was found first.
        reasons: sentences, the likeliest cause first; empty if nothing was found.
        causes: the likeliest, and those that cannot be told from it.
        rows: (n,) of the log, the ranges that corrections are of.
    """

    tests: tuple[MistakeTest, ...]
    reasons: tuple[str, ...]
    causes: tuple[Cause, ...]
    rows: Indices

    def with_more(self, more: TrustVerdict) -> TrustVerdict:
        """With tests that were made of something else than ranges."""
        tests = (*more.tests, *self.tests)
        return replace(self, tests=tests, reasons=(*self.reasons, *more.reasons))


def trust_in(on_map: RangesOnMap, *, seed: int = 0) -> TrustVerdict:
    """Test all that may be wrong with the ranges on a map."""
    found = find_mistakes(on_map, seed=seed)
    shown = list(evidence(found.problem))
    before = _before_causes(found, shown)
    after = [row for row in shown if row not in before]
    named = {(cause.name, cause.subject) for cause in found.causes}
    others = (row_of(test) for test in found.tests if test.hypothesis.key not in named)
    rows = (*before, *map(_row_of_cause, found.causes), *others, *after)
    reasons = [f"{row.words}: {row.remedy}" for row in (*before, *(row for row in after if row.rejected))]
    if found.causes:
        reasons.insert(len(before), sentence(found.causes))
    return TrustVerdict(rows, tuple(reasons or _what_could_hide(found)), found.causes, on_map.rows)


def _before_causes(found: Findings, shown: Sequence[MistakeTest]) -> list[MistakeTest]:
    """What single ranges show that the likeliest cause leaves, and which may look like it: blocked ranges as a step.

    Of an anchor if the cause is one of its own; of all if they scatter by more than the cause changes them.
    """
    about_ranges = [row for row in shown if row.rejected and row.name in OF_SINGLE_RANGES]
    if not about_ranges or not found.causes:
        return []
    cause, on_map = found.causes[0], found.problem.on_map
    undone = cause.undone(on_map)
    changed_m = float(np.sqrt(np.mean((undone.residual_m - replace(on_map, state=cause.state).residual_m) ** 2)))
    left = {(row.name, row.subject) for row in evidence(linearized(undone)) if row.rejected}
    return [
        row
        for row in about_ranges
        if (row.name == MIXED_UP or (row.name, row.subject) in left)
        and (f"{cause.subject} ".startswith(f"{row.subject} ") if row.subject else row.statistic > changed_m)
    ]


def sentence(causes: Sequence[Cause]) -> str:
    """The likeliest cause with what to do; several that nothing tells apart are all named."""
    sure = f"{np.sqrt(max(causes[0].gain, 0.0)):.0f} stddevs"
    if len(causes) == 1:
        return f"probably {causes[0].words} ({sure}): {causes[0].remedy}"
    either = ", or ".join(cause.words for cause in causes)
    remedies = dict.fromkeys(cause.remedy for cause in causes)
    return f"either {either} ({sure}; the ranges do not tell which): {'; or '.join(remedies)}"


def _what_could_hide(found: Findings) -> Iterator[str]:
    """A mistake that would not have been found and does more than a good scale may be off by."""
    hidden = [t for t in found.tests if not t.hypothesis.is_in_interval and np.isfinite(t.effect_on_log_scale)]
    worst = max(hidden, key=_hidden_effect, default=None)
    if worst is not None and _hidden_effect(worst) > DOUBTFUL_ABOVE:
        size = min(worst.smallest_detectable, worst.hypothesis.unawares)
        what = f"{' '.join(worst.hypothesis.key).strip()}, {size:.2g} {worst.hypothesis.unit}"
        change = f"change the scale by {100 * _hidden_effect(worst):.1f} %"
        yield f"a mistake could stay hidden here ({what}) and {change}: {worst.hypothesis.remedy}"


def _hidden_effect(test: Test) -> float:
    """On the logarithm of the scale, of the largest that neither test nor surveyor would see."""
    return test.effect_on_log_scale * min(1.0, test.hypothesis.unawares / test.smallest_detectable)


def _row_of_cause(cause: Cause) -> MistakeTest:
    """With the statistic by which it was found: how much likelier it makes the ranges."""
    if cause.test is None:
        return MistakeTest(cause.name, cause.subject, cause.gain, cause.penalty, cause.words, cause.remedy)
    return row_of(cause.test, max(cause.test.statistic, cause.gain), cause.words)

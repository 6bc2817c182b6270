"""What the tests of a map say, for people: the table, with what is no mistake of one size, and the likeliest cause."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from rangesfm.arrays import Indices
from rangesfm.processes.threads import with_one_blas_thread
from rangesfm.scale.verdict import DOUBTFUL_ABOVE
from rangesfm.trust.linearized import Linearized, RangesOnMap, linearized, near_m
from rangesfm.trust.mistakes import Cause, Findings, find_mistakes
from rangesfm.trust.testing import MistakeTest, Test, row_of

# Real radios show 0.03 to 0.15 m beside outliers, old ones 0.2 m: of a stddev beyond that something else is the cause.
_MOST_NOISE_M, _MOST_LASTING_M = 0.25, 0.25
# In metres for a metre of distance: a radio on 70 m is noisier than one in a room.
_NOISE_BY_DISTANCE = 0.005
_LASTING = ("time", "place", "view")
_LEAST_USED, _MOST_OUTLYING = 0.4, 0.35
# Of ranges far from their neighbours, those as long as to one other anchor; of fewer it is chance.
_MOST_OF_OTHER, _MIN_NUM_OUTLYING = 0.5, 10
_FEW_OBSTRUCTED = "place the anchors where nothing stands between them and the path"

_MIXED_UP = "anchor mixed up"
# What is seen of ranges beside those right before and after.
_OF_SINGLE_RANGES = ("range noise", "anchor's outliers", _MIXED_UP)


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
    causes: tuple[Cause, ...] = ()
    rows: Indices = field(default_factory=lambda: np.zeros(0, dtype=np.int64))

    def with_more(self, more: TrustVerdict) -> TrustVerdict:
        """With tests that were made of something else than ranges."""
        tests = (*more.tests, *self.tests)
        return replace(self, tests=tests, reasons=(*self.reasons, *more.reasons))


@with_one_blas_thread
def trust_in(on_map: RangesOnMap, *, seed: int = 0) -> TrustVerdict:
    """Test all that may be wrong with the ranges on a map."""
    found = find_mistakes(on_map, seed=seed)
    shown = list(_evidence(found.problem))
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
    about_ranges = [row for row in shown if row.rejected and row.name in _OF_SINGLE_RANGES]
    if not about_ranges or not found.causes:
        return []
    cause, on_map = found.causes[0], found.problem.on_map
    undone = cause.undone(on_map)
    changed_m = float(np.sqrt(np.mean((undone.residual_m - replace(on_map, state=cause.state).residual_m) ** 2)))
    left = {(row.name, row.subject) for row in _evidence(linearized(undone)) if row.rejected}
    return [
        row
        for row in about_ranges
        if (row.name == _MIXED_UP or (row.name, row.subject) in left)
        and (f"{cause.subject} ".startswith(f"{row.subject} ") if row.subject else row.statistic > changed_m)
    ]


def sentence(causes: Sequence[Cause]) -> str:
    """The likeliest cause with what to do; several that nothing tells apart are all named."""
    sure = f"{np.sqrt(_statistic(causes[0])):.0f} stddevs"
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
        size = min(worst.smallest_detectable, worst.hypothesis.most_unnoticed)
        what = f"{' '.join(worst.hypothesis.key).strip()}, {size:.2g} {worst.hypothesis.unit}"
        change = f"change the scale by {100 * _hidden_effect(worst):.1f} %"
        yield f"a mistake could stay hidden here ({what}) and {change}: {worst.hypothesis.remedy}"


def _hidden_effect(test: Test) -> float:
    """On the logarithm of the scale, of the largest that neither test nor surveyor would see."""
    return test.effect_on_log_scale * min(1.0, test.hypothesis.most_unnoticed / test.smallest_detectable)


def _row_of_cause(cause: Cause) -> MistakeTest:
    """With the statistic by which it was found: how much likelier it makes the ranges."""
    if cause.test is None:
        return MistakeTest(cause.name, cause.subject, cause.gain, cause.penalty, cause.words, cause.remedy)
    return row_of(replace(cause.test, statistic=_statistic(cause)))


def _statistic(cause: Cause) -> float:
    """Return by how much a cause makes the ranges likelier, with the errors that are left or as its test has it."""
    return cause.gain if cause.test is None else max(cause.test.statistic, cause.gain)


def _evidence(problem: Linearized) -> Iterator[MistakeTest]:
    """What is no mistake of one size, of the noise as learnt beside the likeliest one and of each anchor's ranges."""
    far = _NOISE_BY_DISTANCE * float(problem.gradient.distance_m.mean())
    for kind, what, stddev_m, most_m in (
        ("range noise", "scatter", problem.scatter_m, _MOST_NOISE_M + far),
        ("lasting errors", "err for seconds", _lasting_m(problem), _MOST_LASTING_M + far),
    ):
        words = f"the ranges {what} by {stddev_m:.2f} m, which no radio does in the open ({most_m:.2f} m at most)"
        yield _seen(kind, "", stddev_m, most_m, words, _FEW_OBSTRUCTED, unit="m")
    on_map, cells = problem.on_map, problem.cells
    index = on_map.problem.anchor_index
    for k in np.unique(index).tolist():
        is_of, name = index == k, on_map.anchor_ids[k]
        unused = float(np.mean(on_map.weights[is_of] < 0.1))
        num = int(np.count_nonzero(is_of))
        words = f"only {round((1 - unused) * num)} of {num} ranges to anchor {name} fit the map"
        remedy = "look whether it is the anchor that it is taken for, and where it stands"
        yield _seen("anchor hardly used", name, unused, 1 - _LEAST_USED, words, remedy)
        rows = np.flatnonzero(is_of & (cells.weight < 0.5))
        if len(rows) >= _MIN_NUM_OUTLYING and len(on_map.anchor_ids) > 1:
            yield _mixed_up(problem, k, rows)
        outlying = len(rows) / num
        words = f"{100 * outlying:.0f} % of the ranges to anchor {name} are far from those right before and after"
        yield _seen("anchor's outliers", name, outlying, _MOST_OUTLYING, words, _FEW_OBSTRUCTED)


def _mixed_up(problem: Linearized, anchor: int, outlying: Indices) -> MistakeTest:
    """Whether an anchor's ranges that are far from their neighbours are another's."""
    on_map = problem.on_map
    anchors_m, index = on_map.state.anchors_m, on_map.problem.anchor_index[outlying]
    tags_m = on_map.from_anchor_m[outlying] + anchors_m[index]
    off_m = np.linalg.norm(tags_m[:, None] - anchors_m, axis=2) - on_map.problem.range_m[outlying, None]
    fitting = np.mean(np.abs(off_m) < near_m(problem.scatter_m), axis=0)
    fitting[anchor] = 0.0
    name, other = on_map.anchor_ids[anchor], on_map.anchor_ids[int(np.argmax(fitting))]
    words = (
        f"{100 * fitting.max():.0f} % of the ranges to anchor {name} that are far from those right before and after "
        f"are as long as those to {other}"
    )
    remedy = f"see whether two devices bear the label {name}, and leave it out (use_anchors)"
    return _seen(_MIXED_UP, name, float(fitting.max()), _MOST_OF_OTHER, words, remedy)


def _lasting_m(problem: Linearized) -> float:
    """Root mean square over cells."""
    lasting = np.isin(problem.errors.names, _LASTING)
    variances = np.trace(problem.errors.covariances_m2[lasting].sum(axis=0))
    return float(np.sqrt(variances / len(problem.cells)))


def _seen(
    name: str, subject: str, found: float, most: float, words: str, remedy: str, *, unit: str = "1"
) -> MistakeTest:
    return MistakeTest(name, subject, found, most, words, remedy, unit, size=found, smallest_detectable=most)

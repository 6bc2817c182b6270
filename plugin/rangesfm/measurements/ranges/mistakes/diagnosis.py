"""Results of a map's tests for people: the table, faults that are no mistake of one size, and the likeliest cause."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from rangesfm.arrays import Indices
from rangesfm.measurements.mistake_words import mistake_in_words
from rangesfm.measurements.mistakes import EstimatedMistake, MistakeTest, MistakeTests
from rangesfm.measurements.ranges.mistakes.alternatives import LEAST_USED
from rangesfm.measurements.ranges.mistakes.bent_path import drifts
from rangesfm.measurements.ranges.mistakes.find_mistakes import Cause, Findings, find_mistakes
from rangesfm.measurements.ranges.mistakes.linearized import Linearized, linearized, near_m
from rangesfm.measurements.ranges.range_observations import DOWN_WEIGHTED_BELOW, OUTLIER_BELOW
from rangesfm.measurements.ranges.scale.ranges_on_map import RangesOnMap
from rangesfm.util.geometry.numerics import DOUBTFUL_ABOVE
from rangesfm.util.processes.threads import with_one_blas_thread

# Largest standard deviation, metres, of noise, and of lasting errors. Real radios show 0.03 to 0.15 m beside outliers,
# old ones 0.2 m; more has another cause.
_MOST_ERROR_M = 0.25
# Addition to both limits per metre of distance: a radio over 70 m is noisier than in a room.
_NOISE_BY_DISTANCE = 0.005
_LASTING = ("time", "place", "view")
# Largest share of an anchor's ranges that is far from those right before and after.
_MOST_OUTLYING = 0.35
# Share of an anchor's outliers that must fit one other anchor to be taken for its ranges, and the fewest outliers.
_MOST_OF_OTHER, _MIN_NUM_OUTLYING = 0.5, 10
_FEW_OBSTRUCTED = "place the anchors where nothing stands between them and the path"

_MIXED_UP = "anchor mixed up"
# Faults that show in single ranges, compared with those right before and after.
_OF_SINGLE_RANGES = ("range noise", "anchor's outliers", _MIXED_UP)


@with_one_blas_thread
def diagnose_ranges(on_map: RangesOnMap, *, seed: int = 0) -> MistakeTests:
    """Test for all mistakes that ranges on a map can show."""
    found = find_mistakes(on_map, seed=seed)
    shown = list(_evidence(found.problem))
    before = _before_causes(found, shown)
    seen = [row for row in shown if row.rejected and row not in before]
    named = {cause.mistake.key for cause in found.causes}
    others = (test.row for test in found.tests if test.mistake.key not in named)
    causes = (_row_of_cause(cause, on_map.posed.rows) for cause in found.causes)
    rows = (*before, *causes, *seen, *others, *(row for row in shown if not row.rejected))
    reasons = [f"{row.words}: {row.remedy}" for row in (*before, *seen)]
    likeliest = causes_in_words(found.causes) if found.causes else ""
    if likeliest:
        reasons.insert(len(before), likeliest)
    said = tuple(reasons or _what_could_hide(found))
    # The map is elsewhere, too, if the anchors are.
    moves = any(cause.correction.anchors_m for cause in found.causes)
    of_place = (likeliest,) if moves else ()
    return MistakeTests(rows, said, found.hidden, likeliest, of_place)


def _before_causes(found: Findings, shown: Sequence[MistakeTest]) -> list[MistakeTest]:
    """Return faults of single ranges that the likeliest cause does not explain, but that may explain the cause.

    Blocked ranges, for instance, may look like a step. A fault counts if it is of the cause's own anchor, or if it is
    of all ranges and they scatter by more than the cause changes them.
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


def causes_in_words(causes: Sequence[Cause]) -> str:
    """Return the likeliest cause with its remedy as a sentence; causes that cannot be told apart are all named."""
    sure = f"{np.sqrt(_statistic(causes[0])):.0f} stddevs"
    if len(causes) == 1:
        return f"probably {causes[0].words} ({sure}): {causes[0].mistake.remedy}"
    either = ", or ".join(cause.words for cause in causes)
    remedies = dict.fromkeys(cause.mistake.remedy for cause in causes)
    return f"either {either} ({sure}; the ranges do not tell which): {'; or '.join(remedies)}"


def _what_could_hide(found: Findings) -> Iterator[str]:
    """Yield the worst mistake that could stay hidden, if it changes the scale by more than a good scale may be off."""
    hidden = [t for t in found.tests if not t.mistake.is_in_interval and np.isfinite(t.effect_on_log_scale)]
    worst = max(hidden, key=_hidden_effect, default=None)
    if worst is not None and _hidden_effect(worst) > DOUBTFUL_ABOVE:
        size = min(worst.smallest_detectable, worst.mistake.most_unnoticed)
        change = f"change the scale by {100 * _hidden_effect(worst):.1f} %"
        yield (
            f"the ranges cannot show every mistake that matters: an error of {size:.2g} {worst.mistake.unit} "
            f"({mistake_in_words(*worst.mistake.key)}) would go unnoticed and {change}; tape a length between two "
            f"distant points as a check, or {worst.mistake.remedy}"
        )


def _hidden_effect(test: EstimatedMistake) -> float:
    """Return the change of the scale's logarithm by the largest mistake that neither test nor surveyor would notice."""
    return test.effect_on_log_scale * min(1.0, test.mistake.most_unnoticed / test.smallest_detectable)


def _row_of_cause(cause: Cause, rows: Indices) -> MistakeTest:
    """Return the row of a cause, with the statistic by which it was found; ``rows``: of the ranges in the log."""
    correction = replace(cause.correction, rows=rows)
    if cause.test is not None:
        return replace(replace(cause.test, statistic=_statistic(cause)).row, correction=correction)
    remedy = cause.mistake.remedy
    return MistakeTest(*cause.mistake.key, cause.gain, cause.penalty, cause.words, remedy, correction=correction)


def _statistic(cause: Cause) -> float:
    """Return how much likelier a cause makes the ranges, by its test or by the errors that are left with it."""
    return cause.gain if cause.test is None else max(cause.test.statistic, cause.gain)


def _evidence(problem: Linearized) -> Iterator[MistakeTest]:
    """Yield faults that are no mistake of one size: noise and lasting errors of all ranges, faults of each anchor."""
    far = _NOISE_BY_DISTANCE * float(problem.gradient.distance_m.mean())
    lasting_m2 = problem.noise.covariances_m2[np.isin(problem.noise.names, _LASTING)].sum(axis=0)
    lasting_m = float(np.sqrt(np.trace(lasting_m2) / len(problem.bins)))  # root mean square over the bins
    for kind, what, stddev_m, most_m in (
        ("range noise", "scatter by {:.2f} m from one to the next", problem.scatter_m, _MOST_ERROR_M + far),
        ("lasting errors", "have errors of {:.2f} m that last for seconds", lasting_m, _MOST_ERROR_M + far),
    ):
        words = f"the ranges {what.format(stddev_m)}; radios with a clear line of sight stay below {most_m:.2f} m"
        yield _seen(kind, "", stddev_m, most_m, words, _FEW_OBSTRUCTED, unit="m")
    on_map, bins = problem.on_map, problem.bins
    index = on_map.problem.anchor_index
    # Which ranges fit a path that drifts is seen where it is bent, not where it is of one piece.
    weights = bins.robust_weight if drifts(problem) else on_map.weights
    for k in np.unique(index).tolist():
        is_of, name = index == k, on_map.anchor_ids[k]
        unused = float(np.mean(weights[is_of] < OUTLIER_BELOW))
        num = int(np.count_nonzero(is_of))
        words = f"{round((1 - unused) * num)} of {num} ranges to anchor {name} fit the map"
        remedy = "check the anchor's id and its position"
        yield _seen("anchor hardly used", name, unused, 1 - LEAST_USED, words, remedy)
        rows = np.flatnonzero(is_of & (bins.robust_weight < DOWN_WEIGHTED_BELOW))
        if len(rows) >= _MIN_NUM_OUTLYING and len(on_map.anchor_ids) > 1:
            yield _mixed_up(problem, k, rows)
        outlying = len(rows) / num
        words = f"{100 * outlying:.0f} % of the ranges to anchor {name} are far from those right before and after"
        yield _seen("anchor's outliers", name, outlying, _MOST_OUTLYING, words, _FEW_OBSTRUCTED)


def _mixed_up(problem: Linearized, anchor: int, outlying: Indices) -> MistakeTest:
    """Return the test whether an anchor's outliers are ranges of another anchor."""
    on_map = problem.on_map
    anchors_m, index = on_map.state.anchors_m, on_map.problem.anchor_index[outlying]
    tags_m = on_map.from_anchor_m[outlying] + anchors_m[index]
    off_m = np.linalg.norm(tags_m[:, None] - anchors_m, axis=2) - on_map.problem.range_m[outlying, None]
    fitting = np.mean(np.abs(off_m) < near_m(problem.scatter_m), axis=0)
    fitting[anchor] = 0.0
    name, other = on_map.anchor_ids[anchor], on_map.anchor_ids[int(np.argmax(fitting))]
    words = f"{100 * fitting.max():.0f} % of the outliers among the ranges to anchor {name} fit anchor {other} instead"
    remedy = f"check whether two devices have the id {name}, or leave that anchor out (use_anchors)"
    return _seen(_MIXED_UP, name, float(fitting.max()), _MOST_OF_OTHER, words, remedy)


def _seen(
    name: str, subject: str, found: float, most: float, words: str, remedy: str, *, unit: str = "1"
) -> MistakeTest:
    return MistakeTest(name, subject, found, most, words, remedy, unit, size=found, smallest_detectable=most)

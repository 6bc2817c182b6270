"""What the ranges show that is no mistake of one size: noise that no radio has, anchors that have no say."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from rangesfm.arrays import Indices
from rangesfm.trust.linearized import Linearized, near_m
from rangesfm.trust.testing import MistakeTest

# Real radios show 0.03 to 0.15 m beside outliers, old ones 0.2 m: of a stddev beyond that something else is the cause.
_MOST_NOISE_M, _MOST_LASTING_M = 0.25, 0.25
# In metres for a metre of distance: a radio on 70 m is noisier than one in a room.
_NOISE_BY_DISTANCE = 0.005
_LASTING = ("time", "place", "view")
_LEAST_USED, _MOST_OUTLYING = 0.4, 0.35
# Of ranges far from their neighbours, those as long as to one other anchor; of fewer it is chance.
_MOST_OF_OTHER, _MIN_NUM_OUTLYING = 0.5, 10
_FEW_OBSTRUCTED = "place the anchors where nothing stands between them and the path"

MIXED_UP = "anchor mixed up"
# What is seen of ranges beside those right before and after.
OF_SINGLE_RANGES = ("range noise", "anchor's outliers", MIXED_UP)


def evidence(problem: Linearized) -> Iterator[MistakeTest]:
    """Of the noise as learnt beside the likeliest mistake, and of each anchor's ranges."""
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
    return _seen(MIXED_UP, name, float(fitting.max()), _MOST_OF_OTHER, words, remedy)


def _lasting_m(problem: Linearized) -> float:
    """Root mean square over cells."""
    lasting = np.isin(problem.errors.names, _LASTING)
    variances = np.trace(problem.errors.covariances_m2[lasting].sum(axis=0))
    return float(np.sqrt(variances / len(problem.cells)))


def _seen(
    name: str, subject: str, found: float, most: float, words: str, remedy: str, *, unit: str = "1"
) -> MistakeTest:
    return MistakeTest(name, subject, found, most, words, remedy, unit, size=found, smallest_detectable=most)

"""What the ranges show that is no mistake of one size: noise that no radio has, anchors that have no say."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from rangesfm.arrays import Indices
from rangesfm.trust.linearized import Linearized, near_m
from rangesfm.trust.table import MistakeTest

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
    yield _noise("range noise", problem.scatter_m, _MOST_NOISE_M + far, "scatter")
    yield _noise("lasting errors", _lasting_m(problem), _MOST_LASTING_M + far, "err for seconds")
    on_map, cells = problem.on_map, problem.cells
    index = on_map.problem.anchor_index
    for k in np.unique(index):
        is_of, name = index == k, on_map.anchor_ids[k]
        unused = float(np.mean(on_map.weights[is_of] < 0.1))
        num = np.count_nonzero(is_of)
        yield _share(
            "anchor hardly used",
            name,
            unused,
            1 - _LEAST_USED,
            f"only {round((1 - unused) * num)} of {num} ranges to anchor {name} fit the map",
            "look whether it is the anchor that it is taken for, and where it stands",
        )
        is_outlying = is_of & (cells.weight < 0.5)
        if np.count_nonzero(is_outlying) >= _MIN_NUM_OUTLYING and len(on_map.anchor_ids) > 1:
            yield _mixed_up(problem, int(k), np.flatnonzero(is_outlying))
        outlying = float(np.count_nonzero(is_outlying) / num)
        yield _share(
            "anchor's outliers",
            name,
            outlying,
            _MOST_OUTLYING,
            f"{100 * outlying:.0f} % of the ranges to anchor {name} are far from those right before and after",
            _FEW_OBSTRUCTED,
        )


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
    return _share(MIXED_UP, name, float(fitting.max()), _MOST_OF_OTHER, words, remedy)


def _lasting_m(problem: Linearized) -> float:
    """Root mean square over cells."""
    lasting = np.isin(problem.errors.names, _LASTING)
    variances = np.trace(problem.errors.covariances_m2[lasting].sum(axis=0))
    return float(np.sqrt(variances / len(problem.cells)))


def _noise(name: str, stddev_m: float, most_m: float, what: str) -> MistakeTest:
    words = f"the ranges {what} by {stddev_m:.2f} m, which no radio does in the open ({most_m:.2f} m at most)"
    return MistakeTest(name, "", stddev_m, most_m, stddev_m, None, "m", most_m, None, None, words, _FEW_OBSTRUCTED)


def _share(name: str, subject: str, share: float, most: float, words: str, remedy: str) -> MistakeTest:
    return MistakeTest(name, subject, share, most, share, None, "1", most, None, None, words, remedy)

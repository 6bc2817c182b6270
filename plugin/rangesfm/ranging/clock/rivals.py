"""Which offsets of the clocks are likely, how likely each is, and when they are too many."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rangesfm.arrays import Indices
from rangesfm.errors import GeometryError
from rangesfm.ranging.clock.fit import OffsetFit
from rangesfm.ranging.clock.search import PathSamples

REMEDY = "give the time offset (--ranges_time_offset)"
# Less likely offsets than this are not.
_MIN_PROBABILITY = 0.01
_MAX_NUM_LIKELY = 3
# Two descents that end this close, or within their stddevs, have found the same offset.
_SAME_OFFSET_S = 0.25
_SAME_OFFSET_STDDEVS = 5.0
# Log and photos are usually meant to cover each other: an offset that puts fewer ranges on the path than this share
# of the best one's is so likely beforehand.
_COVERING_SHARE = 0.7
_PRIOR_OF_THE_OTHERS = 0.05
# With fewer ranges in common than this share two offsets are judged by all that each puts on the path.
_MIN_SHARED = 0.5


class Rival(NamedTuple):
    """Another offset of the clocks that may be the right one: image time = range time + ``value_s``."""

    value_s: float
    probability: float


def likely_offsets(offsets_s: Sequence[float], log_likelihoods: Sequence[float]) -> list[tuple[int, float]]:
    """The offsets that cannot be ruled out, by their numbers, with their probabilities; the likeliest first.

    Raises:
        GeometryError: they are too many to be of use.
    """
    weights = np.exp(np.asarray(log_likelihoods) - np.max(log_likelihoods))
    likely = np.flatnonzero(weights > _MIN_PROBABILITY * weights.sum())
    likely = likely[np.argsort(-weights[likely], kind="stable")]
    probabilities = weights[likely] / weights[likely].sum()
    if len(likely) > _MAX_NUM_LIKELY:
        some = ", ".join(f"{offsets_s[k]:+.2f} s ({share:.0%})" for k, share in zip(likely[:3], probabilities))
        raise GeometryError(f"the motion does not tell apart {len(likely)} time offsets, such as {some}: {REMEDY}")
    return list(zip(likely.tolist(), probabilities.tolist()))


def likely_fits(fits: list[OffsetFit], num_on_path: Indices, path: PathSamples) -> list[tuple[OffsetFit, float]]:
    """The fits that cannot be ruled out with their probabilities, the likeliest first.

    Args:
        fits: at least one of them testable.
        num_on_path: ranges of the whole log that the offset of each fit puts on the path.

    Raises:
        GeometryError: they are too many to be of use.
    """
    order = [k for k in np.argsort([-fit.score for fit in fits] * num_on_path) if fits[k].is_testable]
    best, most = fits[order[0]], num_on_path[order[0]]
    same_s = max(_SAME_OFFSET_S, _SAME_OFFSET_STDDEVS * min(best.timing().stddev_s, 1.0))
    distinct: list[OffsetFit] = []
    log_likelihoods: list[float] = []
    for number in order:
        fit, covers = fits[number], num_on_path[number] >= _COVERING_SHARE * most
        if all(abs(fit.offset_s - other.offset_s) > same_s for other in distinct):
            distinct.append(fit)
            log_likelihoods.append(-_log_odds(best, fit, path) + np.log(1.0 if covers else _PRIOR_OF_THE_OTHERS))
    likely = likely_offsets([fit.offset_s for fit in distinct], log_likelihoods)
    return [(distinct[number], probability) for number, probability in likely]


def _log_odds(fit: OffsetFit, rival: OffsetFit, path: PathSamples) -> float:
    """Log of the ratio of their likelihoods, as if there were only so many ranges as err on their own."""
    num = min(fit.num_independent, rival.num_independent)
    mine = path.knows(fit.ranges.times_s + rival.offset_s)
    theirs = path.knows(rival.ranges.times_s + fit.offset_s)
    shared = float(min(mine.mean(), theirs.mean()))
    if shared < _MIN_SHARED:
        return num * (fit.score - rival.score)
    return num * shared * float(rival.losses[theirs].mean() - fit.losses[mine].mean())

"""Whether anchors stand as far from each other as the ranges allow, before anything is known of the path.

Two ranges of one tag at one moment and the distance between their anchors make a triangle: neither is the distance
longer than both ranges together, nor shorter than their difference. Ranges between two anchors say the distance itself.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from rangesfm.arrays import Array, Indices, Mask
from rangesfm.ranging.anchors.anchor import Anchor
from rangesfm.ranging.log import RangeKind, RangeLog

# Ranges this close in time are of one place, up to how far a tag comes meanwhile.
_SAME_MOMENT_S, _MAX_SPEED_M_PER_S = 0.2, 5.0
# What a radio without calibration may be off: a delay, and a share of the distance.
_MAX_ERROR_M, _MAX_ERROR_SHARE = 0.5, 0.1
# Of the triangles of two anchors; blocked paths spoil some of them.
_MAX_SPOILT, _MIN_TRIANGLES = 0.3, 10
_MAX_NUM_TRIANGLES = 20_000
_MAX_NUM_NAMED = 2
_UNITS = {
    "anchors are in millimetres": 1e-3,
    "anchors are in centimetres": 1e-2,
    "anchors are in feet": 0.3048,
    "ranges are in millimetres": 1e3,
    "ranges are in centimetres": 1e2,
    "ranges are in feet": 1 / 0.3048,
}


@dataclass(frozen=True)
class _Triangles:
    """n pairs of ranges, and the two anchors of each; in a pair of an anchor range, one side is 0.

    Attributes:
        pair: (n, 2) anchors.
        shortest_m, longest_m: (n,) between which their distance is.
    """

    pair: Indices
    shortest_m: Array
    longest_m: Array

    def bad_pairs(self, positions_m: Array) -> Mask:
        """(m, m) upper triangle: which two of m anchors (m, 3) are not where the ranges have them."""
        num, (first, second) = len(positions_m), self.pair.T
        distance_m = np.linalg.norm(positions_m[first] - positions_m[second], axis=1)
        error_m = _MAX_ERROR_SHARE * distance_m
        is_off = (distance_m - error_m > self.longest_m) | (distance_m + error_m < self.shortest_m)
        counts, spoilt = (
            np.bincount(num * first + second, weights=weights, minlength=num**2).reshape(num, num)
            for weights in (np.ones(len(first)), is_off.astype(np.float64))
        )
        bad: Mask = (counts >= _MIN_TRIANGLES) & (spoilt > _MAX_SPOILT * counts)
        return bad


def notes_on_distances(log: RangeLog, anchors: Sequence[Anchor]) -> Iterator[str]:
    """What does not go together of the anchors with a position, the likeliest reason, and what to do."""
    surveyed = [anchor for anchor in anchors if anchor.position_m is not None and anchor.anchor_id in log.anchor_ids]
    if len(surveyed) < 2:
        return
    ids = [anchor.anchor_id for anchor in surveyed]
    positions_m = np.array([anchor.position_m for anchor in surveyed])
    triangles = _triangles(log, ids)
    bad = triangles.bad_pairs(positions_m)
    if not bad.any():
        return
    num = len(ids) * (len(ids) - 1) // 2
    found = f"the ranges do not allow the distances between anchors in {bad.sum()} of {num} pairs"
    causes = list(_causes(triangles, ids, positions_m, bad))
    named = " and ".join(f"{ids[i]} and {ids[k]}" for i, k in np.argwhere(bad)[:_MAX_NUM_NAMED].tolist())
    likeliest = f"probably {' or '.join(causes)}" if causes else f"look at {named} first"
    yield f"{found}: {likeliest}; check labels, coordinates and units, or the map takes on what is wrong"


def _causes(triangles: _Triangles, ids: Sequence[str], positions_m: Array, bad: Mask) -> Iterator[str]:
    """What alone would explain all that is wrong."""
    in_pairs = bad.sum(axis=0) + bad.sum(axis=1)
    if in_pairs.max() == bad.sum():
        ends = [ids[k] for k in np.flatnonzero(in_pairs == bad.sum()).tolist()]
        yield f"anchor {' or '.join(ends)} stands elsewhere"
    yield from (name for name, factor in _UNITS.items() if not triangles.bad_pairs(factor * positions_m).any())
    swaps = []
    for i, k in combinations(range(len(ids)), 2):
        order = np.arange(len(ids))
        order[[i, k]] = k, i
        if not triangles.bad_pairs(positions_m[order]).any():
            swaps.append(f"the labels {ids[i]} and {ids[k]} are swapped")
    # Where many a swap explains it, none of them is a finding.
    yield from swaps if len(swaps) <= _MAX_NUM_NAMED else ()


def _triangles(log: RangeLog, ids: Sequence[str]) -> _Triangles:
    """Of ranges taken at one moment, and of ranges between anchors."""
    index_of = {anchor_id: k for k, anchor_id in enumerate(ids)}
    own = np.array([index_of.get(anchor_id, -1) for anchor_id in log.anchor_ids])
    parts = [*_at_one_moment(log, own)]
    between = log.peer_ranges(RangeKind.ANCHOR_ANCHOR)
    ends = own[between.ends].reshape(-1, 2)
    # As many copies as it takes to be believed: each says more than a triangle.
    known, ranges_m = np.repeat(ends, _MIN_TRIANGLES, axis=0), np.repeat(log.range_m[between.rows], _MIN_TRIANGLES)
    parts.append(_Triangles(known, ranges_m - _MAX_ERROR_M, ranges_m + _MAX_ERROR_M))
    pair = np.concatenate([part.pair for part in parts])
    shortest_m, longest_m = (np.concatenate([getattr(p, name) for p in parts]) for name in ("shortest_m", "longest_m"))
    rows = np.flatnonzero((pair >= 0).all(axis=1) & (pair[:, 0] != pair[:, 1]))
    rows = rows[:: max(1, len(rows) // _MAX_NUM_TRIANGLES)]
    return _Triangles(np.sort(pair[rows], axis=1), shortest_m[rows], longest_m[rows])


def _at_one_moment(log: RangeLog, own: Indices) -> Iterator[_Triangles]:
    """One part for each number of ranges by which two of a tag are apart.

    Args:
        own: (num_anchors,) number of each anchor of the log among those that are compared; -1: it is not.
    """
    names = np.array(log.image_name or (), dtype=str)
    # Photos are moments far apart.
    times_s = np.unique(names, return_inverse=True)[1] * 1e6 if log.timestamp_s is None else log.timestamp_s
    rows = np.flatnonzero(log.kind == RangeKind.TAG_ANCHOR)
    rows = rows[np.lexsort((times_s[rows], log.tag_index[rows]))]
    for lag in range(1, len(log.anchor_ids)):
        one, other = rows[:-lag], rows[lag:]
        apart_s = times_s[other] - times_s[one]
        together = (apart_s <= _SAME_MOMENT_S) & (log.tag_index[one] == log.tag_index[other])
        one, other, apart_s = one[together], other[together], apart_s[together]
        error_m = _MAX_ERROR_M + _MAX_SPEED_M_PER_S * apart_s
        first_m, second_m = log.range_m[one], log.range_m[other]
        pair = own[np.column_stack([log.anchor_index[one], log.anchor_index[other]])]
        yield _Triangles(pair, np.abs(first_m - second_m) - error_m, first_m + second_m + error_m)

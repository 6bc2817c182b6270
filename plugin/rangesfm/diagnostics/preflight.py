"""Checks of the input files before the long work; each note says what was found and what to do."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import numpy as np
import pycolmap
from scipy import special

from rangesfm.arrays import Array, Indices, Mask
from rangesfm.colmap.reprojection import MISMATCHED, photo_errors_px, point_errors
from rangesfm.errors import InputError, number_text
from rangesfm.measurements.kind_as_read import TimedLog
from rangesfm.measurements.lengths.tape import Tape
from rangesfm.measurements.mistakes import FALSE_ALARM_RATE
from rangesfm.measurements.positions.known_positions import MIN_NUM_POSITIONS
from rangesfm.measurements.ranges.anchors.anchor import Anchor
from rangesfm.measurements.ranges.anchors.site import Site
from rangesfm.measurements.ranges.mistakes.catalogue import LARGEST_RIG_M, SAME_HEIGHT_M
from rangesfm.measurements.ranges.range_log import RangeKind, RangeLog
from rangesfm.measurements.ranges.readers.columns import CANONICAL
from rangesfm.measurements.ranges.readers.table import MAPPED, TABLE
from rangesfm.survey.inputs import RangingInputs
from rangesfm.survey.settings import Survey
from rangesfm.util.files.clock_times import are_seconds_since_1970, span_text
from rangesfm.util.geometry.moments import ByPhoto
from rangesfm.util.units import TAKEN_FOR_METRES, UNITS_PER_METRE

SAME_PLACE_M = 0.01
"""Two anchors that are nearer to each other than this, metres, are in one place, which cannot be."""
# UWB radios reach some 200 m. The unit is doubted if this share of the ranges is longer than the limit.
FAR_M, _FAR_SHARE = 300.0, 0.95
# An anchor is stuck if one value makes up the first share of its ranges, while in the other anchors' ranges (median)
# the commonest value stays below the second share. If the tag stands still, all anchors repeat their values.
_STUCK_SHARE, _MOVING_SHARE, _MIN_RANGES = 0.5, 0.2, 20
# A gap between photos longer than this many median gaps is a pause between two walks.
_PAUSE = 30.0
# A log is silent for a while if it has no range for so many seconds; share of the photos' time that it may be silent.
_SILENT_S, _MAX_SILENT_SHARE = 5.0, 0.1
# Time between two logs, seconds, from which on they are of different walks or time zones.
_LONG_GAP_S = 60.0
# Least duration of the ranges, of that of the photos; largest share of the time between keyframes that are far apart.
_MIN_SHARE_OF_TIME, _MAX_SHARE_BETWEEN_FAR_PHOTOS = 0.5, 0.3
# Ranges this close in time are taken from one place, up to the way that a tag moves meanwhile.
_SAME_MOMENT_S, _MAX_SPEED_M_PER_S = 0.2, 5.0
# Largest error of a radio without calibration: a constant delay, and a share of the distance.
_MAX_ERROR_M, _MAX_ERROR_SHARE = 0.5, 0.1
# Share of the triangles of two anchors that may be wrong, as blocked paths spoil some, and the fewest triangles.
_MAX_SPOILT, _MIN_TRIANGLES = 0.3, 10
# Most triangles that are checked, and most pairs or swaps that are named.
_MAX_NUM_TRIANGLES, _MAX_NUM_NAMED = 20_000, 2
# Formats of logs for which the user may give the unit of the ranges.
_WITH_UNIT = (CANONICAL, MAPPED.name, TABLE.name)
# Units that are taken for metres.
_UNITS = {unit: TAKEN_FOR_METRES[unit] for unit in ("mm", "cm", "ft")}


def notes_before_work(survey: Survey, inputs: RangingInputs) -> Iterator[str]:
    """Return notes for the user on ranges and anchors of a survey; empty if nothing seems wrong.

    Raises:
        InputError: unless the user says in which unit ranges and anchors are, nearly all ranges are farther than radios
            reach, or only another unit explains why the ranges contradict most distances between anchors.
    """
    log, given = inputs.log, survey.ranges
    unit_is_open = log.format in _WITH_UNIT and given.range_unit is None
    if unit_is_open and (far := _beyond_reach(log)) is not None:
        raise InputError(f"{far}, or insist on --range_unit m", given.path)
    if len(log) and not {"tag_in_cam_m", "lever_arms_m"} & survey.tag.model_fields_set:
        yield (
            "the tag's place on the camera is not given, so it is taken to be at the lens: ranges are wrong by up to "
            "its distance from there; measure from lens to antenna, right, down and forward (--tag_in_cam X,Y,Z)"
        )
    for tag_id, arm_m in zip(log.tag_ids, np.linalg.norm(inputs.tag_in_cam_m, axis=1), strict=True):
        if arm_m > LARGEST_RIG_M:
            yield (
                f"the lever arm of {tag_id or 'the tag'} is {arm_m:.3g} m long, more than a camera carries: give it in "
                "metres from lens to antenna, right, down and forward (--tag_in_cam X,Y,Z)"
            )
    yield from _on_ranges(log)
    if inputs.anchor_frame == "unknown":
        return
    surveyed = {anchor.anchor_id: anchor.position_m for anchor in inputs.anchors if anchor.position_m is not None}
    yield from _on_positions(surveyed, inputs.site if inputs.anchor_frame == "site" else None)
    units_are_said = survey.anchors.unit is not None and not unit_is_open
    yield from notes_on_distances(log, inputs.anchors, None if units_are_said else survey.anchors.path or given.path)
    yield from _on_taped_anchors(inputs.tape, inputs.anchors)


def _beyond_reach(log: RangeLog) -> str | None:
    """Return what is to be said if nearly all ranges are farther than radios reach, else None."""
    rows = log.kind == RangeKind.TAG_ANCHOR
    long_m = float(np.quantile(log.range_m[rows], 1 - _FAR_SHARE)) if rows.any() else 0.0
    if long_m <= FAR_M:
        return None
    return (
        f"nearly all ranges are longer than {long_m:.4g} m, farther than UWB radios reach: their unit is probably not "
        "the metre; give it (--range_unit)"
    )


def _on_taped_anchors(tape: Tape, anchors: Sequence[Anchor]) -> Iterator[str]:
    """Yield a note for each taped distance that coordinates of its two anchors contradict, by their stated errors."""
    surveyed = {anchor.anchor_id: anchor for anchor in anchors if anchor.position_m is not None}
    between = [taped for taped in tape.distances if surveyed.keys() >= {*taped.ends}]
    threshold = np.sqrt(special.chdtri(1, FALSE_ALARM_RATE / max(len(between), 1)))
    for taped in between:
        first, second = (surveyed[end] for end in taped.ends)
        assert first.position_m is not None
        assert second.position_m is not None
        apart_m = float(np.linalg.norm(first.position_m - second.position_m))
        stddevs_m = (taped.stddev_m, first.position_stddev_m, second.position_stddev_m)
        off_m, expected_m = taped.distance_m - apart_m, float(threshold * np.linalg.norm(stddevs_m))
        if abs(off_m) > expected_m:
            yield (
                f"the taped distance from {taped.ends[0]} to {taped.ends[1]} is {taped.distance_m:.3f} m, but their "
                f"coordinates are {apart_m:.3f} m apart ({number_text(off_m, '+.3f')} m, expected within "
                f"{expected_m:.3f} m by the stated errors): look for a mistake in either"
            )


def _on_positions(positions_m: Mapping[str, Array], site: Site | None) -> Iterator[str]:
    places_m = list(positions_m.values())
    # A map gets its height and its tilt from three anchors or more.
    if site is not None and len(places_m) >= MIN_NUM_POSITIONS and np.ptp([at[2] for at in places_m]) < SAME_HEIGHT_M:
        yield (
            f"all {len(places_m)} anchors have one height, {site.height_text(places_m[0])} m: if nobody "
            "measured it, the map's height and tilt rest on a guess, and the ranges cannot show it; measure the "
            "heights of the antennas"
        )
    for one, other in combinations(positions_m, 2):
        if np.linalg.norm(positions_m[one] - positions_m[other]) < SAME_PLACE_M:
            yield (
                f"anchors {one} and {other} have the same position: one of them stands elsewhere; "
                "correct it, or leave its coordinates empty"
            )


def _on_ranges(log: RangeLog) -> Iterator[str]:
    if (far := _beyond_reach(log)) is not None:
        yield far
    rows = log.kind == RangeKind.TAG_ANCHOR
    of_anchors = [log.range_m[rows & (log.anchor_index == k)] for k in range(len(log.anchor_ids))]
    shares = np.array([_share_of_one_value(ranges_m) for ranges_m in of_anchors])
    for k in np.flatnonzero(shares > _STUCK_SHARE):
        others = np.delete(shares, k)
        if len(others) and np.median(others) < _MOVING_SHARE:
            yield (
                f"anchor {log.anchor_ids[k]} reads one and the same value in {100 * shares[k]:.0f} % of its ranges "
                "while the others change: it is probably stuck; leave it out (--use_anchors)"
            )


def _share_of_one_value(ranges_m: Array) -> float:
    """Return the share of an anchor's ranges that have the commonest value; 0 for too few ranges."""
    if len(ranges_m) < _MIN_RANGES:
        return 0.0
    return float(np.unique(ranges_m, return_counts=True)[1].max() / len(ranges_m))


def notes_on_times(timed: TimedLog, photos_s: Array) -> Iterator[str]:
    """Return notes on a log whose time offset is to be searched for.

    Args:
        photos_s: times of the photos by their clock, in any order.
    """
    log_s, words = timed.timestamp_s, timed.words
    if timed.offset_s is not None or len(log_s) < 2 or len(photos_s) < 2:
        return
    log, photos = (log_s.min(), log_s.max()), (photos_s.min(), photos_s.max())
    lasts_s, photos_last_s = log[1] - log[0], photos[1] - photos[0]
    if lasts_s < _MIN_SHARE_OF_TIME * photos_last_s:
        yield (
            f"the {words} last {lasts_s:.4g} s, the photos {photos_last_s:.4g} s: most photos have none; check that "
            "log and photos are of one walk, and the unit of the times"
        )
    gap_s = max(log[0] - photos[1], photos[0] - log[1])
    if all(map(are_seconds_since_1970, (*log, *photos))) and gap_s > _LONG_GAP_S:
        yield (
            f"by their clocks, {words} ({timed.span}) and photos ({span_text(*photos)}) are {gap_s / 3600:.2g} h "
            "apart: another time zone, or another walk; the offset is searched for, check what is found"
        )


def notes_on_silence(radio_s: Array, photos_s: Array, *, is_one_clock: bool) -> Iterator[str]:
    """Return a note if there are no ranges for a good part of the time in which photos were taken.

    Args:
        radio_s, photos_s: times of ranges and photos, in any order.
        is_one_clock: whether both are by one clock. Otherwise only how long each lasts is compared.
    """
    radio_s, photos_s = np.unique(radio_s), np.unique(photos_s)
    if len(radio_s) < 2 or len(photos_s) < 2:
        return
    steps_s, gaps_s = np.diff(photos_s), np.diff(radio_s)
    is_walk = steps_s <= _PAUSE * np.median(steps_s)
    is_silent = gaps_s > max(_SILENT_S, _PAUSE * float(np.median(gaps_s)))
    walked_s = float(steps_s[is_walk].sum())
    if is_one_clock:
        middle_s = (photos_s[1:] + photos_s[:-1]) / 2
        gap = np.searchsorted(radio_s, middle_s) - 1
        is_outside = (gap < 0) | (gap >= len(gaps_s))
        silent_s = float(steps_s[is_walk & (is_outside | is_silent[np.clip(gap, 0, len(gaps_s) - 1)])].sum())
    else:
        lasts_s = float(radio_s[-1] - radio_s[0])
        if lasts_s < _MIN_SHARE_OF_TIME * (photos_s[-1] - photos_s[0]):
            return  # then the times themselves are in doubt
        silent_s = walked_s - (lasts_s - float(gaps_s[is_silent].sum()))
    if silent_s > max(_SILENT_S, _MAX_SILENT_SHARE * walked_s):
        longest = int(np.argmax(gaps_s))
        where = f" (such as from {radio_s[longest]:.1f} to {radio_s[longest + 1]:.1f} s of the log)"
        yield (
            f"for {silent_s:.0f} of the {walked_s:.0f} s of the photos there are no ranges"
            f"{where if is_silent.any() else ''}: there the map rests on the photos alone"
        )


def notes_on_gaps(photos_s: Array, max_gap_s: float) -> Iterator[str]:
    """Return a note if keyframes within a walk are too far apart for the ranges between them.

    Args:
        photos_s: times of the keyframes, ascending.
        max_gap_s: ranges between keyframes farther apart than this are left out.
    """
    gaps_s = np.diff(np.unique(photos_s))
    gaps_s = gaps_s[gaps_s <= _PAUSE * np.median(gaps_s)] if len(gaps_s) else gaps_s
    if len(gaps_s) and (share := gaps_s[gaps_s > max_gap_s].sum() / gaps_s.sum()) > _MAX_SHARE_BETWEEN_FAR_PHOTOS:
        yield (
            f"for {100 * share:.0f} % of the time keyframes are more than {max_gap_s:g} s apart (in the median "
            f"{np.median(gaps_s):.3g} s): ranges between those are left out; use more of the photos, or allow more by "
            "--max_interpolation_gap_s if the camera moved slowly"
        )


def notes_on_model(model: pycolmap.Reconstruction) -> Iterator[str]:
    """Return notes on a model that the user supplied."""
    errors = point_errors(model)
    if not errors.fit:
        yield f"{errors.apart('the model', 'its photos')}: {MISMATCHED}"
        return
    off_px = {name: off for name, off in photo_errors_px(model).items() if off > errors.max_median_px}
    if off_px:
        worst = max(off_px, key=lambda name: off_px[name])
        others = f" and {len(off_px) - 1} more" if len(off_px) > 1 else ""
        yield (
            f"photo {worst}{others}: most of its points lie more than {errors.max_median_px:.3g} px from where the "
            "photo shows them, so that its pose is wrong; take it out of the model, or reconstruct anew"
        )


@dataclass(frozen=True)
class _Triangles:
    """Bounds on distances between pairs of anchors, from n pairs of ranges or ranges between two anchors.

    Attributes:
        pair: (n, 2) indices of the two anchors.
        shortest_m, longest_m: (n,) bounds on the distance between them.
    """

    pair: Indices
    shortest_m: Array
    longest_m: Array

    def bad_pairs(self, positions_m: Array) -> Mask:
        """Return an (m, m) mask, upper triangle, of anchor pairs whose distance contradicts the ranges.

        Args:
            positions_m: (m, 3) of the anchors.
        """
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


def notes_on_distances(log: RangeLog, anchors: Sequence[Anchor], in_open_unit: Path | None = None) -> Iterator[str]:
    """Return a note if distances between anchors contradict the ranges: the likeliest reason and what to do.

    Two simultaneous ranges of one tag and the distance between their anchors form a triangle: the distance is at most
    the sum of the ranges, and at least their difference. Ranges between two anchors measure the distance directly.

    Args:
        in_open_unit: file with distances of which nobody has said the unit.

    Raises:
        InputError: most pairs of anchors are contradicted, and nothing but another unit of that file explains them.
    """
    surveyed = [anchor for anchor in anchors if anchor.position_m is not None and anchor.anchor_id in log.anchor_ids]
    if len(surveyed) < 2:
        return
    ids = [anchor.anchor_id for anchor in surveyed]
    positions_m = np.array([anchor.position_m for anchor in surveyed])
    triangles = _triangles(log, ids)
    bad = triangles.bad_pairs(positions_m)
    if not bad.any():
        return
    num_bad, num_pairs = int(bad.sum()), len(ids) * (len(ids) - 1) // 2
    causes = [*_causes(triangles, ids, positions_m, bad)]
    found = f"in {num_bad} of {num_pairs} pairs of anchors, their coordinates and the ranges contradict each other"
    are_of_unit = causes and all(cause.endswith(tuple(_UNITS.values())) for cause in causes) and 2 * num_bad > num_pairs
    if in_open_unit is not None and are_of_unit:
        raise InputError(
            f"{found}; they would not if {' or '.join(causes)}: give the unit (--anchor_unit, --range_unit), or insist "
            "with both in m",
            in_open_unit,
        )
    named = " and ".join(f"{ids[i]} and {ids[k]}" for i, k in np.argwhere(bad)[:_MAX_NUM_NAMED].tolist())
    likeliest = f"probably {' or '.join(causes)}" if causes else f"look at {named} first"
    yield f"{found}: {likeliest}; check labels, coordinates and units, or the map will be wrong too"


def _causes(triangles: _Triangles, ids: Sequence[str], positions_m: Array, bad: Mask) -> Iterator[str]:
    """Yield each single mistake that would explain all contradictions."""
    in_pairs = bad.sum(axis=0) + bad.sum(axis=1)
    if in_pairs.max() == bad.sum():
        ends = [ids[k] for k in np.flatnonzero(in_pairs == bad.sum()).tolist()]
        unit = _unit_of_one(positions_m, in_pairs == bad.sum()) if len(ends) == 1 else ""
        yield f"anchor {' or '.join(ends)} stands elsewhere{unit}"
    for what, of_metre in (("anchors", -1), ("ranges", 1)):  # ranges in another unit are as if the anchors' were one
        for unit, words in _UNITS.items():
            if not triangles.bad_pairs(UNITS_PER_METRE[unit] ** of_metre * positions_m).any():
                yield f"{what} are in {words}"
    swaps = []
    for i, k in combinations(range(len(ids)), 2):
        order = np.arange(len(ids))
        order[[i, k]] = k, i
        if not triangles.bad_pairs(positions_m[order]).any():
            swaps.append(f"the labels {ids[i]} and {ids[k]} are swapped")
    # If many swaps explain the contradictions, none of them is reported.
    yield from swaps if len(swaps) <= _MAX_NUM_NAMED else ()


def _unit_of_one(positions_m: Array, is_it: Mask) -> str:
    """Return what is to be said of an anchor whose coordinates are among the others' if read in a smaller unit, or "".

    Args:
        positions_m: (n, 3). is_it: (n,) true for the anchor.
    """
    others_m = positions_m[~is_it]
    margin_m = np.ptp(others_m, axis=0).max()
    low_m, high_m = others_m.min(axis=0) - margin_m, others_m.max(axis=0) + margin_m
    at_m = positions_m[is_it][0]
    if np.count_nonzero((at_m < low_m) | (at_m > high_m)) < 2:  # a lost decimal point in one of them
        return ""
    for unit in ("cm", "mm"):
        read_m = at_m / UNITS_PER_METRE[unit]
        if np.all((read_m >= low_m) & (read_m <= high_m)):
            return f", or its coordinates are in {_UNITS[unit]} and the others' in metres"
    return ""


def _triangles(log: RangeLog, ids: Sequence[str]) -> _Triangles:
    """Collect the bounds from simultaneous ranges and from ranges between anchors."""
    index_of = {anchor_id: k for k, anchor_id in enumerate(ids)}
    own = np.array([index_of.get(anchor_id, -1) for anchor_id in log.anchor_ids])
    parts = [*_at_one_moment(log, own)]
    between = np.flatnonzero(log.kind == RangeKind.ANCHOR_ANCHOR)
    ends = np.column_stack([log.peer_index, log.anchor_index])[between]
    # A range between anchors says more than a triangle, so it is repeated as often as is needed to be believed.
    known, ranges_m = np.repeat(own[ends], _MIN_TRIANGLES, axis=0), np.repeat(log.range_m[between], _MIN_TRIANGLES)
    parts.append(_Triangles(known, ranges_m - _MAX_ERROR_M, ranges_m + _MAX_ERROR_M))
    pair = np.concatenate([part.pair for part in parts])
    shortest_m, longest_m = (np.concatenate([getattr(p, name) for p in parts]) for name in ("shortest_m", "longest_m"))
    rows = np.flatnonzero((pair >= 0).all(axis=1) & (pair[:, 0] != pair[:, 1]))
    rows = rows[:: max(1, len(rows) // _MAX_NUM_TRIANGLES)]
    return _Triangles(np.sort(pair[rows], axis=1), shortest_m[rows], longest_m[rows])


def _at_one_moment(log: RangeLog, own: Indices) -> Iterator[_Triangles]:
    """Yield the bounds from pairs of ranges of one tag, separately for each lag (number of ranges between the two).

    Args:
        own: (num_anchors,) index of each anchor of the log among the compared ones; -1 for an anchor not compared.
    """
    # Ranges of different photos are not simultaneous, so photos get times that are far apart.
    times_s = log.moments.sort_keys * (1e6 if isinstance(log.moments, ByPhoto) else 1.0)
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

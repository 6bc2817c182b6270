"""Which numbers in a log are measurements: not failure codes, nothing that no radio can measure, and no repetitions.

A logger may hold a value until the next one comes: at a fixed rate, or for all anchors where one has a new value.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from rangesfm.arrays import Array, Indices, Mask, rows_by_key
from rangesfm.errors import InputError
from rangesfm.measurements.ranges.range_log import RangeLog
from rangesfm.measurements.ranges.readers.unclear import Choice, UnclearFileError
from rangesfm.util.files.text_tables import MAX_NUMBER
from rangesfm.util.geometry.moments import ByPhoto

REACH_M = 2000.0
"""Range that no UWB radio measures; the farthest reach somewhat more than one kilometre."""

# A number is far from the others if it exceeds the next smaller one by the factor _FAR, and at least _MIN_NUM numbers
# are smaller. A far number means no measurement if it occurs _MIN_NUM_OF_CODE times. A radio has few such codes.
# Several of them come between measurements, unlike the ranges of an anchor that is far away.
_FAR, _MIN_NUM, _MIN_NUM_OF_CODE, _MOST_CODES, _MOST_SHARE_OF_CODES = 4.0, 20, 3, 4, 0.7
_NOTHING = 1e-12  # a smaller number counts as 0, in any unit
# Numbers of bits with which radios count, and how far below the largest number, as a share of it, small negative
# numbers come to lie that are written as if they had no sign.
_BITS, _WRAPPED_SHARE = (15, 16, 24, 31, 32), 0.01
_SHOWN = 3  # number of codes that a note names


def which_are_measured(ranges: Array, link: Indices, path: Path) -> tuple[Mask, tuple[str, ...]]:
    """Return which ranges in a file (n,), in any unit, are measurements, and notes about the others.

    A number that is not positive is no measurement. Neither are failure codes such as 65535, of which there may be
    several: numbers far above all others that occur often, or have all bits set.

    Args:
        link: (n,) number of each range's pair of nodes.

    Raises:
        InputError: there is no measurement.
    """
    measured: Mask = (ranges > _NOTHING) & (ranges <= MAX_NUMBER)
    codes, counts = _failure_codes(ranges[measured], link[measured])
    measured &= ~np.isin(ranges, codes)
    if not measured.any():
        said = f"all {len(ranges)} records say that there was no measurement" if len(ranges) else "no records"
        raise InputError(f"no usable range: {said}", path)
    if not len(codes):
        return measured, ()
    said, num = _listed([f"{code:.10g}" for code in codes]), int(counts.sum())
    times, taken = f"{num} time{'s' * (num > 1)}", "far above all other ranges"
    if len(codes) == 1:
        note = f"{said} occurs {times}, {taken}: it is taken to mean no measurement"
    else:
        note = f"{said} occur {times} together, {taken}: they are taken to mean no measurement"
    return measured, (note,)


def _failure_codes(positive: Array, link: Indices) -> tuple[Array, Indices]:
    """Return the numbers that mean no measurement, and how often each occurs."""
    values, index, counts = np.unique(positive, return_inverse=True, return_counts=True)
    are_codes = np.zeros(len(values), bool)
    num_up_to, num_above = np.cumsum(counts), np.arange(len(values))[::-1]
    is_body = (num_up_to >= _MIN_NUM) & ((num_up_to >= len(positive) / 2) | (num_above <= _MOST_CODES))
    gaps = np.flatnonzero(is_body[:-1] & (values[1:] > _FAR * values[:-1]))
    if len(gaps):
        is_far = values > values[gaps[0]]
        often = is_far & (counts >= _MIN_NUM_OF_CODE)
        if np.count_nonzero(is_far) > 1:
            share_far = np.bincount(link, is_far[index]) / np.maximum(np.bincount(link), 1)
            between = np.bincount(index, share_far[link] < _MOST_SHARE_OF_CODES, len(values)) > 0
            often &= between & (np.count_nonzero(often & between) <= _MOST_CODES)
        are_codes = often | (is_far & _have_all_bits(values, _WRAPPED_SHARE))
    often_full = (counts >= _MIN_NUM_OF_CODE) & _have_all_bits(values, 0.0)
    for k in range(len(values) - 1, _MIN_NUM - 1, -1):  # the largest numbers need no gap if all their bits are set
        if not (often_full[k] or are_codes[k]):
            break
        are_codes[k] = True
    return values[are_codes], counts[are_codes]


def _have_all_bits(values: Array, share: float) -> Mask:
    """Return which numbers (n,) are the largest of a counter, or less than that by a share, in m, cm or mm."""
    counted = np.asarray(values)[:, None, None] * np.array([1.0, 100.0, 1000.0])[:, None]
    full = 2.0 ** np.array(_BITS) - 1
    return np.asarray(np.any((counted <= full * (1 + 1e-9)) & (counted >= full * (1 - 1e-9 - share)), axis=(1, 2)))


def which_are_within_reach(ranges_m: Array, path: Path, others: Sequence[Choice] = ()) -> tuple[Mask, tuple[str, ...]]:
    """Return which ranges (n,) a UWB radio can have measured, and notes about the others.

    Args:
        others: ways to read the log if the unit is wrong.

    Raises:
        InputError: most of the ranges are beyond the reach of any radio, so that their unit is wrong.
    """
    near: Mask = ranges_m <= REACH_M
    num = int(np.count_nonzero(~near))
    if not num:
        return near, ()
    if 2 * num > len(ranges_m):
        message = f"most ranges are beyond {REACH_M:g} m, where no UWB radio reaches (half of them beyond "
        message += f"{np.median(ranges_m):.6g} m): is their unit right?"
        raise UnclearFileError("ranges", path, (), others, message)
    said = f"{num} range{'s are' if num > 1 else ' is'} beyond {REACH_M:g} m, where no UWB radio reaches"
    return near, (f"{said}, such as {ranges_m[~near][0]:.10g} m: taken to mean no measurement",)


def _listed(words: Sequence[str]) -> str:
    if len(words) > _SHOWN:
        return f"{', '.join(words[:_SHOWN])} and {len(words) - _SHOWN} more"
    return " and ".join(words) if len(words) < 3 else f"{', '.join(words[:-1])} and {words[-1]}"


# A radio that rounds its ranges may measure the same value again, but not where values jump by several steps of the
# rounding: with noise or motion of k steps, a value repeats with a probability of about 0.4/k. Values between two such
# jumps that are nearly all repeated are held. So are values between larger jumps of which fewer are repeated, if few
# are repeated more than once; they are in a log that is little faster than the radio. A few jumps say nothing, because
# in steady motion the jumps beside a repeated value are larger.
_JUMP_STEPS, _HELD_SHARE, _MIN_SHARE_BETWEEN = 1.5, 0.7, 0.1
_LARGE_JUMP_STEPS, _SOMETIMES_HELD_SHARE, _MIN_SHARE_FAR_BETWEEN, _MOST_HELD_LONGER = 4.5, 0.3, 0.3, 0.2
_MIN_NUM = 15  # values between two jumps, from which something follows
_STEP_PERCENTILE = 5.0  # of the differences between neighbouring values; some may be between the steps


def without_held(log: RangeLog) -> RangeLog:
    """Return the log without repetitions of values that were held, with a note; the log itself if there are none.

    The first of equal values stays, at the time at which it came.
    """
    if isinstance(log.moments, ByPhoto):
        return log
    firsts: list[Indices] = []
    lengths, jumps = [np.zeros(0, np.int64)], [np.zeros(0)]
    for rows in rows_by_key(log.tag_index, log.anchor_index, log.peer_index) if len(log) else ():
        rows = rows[np.argsort(log.timestamp_s[rows], kind="stable")]
        values = log.range_m[rows]
        begins = np.flatnonzero(np.concatenate([[True], np.diff(values) != 0]))
        firsts.append(rows[begins])
        steps = np.diff(np.unique(values))
        if len(begins) > 2:
            sizes = np.abs(np.diff(values[begins])) / np.percentile(steps, _STEP_PERCENTILE)
            lengths.append(np.diff(begins)[1:])
            jumps.append(np.minimum(sizes[:-1], sizes[1:]))
    kept = np.sort(np.concatenate([np.zeros(0, np.int64), *firsts]))
    if not _are_held(np.concatenate(lengths), np.concatenate(jumps)):
        return log
    note = (
        f"each range is repeated about {len(log) / len(kept):.3g} times: the log holds the last range until the next; "
        f"only the first of each is used, {len(kept)} of {len(log)}"
    )
    return replace(log.subset(kept), notes=(*log.notes, note))


def _are_held(lengths: Indices, jumps: Array) -> bool:
    """Return whether values are held.

    Args:
        lengths: (n,) how often each value comes in a row.
        jumps: (n,) the smaller of the jumps before and after it, in steps of the rounding.
    """
    between, far_between = lengths[jumps > _JUMP_STEPS], lengths[jumps > _LARGE_JUMP_STEPS]
    if len(between) >= max(_MIN_NUM, _MIN_SHARE_BETWEEN * len(lengths)) and np.mean(between > 1) > _HELD_SHARE:
        return True
    return bool(
        len(far_between) >= max(_MIN_NUM, _MIN_SHARE_FAR_BETWEEN * len(lengths))
        and np.mean(far_between > 1) > _SOMETIMES_HELD_SHARE
        and np.mean(far_between > 2) < _MOST_HELD_LONGER
    )

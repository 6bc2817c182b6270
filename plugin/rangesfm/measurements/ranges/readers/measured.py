"""Which numbers in a log are measurements: not failure codes, and nothing that no radio can measure."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from rangesfm.arrays import Array, Indices, Mask
from rangesfm.errors import InputError
from rangesfm.util.files.text_tables import MAX_NUMBER

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


def which_are_within_reach(ranges_m: Array, path: Path, advice: Sequence[str] = ()) -> tuple[Mask, tuple[str, ...]]:
    """Return which ranges (n,) a UWB radio can have measured, and notes about the others.

    Args:
        advice: what to type if the unit is wrong.

    Raises:
        InputError: most of the ranges are beyond the reach of any radio, so that their unit is wrong.
    """
    near: Mask = ranges_m <= REACH_M
    num = int(np.count_nonzero(~near))
    if not num:
        return near, ()
    if 2 * num > len(ranges_m):
        message = f"most ranges are beyond {REACH_M:g} m, where no UWB radio reaches (half of them beyond "
        raise InputError(f"{message}{np.median(ranges_m):.6g} m): is their unit right?", path, advice=advice)
    said = f"{num} range{'s are' if num > 1 else ' is'} beyond {REACH_M:g} m, where no UWB radio reaches"
    return near, (f"{said}, such as {ranges_m[~near][0]:.10g} m: taken to mean no measurement",)


def _listed(words: Sequence[str]) -> str:
    if len(words) > _SHOWN:
        return f"{', '.join(words[:_SHOWN])} and {len(words) - _SHOWN} more"
    return " and ".join(words) if len(words) < 3 else f"{', '.join(words[:-1])} and {words[-1]}"

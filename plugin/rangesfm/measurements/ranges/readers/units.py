"""Units of times and ranges, from a column's name, else from its values; the user is asked if they are ambiguous."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from rangesfm.arrays import Array, Indices, rows_by_key
from rangesfm.errors import InputError
from rangesfm.measurements.ranges.readers.measured import REACH_M
from rangesfm.measurements.ranges.readers.times import SECONDS_PER_UNIT, unit_by_digits
from rangesfm.measurements.ranges.readers.unclear import Choice, UnclearFileError
from rangesfm.measurements.ranges.readers.vocabulary import TIMES, named_length_unit, named_unit, words_of
from rangesfm.util.files.clock_times import are_seconds_since_1970
from rangesfm.util.units import UNITS_PER_METRE

_MIN_NUM = 20  # number of values below which the values do not show their unit
# Smallest plausible median step between times, in seconds, by unit. In other units than seconds, a smaller step means
# that the unit is wrong.
_FASTEST_S = {"s": 0.0, "ms": 2e-3, "us": 2e-3, "ns": 2e-3}
SLOWEST_S = 5.0
"""Largest plausible median step between ranges, in seconds."""
# Smallest mean step between times in seconds. With a smaller one the times are minutes, hours, or days like those of
# Excel and MATLAB.
_FASTEST_ON_AVERAGE_S = 1e-4
# Number of the day 1970-01-01 in Excel and in MATLAB, by the interval in which present days are.
_DAYS_OF_1970 = {(3e4, 6e4): 25569.0, (7e5, 8e5): 719529.0}
# Largest speed of a tag, largest range, and largest noise of a range, the latter two by unit.
_FASTEST_M_PER_S = 30.0
_LARGEST_M = {"m": 1000.0, "cm": 300.0, "mm": 300.0}
_NOISE_M = {"m": 3.0, "cm": 0.6, "mm": 0.6}
# Percentile that tells how long the ranges are, of those up to a multiple of the median; some may be garbage. Ranges in
# cm or mm must exceed the first length at this percentile, or the second one if they have decimals, because decimals
# without the name of a unit usually mean metres.
_MOST, _FARTHEST = 80.0, 100.0
_NEAR_M, _NEAR_WITH_DECIMALS_M = 0.6, 2.0
# Ranges of one pair of nodes are in two units if there are at least so many of each, with such a gap between them, ...
_MIN_NUM_IN_UNIT, _GAP = 3, 3.0
# ... such a share of the longer ones would be among the shorter or near them, and they are such a share of all ranges.
_MIN_SHARE_INSIDE, _WIDENED, _MIN_SHARE_IN_UNIT = 0.95, 1.5, 0.05
# Largest share of ranges that differ from the one before by more than noise and motion allow.
_MAX_SHARE_OF_JUMPS = 0.25


Ask = Callable[[Sequence[str], str], InputError]
"""Function that returns the error which asks for one of several units, given the units and what was found."""


def which_unit(path: Path, quantity: str, units: Sequence[str], why: str) -> UnclearFileError:
    """Return the error that asks for an ambiguous unit of a log.

    Args:
        quantity: "range" or "timestamp".
        why: what was found.
    """
    flag, either = f"{quantity}_unit", " or ".join(units)
    message = f"the {quantity} has {why}, which may be {either}; say which by --{flag} (in a survey file: {flag})"
    return UnclearFileError("ranges", path, (), [Choice("", {flag: unit}) for unit in units], message)


def time_unit(name: str, times: Array, notes: list[str], ask: Ask, slowest_s: float = SLOWEST_S) -> str:
    """Return the unit of a column of times, and add a note if it is not from the name.

    Args:
        slowest_s: largest plausible median step between times.

    Raises:
        InputError: the unit is ambiguous.
    """
    named, distinct = named_unit(words_of(name), TIMES), np.unique(times)
    by_digits = unit_by_digits(float(np.median(times))) if len(times) else None
    step = float(np.median(np.diff(distinct))) if len(distinct) > 1 else 0.0
    is_so = by_digits is not None and step * SECONDS_PER_UNIT[by_digits] <= slowest_s
    # A finer unit in the name is believed, because it may belong to a clock that started after 1970.
    if by_digits is not None and (is_so if named is None else SECONDS_PER_UNIT[named] > SECONDS_PER_UNIT[by_digits]):
        notes.append(f"{name} has as many digits as {by_digits} since 1970: taken as {by_digits}")
        return by_digits
    if named is not None or len(distinct) < _MIN_NUM:
        return named or "s"
    mean_step = float(distinct[-1] - distinct[0]) / len(times)
    if mean_step < _FASTEST_ON_AVERAGE_S:
        slow = [unit for unit in ("min", "h", "d") if mean_step * SECONDS_PER_UNIT[unit] <= slowest_s]
        if not days_before_1970(distinct):
            raise ask(slow, f"steps of {mean_step:.2g} between its numbers")
        notes.append(f"{name} looks like days (steps of {mean_step:.2g}): taken as such")
        return "d"
    can_be = [unit for unit, least in _FASTEST_S.items() if least <= step * SECONDS_PER_UNIT[unit] <= slowest_s]
    if can_be == ["s"] or are_seconds_since_1970(float(distinct[0])):
        return "s"
    if len(can_be) != 1:
        raise ask(can_be or [*_FASTEST_S], f"steps of {step:g} between its numbers")
    notes.append(f"{name} looks like {can_be[0]} (steps of {step:g}): taken as such")
    return can_be[0]


def days_before_1970(days: Array) -> float:
    """Return the number of the day 1970-01-01 in the count of Excel or MATLAB, or 0 if it is neither."""
    middle = float(np.median(days)) if len(days) else 0.0
    return next((first for (low, high), first in _DAYS_OF_1970.items() if low < middle < high), 0.0)


def range_unit(name: str, ranges: Array, times: Array, pair: Indices, notes: list[str], ask: Ask) -> str:
    """Return the unit of a column of positive ranges, and add a note if it is not from the name.

    Args:
        times: (n,) seconds, or empty if they are not known.
        pair: (n,) index of each range's pair of nodes.

    Raises:
        InputError: the unit is ambiguous.
    """
    named = named_length_unit(name)
    if named is not None or len(ranges) < _MIN_NUM:
        return named or "m"
    most = float(np.percentile(ranges[ranges <= _FARTHEST * np.median(ranges)], _MOST))
    are_whole = bool(np.all(ranges == np.round(ranges)))
    can_be = [
        unit
        for unit, per_metre in UNITS_PER_METRE.items()
        if unit in _LARGEST_M
        and (not are_whole if unit == "m" else most / per_metre >= (_NEAR_M if are_whole else _NEAR_WITH_DECIMALS_M))
        and most / per_metre <= _LARGEST_M[unit]
        and _share_of_jumps(ranges / per_metre, times, pair, unit) <= _MAX_SHARE_OF_JUMPS
    ]
    if can_be == ["m"]:
        return "m"
    kind = f"{'whole' if are_whole else 'decimal'} numbers, most of them up to {most:g}"
    if len(can_be) != 1:
        raise ask(can_be or [*_LARGEST_M], kind)
    notes.append(f"{name} looks like {can_be[0]} ({kind}): taken as such")
    return can_be[0]


def units_within_reach(ranges: Array, unit: str) -> list[str]:
    """Return the units other than ``unit`` in which most of some ranges (n,) are within the reach of a radio."""
    middle = float(np.median(ranges))
    return [other for other in ("cm", "mm", "ft") if other != unit and middle / UNITS_PER_METRE[other] <= REACH_M]


def refuse_two_units(ranges_m: Array, pair: Indices, line: Indices, path: Path) -> None:
    """Refuse a log whose ranges are in metres in some lines and in centimetres or millimetres in others.

    Then those of one pair of nodes have a wide gap between them, and all above it are as many times too long.

    Args:
        ranges_m: (n,) as they were read. pair: (n,) number of each range's pair of nodes. line: (n,) in the file.

    Raises:
        InputError: at least a twentieth of the ranges are in another unit than the others; it names a line of each.
    """
    for times, smaller in ((100.0, "cm"), (1000.0, "mm")):
        is_other = np.zeros(len(ranges_m), bool)
        for rows in rows_by_key(pair):
            ordered = np.sort(ranges_m[rows])
            gap = int(np.argmax(ordered[1:] / ordered[:-1])) if len(ordered) > 1 else 0
            low, high = ordered[: gap + 1], ordered[gap + 1 :]
            if min(len(low), len(high)) < _MIN_NUM_IN_UNIT or high[0] < _GAP * low[-1]:
                continue
            are_inside = (high / times >= low[0] / _WIDENED) & (high / times <= low[-1] * _WIDENED)
            if np.mean(are_inside) >= _MIN_SHARE_INSIDE:
                is_other[rows] = ranges_m[rows] > low[-1]
        if np.mean(is_other) >= _MIN_SHARE_IN_UNIT:
            first, other = int(np.argmax(is_other)), int(np.argmin(is_other))
            raise InputError(
                f"the range is {ranges_m[first]:g} m here and {ranges_m[other]:g} m in line {line[other]}, and "
                f"{np.count_nonzero(is_other)} of {len(ranges_m)} ranges are {times:g} times as long as the others, as "
                f"in {smaller}: write all in one unit",
                path,
                int(line[first]),
            )


def _share_of_jumps(ranges_m: Array, times: Array, pair: Indices, unit: str) -> float:
    """Return the share of ranges that differ from their pair's previous one by more than noise and motion allow.

    Ranges that are too long for the unit are left out.
    """
    if not len(times):
        return 0.0
    order = np.lexsort((times, pair))
    order, noise_m = order[ranges_m[order] <= _LARGEST_M[unit]], _NOISE_M[unit]
    same = np.diff(pair[order]) == 0
    moved, seconds = np.abs(np.diff(ranges_m[order]))[same], np.diff(times[order])[same]
    return float(np.mean(moved > noise_m + _FASTEST_M_PER_S * seconds)) if len(moved) else 0.0

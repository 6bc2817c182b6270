"""Tests of measured lengths: each against all else, and all of them against ranges and known positions."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy import special

from rangesfm.diagnostics.diagnosis import Diagnosis
from rangesfm.diagnostics.hypothesis_tests import MistakeTest, finite
from rangesfm.diagnostics.scale_bound import hidden_lengths
from rangesfm.distances.tape import Tape, TapedDistance
from rangesfm.errors import number_text
from rangesfm.inference.linear_map import FALSE_ALARM_RATE, noncentrality
from rangesfm.scale.scale_by_lengths import LengthScale
from rangesfm.scale.scale_estimate import ScaleEstimate

_MEASURE_AGAIN = "look whether it was mistyped, or measure it again"


def diagnose_lengths(lengths: LengthScale | None, estimate: ScaleEstimate, tape: Tape) -> Diagnosis:
    """Return the tests of measured lengths; empty if there are none.

    Args:
        lengths: on the final map. tape: to whose rows these refer.
    """
    if lengths is None:
        return Diagnosis((), ())
    taped = [tape.distances[row] for row in lengths.rows.tolist()]
    rows = list(_of_each(lengths, taped))
    left_out = [
        f"probably {row.words} ({np.sqrt(row.statistic):.0f} stddevs): {row.remedy}; it is left out"
        for row, is_kept in zip(rows, lengths.is_kept, strict=True)
        if not is_kept
    ]
    open_words = [row.words for row, is_kept in zip(rows, lengths.is_kept, strict=True) if is_kept and row.rejected]
    either = [f"either {'; or '.join(open_words)}: {_MEASURE_AGAIN}"] if open_words else []
    against = [
        *against_other(estimate, "lengths", "ranges", "measure a length again, and calibrate the radio"),
        *against_other(estimate, "lengths", "positions", "measure a length again, and look at the units of both"),
    ]
    reasons = (*left_out, *either, *(f"{row.words}: {row.remedy}" for row in against if row.rejected))
    # Printed tags are shown only if something was found: their sides are many and alike.
    told = [row for row, one in zip(rows, taped, strict=True) if row.rejected or not one.is_printed]
    told.sort(key=lambda row: row.threshold - row.statistic)
    hidden = hidden_lengths(lengths, min((row.stddev for row in against if row.stddev is not None), default=None))
    return Diagnosis((*told, *against), reasons, hidden=hidden)


def _of_each(lengths: LengthScale, taped: list[TapedDistance]) -> Iterator[MistakeTest]:
    for k, one in enumerate(taped):
        size_m, stddev_m = float(lengths.too_long_m[k]), float(lengths.stddev_m[k])
        smallest_m = float(np.sqrt(noncentrality(1))) * stddev_m
        is_known = np.isfinite(stddev_m)
        between = f"{one.ends[0]} to {one.ends[1]}"
        yield MistakeTest(
            "length",
            between,
            float(lengths.statistic[k]),
            lengths.threshold,
            words=f"the length from {between} is given as {one.distance_m:.3f} m, but all else gives "
            f"{one.distance_m - size_m:.3f} m ({number_text(size_m, '+.3f')} m)",
            remedy=_MEASURE_AGAIN,
            unit="m",
            size=size_m if is_known else None,
            stddev=finite(stddev_m),
            smallest_detectable=finite(smallest_m),
            effect_on_scale=finite(abs(float(lengths.by_metre[k])) * smallest_m) if is_known else None,
            redundancy=float(lengths.redundancy[k]),
            is_checked=bool(is_known),
        )


_NAMES = {"ranges": "ranges", "lengths": "measured lengths", "positions": "known positions"}


def against_other(estimate: ScaleEstimate, kind: str, other: str, remedy: str) -> Iterator[MistakeTest]:
    """Yield the test that compares the scales from two kinds of measurement.

    Args:
        kind, other: in ``estimate.by_kind``. remedy: what to do if they differ.
    """
    first, second = (estimate.by_kind.get(each) for each in (kind, other))
    if first is None or second is None:
        return
    apart = float(np.log(first.value / second.value))
    stddev = float(np.hypot(first.stddev / first.value, second.stddev / second.value))
    smallest = finite(float(np.sqrt(noncentrality(1))) * stddev)
    yield MistakeTest(
        f"{kind} against {other}",
        "",
        (apart / stddev) ** 2 if np.isfinite(stddev) else 0.0,
        float(special.chdtri(1, FALSE_ALARM_RATE)),
        words=f"by the {_NAMES[kind]} the map is {100 * (np.exp(apart) - 1):+.1f} % larger than by the "
        f"{_NAMES[other]}; their errors together explain {100 * stddev:.1f} % (1 stddev)",
        remedy=remedy,
        unit="1",
        size=apart,
        stddev=finite(stddev),
        smallest_detectable=smallest,
        effect_on_scale=smallest,
    )

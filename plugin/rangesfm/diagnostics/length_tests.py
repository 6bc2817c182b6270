"""Tests of measured lengths: each against the others, and all of them against the ranges."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy import special

from rangesfm.diagnostics.diagnosis import Diagnosis
from rangesfm.diagnostics.hypothesis_tests import MistakeTest, finite, noncentrality
from rangesfm.diagnostics.scale_bound import hidden_lengths
from rangesfm.distances.tape import Tape, TapedDistance
from rangesfm.errors import number_text
from rangesfm.scale.scale_by_lengths import LENGTH_FALSE_ALARM_RATE, LengthScale
from rangesfm.scale.scale_estimate import ScaleEstimate

_MEASURE_AGAIN = "look whether it was mistyped, or measure it again"


def diagnose_lengths(estimate: ScaleEstimate, tape: Tape | None) -> Diagnosis:
    """Return the tests of measured lengths; empty if there are none.

    Args:
        tape: the lengths that the scale was estimated with; ``estimate.lengths`` refers to its rows.
    """
    lengths = estimate.lengths
    if lengths is None or tape is None:
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
    remedy = "measure a length again, and calibrate the radio (rangesfm ranges calibrate)"
    against = list(against_ranges(estimate, "lengths", "measured lengths", remedy))
    reasons = (*left_out, *either, *(f"{row.words}: {row.remedy}" for row in against if row.rejected))
    # Printed tags are shown only if something was found: their sides are many and alike.
    told = [row for row, one in zip(rows, taped, strict=True) if row.rejected or not one.is_printed]
    told.sort(key=lambda row: row.threshold - row.statistic)
    return Diagnosis((*told, *against), reasons, hidden=hidden_lengths(lengths, against[0].stddev if against else None))


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
            words=f"the length from {between} is given as {one.distance_m:.3f} m, but the other lengths give "
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


def against_ranges(estimate: ScaleEstimate, kind: str, what: str, remedy: str) -> Iterator[MistakeTest]:
    """Yield the test that compares the scale from another kind of measurement with the scale from ranges.

    Args:
        kind: in ``estimate.by_kind``. what: in words. remedy: what to do if they differ.
    """
    ranges, others = (estimate.by_kind.get(each) for each in ("ranges", kind))
    if ranges is None or others is None:
        return
    apart = float(np.log(others.value / ranges.value))
    stddev = float(np.hypot(others.stddev / others.value, ranges.stddev / ranges.value))
    smallest = finite(float(np.sqrt(noncentrality(1))) * stddev)
    yield MistakeTest(
        f"{kind} against ranges",
        "",
        (apart / stddev) ** 2 if np.isfinite(stddev) else 0.0,
        float(special.chdtri(1, LENGTH_FALSE_ALARM_RATE)),
        words=f"by the {what} the map is {100 * (np.exp(apart) - 1):+.1f} % larger than by the ranges; their errors "
        f"together explain {100 * stddev:.1f} % (1 stddev)",
        remedy=remedy,
        unit="1",
        size=apart,
        stddev=finite(stddev),
        smallest_detectable=smallest,
        effect_on_scale=smallest,
    )

"""Tests of measured lengths: each against the others, and all of them against the ranges."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy import special

from rangesfm.distances.tape import Tape, TapedDistance
from rangesfm.scale.estimate import ScaleEstimate
from rangesfm.scale.lengths import FALSE_ALARMS, LengthScale
from rangesfm.trust.table import MistakeTest, finite
from rangesfm.trust.testing import noncentrality
from rangesfm.trust.verdict import TrustVerdict

_MEASURE_AGAIN = "look whether it was mistyped, or measure it again"


def trust_in_lengths(estimate: ScaleEstimate, tape: Tape | None) -> TrustVerdict:
    """What is found of them; nothing where there are none.

    Args:
        tape: as the scale was estimated with, with the rows of ``estimate.lengths``.
    """
    lengths = estimate.lengths
    if lengths is None or tape is None:
        return TrustVerdict((), (), (), np.zeros(0, dtype=np.int64))
    rows = list(_of_each(lengths, [tape.distances[row] for row in lengths.rows.tolist()]))
    left_out = [
        f"probably {row.words} ({np.sqrt(row.statistic):.0f} stddevs): {row.remedy}; it is left out"
        for row, is_kept in zip(rows, lengths.is_kept, strict=True)
        if not is_kept
    ]
    open_rows = [row for row, is_kept in zip(rows, lengths.is_kept, strict=True) if is_kept and row.rejected]
    either = "; or ".join(row.words for row in open_rows)
    against = list(_against_ranges(estimate))
    reasons = (
        *left_out,
        *([f"either {either}: {_MEASURE_AGAIN}"] if open_rows else []),
        *(f"{row.words}: {row.remedy}" for row in against if row.rejected),
    )
    # Of printed tags only what was found: their sides are as many as they are alike.
    told = [
        row
        for row, k in zip(rows, lengths.rows.tolist(), strict=True)
        if row.rejected or not tape.distances[k].is_printed
    ]
    told.sort(key=lambda row: row.threshold - row.statistic)
    return TrustVerdict((*told, *against), reasons, (), np.zeros(0, dtype=np.int64))


def _of_each(lengths: LengthScale, taped: list[TapedDistance]) -> Iterator[MistakeTest]:
    for k, one in enumerate(taped):
        size_m, stddev_m = float(lengths.too_long_m[k]), float(lengths.stddev_m[k])
        smallest_m = float(np.sqrt(noncentrality(1))) * stddev_m
        is_known = np.isfinite(stddev_m)
        by_scale = abs(float(lengths.by_metre[k])) * smallest_m if is_known else np.inf
        between = f"{one.ends[0]} to {one.ends[1]}"
        yield MistakeTest(
            name="length",
            subject=between,
            statistic=float(lengths.statistic[k]),
            threshold=lengths.threshold,
            size=size_m if is_known else None,
            stddev=finite(stddev_m),
            unit="m",
            smallest_detectable=finite(smallest_m),
            effect_on_scale=finite(by_scale),
            effect_on_place_m=None,
            words=f"the length from {between}, given as {one.distance_m:.3f} m, is {size_m:+.3f} m off what the others "
            f"make of it, {one.distance_m - size_m:.3f} m",
            remedy=_MEASURE_AGAIN,
        )


def _against_ranges(estimate: ScaleEstimate) -> Iterator[MistakeTest]:
    """The scale by both kinds."""
    ranges, lengths = (estimate.by_kind.get(kind) for kind in ("ranges", "lengths"))
    if ranges is None or lengths is None:
        return
    apart = float(np.log(lengths.value / ranges.value))
    stddev = float(np.hypot(lengths.stddev / lengths.value, ranges.stddev / ranges.value))
    yield MistakeTest(
        name="lengths against ranges",
        subject="",
        statistic=(apart / stddev) ** 2 if np.isfinite(stddev) else 0.0,
        threshold=float(special.chdtri(1, FALSE_ALARMS)),
        size=apart,
        stddev=finite(stddev),
        unit="1",
        smallest_detectable=finite(float(np.sqrt(noncentrality(1))) * stddev),
        effect_on_scale=finite(float(np.sqrt(noncentrality(1))) * stddev),
        effect_on_place_m=None,
        words=f"by the measured lengths the map is {100 * (np.exp(apart) - 1):+.1f} % larger than by the ranges, which "
        f"both together explain to {100 * stddev:.1f} % (1 stddev)",
        remedy="measure a length again, and calibrate the radio (rangesfm ranges calibrate)",
    )

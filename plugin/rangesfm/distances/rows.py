"""The table of taped distances against the map."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator

import numpy as np
import numpy.typing as npt
from pydantic import AliasChoices, Field

from rangesfm.distances.tape import CHECK, Tape, TapedDistance
from rangesfm.files.records import Number, NumberOrNull, Record, Text

# Of stddevs; one honest distance in three hundred is further off.
_DISAGREES = 3.0


class DistanceRow(Record):
    """One taped distance, metres: by tape, in the map, and what the map has too much."""

    from_: Text = Field(validation_alias=AliasChoices("from", "from_"), serialization_alias="from")
    to: Text
    kind: Text
    measured_m: Number
    stddev_m: Number
    estimated_m: NumberOrNull
    residual_m: NumberOrNull


def distance_rows(tape: Tape, lengths_m: npt.NDArray[np.float64]) -> list[DistanceRow]:
    """One entry for each distance of the tape, in its order, with (k,) lengths in the map."""
    return [_row(taped, length) for taped, length in zip(tape.distances, lengths_m.tolist(), strict=True)]


def _row(taped: TapedDistance, length_m: float) -> DistanceRow:
    return DistanceRow(
        from_=taped.ends[0],
        to=taped.ends[1],
        kind=taped.kind,
        measured_m=taped.distance_m,
        stddev_m=taped.stddev_m,
        estimated_m=length_m,
        residual_m=length_m - taped.distance_m,
    )


def disagreements(rows: Iterable[DistanceRow], relative_scale_stddev: float) -> Iterator[str]:
    """What to tell of distances that the map misses by more than tape and scale explain.

    A control distance has held the scale already, so that only the tape's own error excuses it.
    """
    for row in rows:
        scale_stddev_m = relative_scale_stddev * row.measured_m if row.kind == CHECK else 0.0
        stddev_m = math.hypot(row.stddev_m, scale_stddev_m)
        if row.residual_m is not None and abs(row.residual_m) > _DISAGREES * stddev_m:
            yield (
                f"{row.kind} distance from {row.from_} to {row.to}: {row.estimated_m:.3f} m in the map, "
                f"{row.measured_m:.3f} m by tape ({row.residual_m:+.3f} m, expected within "
                f"{_DISAGREES * stddev_m:.3f} m)"
            )

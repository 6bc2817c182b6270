"""Taped distances: their files, the marks in photos between which they were taken, and their table against the map."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from pydantic import AliasChoices, Field

from rangesfm.arrays import Array
from rangesfm.errors import InputError
from rangesfm.files.records import Number, NumberOrNull, Record, Text
from rangesfm.files.tables import Table, read_table, repeated

CONTROL, CHECK = "control", "check"
# Of one that cannot belong to the map.
LEFT_OUT = "left out"
# What a steel tape and a steady hand are good for.
DEFAULT_STDDEV_M = 0.01
DISTANCE_COLUMNS = ("from", "to", "distance_m")
_PIXELS = ("x_px", "y_px")
MARKER_COLUMNS = ("marker", "image_name", *_PIXELS)
_CLICKED_STDDEV_PX = 1.0
FOUND_STDDEV_PX = 0.3
"""Of a corner that a library found."""

# Of stddevs; one honest distance in three hundred is further off.
_DISAGREES = 3.0


@dataclass(frozen=True)
class TapedDistance:
    """A measured length between two ends, each a photo (its camera), a marker or an anchor.

    Attributes:
        ends: names of the two ends.
        distance_m: measured.
        stddev_m: of the measurement.
        kind: "control" (it holds the scale) or "check" (it is compared with the result).
        line: in the file.
        is_printed: whether it is the side of a tag that was found in photos.
        is_everywhere: whether the map has it all along, as that between the cameras of a rig.
    """

    ends: tuple[str, str]
    distance_m: float
    stddev_m: float
    kind: str
    line: int
    is_printed: bool = False
    is_everywhere: bool = False


@dataclass(frozen=True)
class Marker:
    """A point of the scene, marked in k photos by hand, or found in them.

    Attributes:
        image_names: k names.
        pixels: (k, 2) x and y in COLMAP's convention: the centre of the first pixel is (0.5, 0.5).
        lines: (k,) in the file.
        stddev_px: of each coordinate.
    """

    image_names: tuple[str, ...]
    pixels: Array
    lines: tuple[int, ...]
    stddev_px: float = _CLICKED_STDDEV_PX


@dataclass(frozen=True)
class Tape:
    """All that was taped.

    Attributes:
        distances: in the order of the file.
        markers: by name.
        distances_path, markers_path: where they were read from, for messages.
    """

    distances: tuple[TapedDistance, ...] = ()
    markers: Mapping[str, Marker] = field(default_factory=dict)
    distances_path: Path | None = None
    markers_path: Path | None = None

    def control(self) -> Tape:
        """The distances that are to be kept to."""
        return replace(self, distances=tuple(taped for taped in self.distances if taped.kind == CONTROL))

    @property
    def found_markers(self) -> dict[str, Marker]:
        """Those that nobody marked by hand."""
        return {name: marker for name, marker in self.markers.items() if marker.stddev_px == FOUND_STDDEV_PX}

    def with_more(self, distances: tuple[TapedDistance, ...], markers: Mapping[str, Marker] | None = None) -> Tape:
        """With others, and with marks found in photos; names that somebody gave to marks of his own stay his."""
        return replace(self, distances=self.distances + distances, markers={**(markers or {}), **self.markers})

    def without(self, rows: Collection[int]) -> Tape:
        """With some of the distances, by their numbers, as left out."""
        distances = (replace(taped, kind=LEFT_OUT) if k in rows else taped for k, taped in enumerate(self.distances))
        return replace(self, distances=tuple(distances))


def read_tape(distances_path: str | Path, markers_path: str | Path | None = None) -> Tape:
    """Read ``from,to,distance_m[,stddev_m,kind]`` and ``marker,image_name,x_px,y_px``.

    Without a kind a distance is control, without a stddev it is good to a centimetre.

    Raises:
        InputError: with the line, for what is not as described.
    """
    distances = _distances(read_table(distances_path, DISTANCE_COLUMNS, ["stddev_m", "kind"]))
    markers = {} if markers_path is None else _markers(read_table(markers_path, MARKER_COLUMNS))
    return Tape(distances, markers, Path(distances_path), None if markers_path is None else Path(markers_path))


def _distances(table: Table) -> tuple[TapedDistance, ...]:
    if not len(table):
        raise InputError("holds no distance, expected one a line", table.path)
    starts, ends = table.text("from"), table.text("to")
    kinds = table.text("kind", empty=CONTROL) if "kind" in table else [CONTROL] * len(table)
    for row, (start, end, kind) in enumerate(zip(starts, ends, kinds, strict=True)):
        if start == end:
            raise table.error(row, "to", "another end than 'from'")
        if kind not in (CONTROL, CHECK):
            raise table.error(row, "kind", f"{CONTROL} or {CHECK}")
    metres = "a number of metres greater than 0"
    lengths = table.numbers("distance_m", expected=metres, above=0.0)
    stddevs = table.numbers("stddev_m", empty=DEFAULT_STDDEV_M, expected=f"{metres}, or nothing", above=0.0)
    rows = zip(starts, ends, lengths.tolist(), stddevs.tolist(), kinds, table.line.tolist(), strict=True)
    return tuple(TapedDistance((a, b), length, stddev, kind, line) for a, b, length, stddev, kind, line in rows)


def _markers(table: Table) -> dict[str, Marker]:
    names, image_names = table.text("marker"), table.text("image_name")
    pixels = np.column_stack([table.numbers(column, expected="a number of pixels") for column in _PIXELS])
    rows_of: dict[str, list[int]] = {}
    for row, name in enumerate(names):
        rows_of.setdefault(name, []).append(row)
    markers = {}
    for name, rows in rows_of.items():
        seen_in = tuple(image_names[row] for row in rows)
        if again := repeated(seen_in):
            raise table.error(rows[again[0]], "image_name", "a photo in which this marker has no place yet")
        markers[name] = Marker(seen_in, pixels[rows], tuple(table.line[rows].tolist()))
    return markers


class DistanceRow(Record):
    """One taped distance, metres: by tape, in the map, and what the map has too much."""

    from_: Text = Field(validation_alias=AliasChoices("from", "from_"), serialization_alias="from")
    to: Text
    kind: Text
    measured_m: Number
    stddev_m: Number
    estimated_m: NumberOrNull
    residual_m: NumberOrNull


def distance_rows(tape: Tape, lengths_m: Array) -> list[DistanceRow]:
    """One entry for each distance of the tape, in its order, with (k,) lengths in the map."""
    return [
        DistanceRow(
            from_=taped.ends[0],
            to=taped.ends[1],
            kind=taped.kind,
            measured_m=taped.distance_m,
            stddev_m=taped.stddev_m,
            estimated_m=length_m,
            residual_m=length_m - taped.distance_m,
        )
        for taped, length_m in zip(tape.distances, lengths_m.tolist(), strict=True)
    ]


def disagreements(rows: Iterable[DistanceRow], relative_scale_stddev: float, bending: float = 0.0) -> Iterator[str]:
    """What to tell of distances that the map misses by more than tape, scale and bending explain.

    A control distance has held the scale already, so that the scale's error does not excuse it. ``bending``: relative
    stddev by which the scale varies from place to place.
    """
    for row in rows:
        of_scale = relative_scale_stddev if row.kind == CHECK else 0.0
        stddev_m = math.hypot(row.stddev_m, of_scale * row.measured_m, bending * row.measured_m)
        if row.kind != LEFT_OUT and row.residual_m is not None and abs(row.residual_m) > _DISAGREES * stddev_m:
            yield (
                f"{row.kind} distance from {row.from_} to {row.to}: {row.estimated_m:.3f} m in the map, "
                f"{row.measured_m:.3f} m by tape ({row.residual_m:+.3f} m, expected within "
                f"{_DISAGREES * stddev_m:.3f} m)"
            )
